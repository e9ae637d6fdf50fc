"""Steps of training on a graphics card. Gaussians, moments and photos stay there; densification is done on the CPU.

The card says every few steps what it did. A view with more pairs of Gaussians and tiles than there is room for stops
it: it leaves that step and all later ones out, and they are repeated with more room.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...config import TrainConfig
from ...errors import GpuError
from ..gaussians import PARAMETERS
from ..gpu.adapters import Adapter, choose_adapter
from ..gpu.card import Card
from ..gpu.drawing import (
    COLORS,
    FULL,
    NEEDED,
    PLAN,
    POSE,
    SLOTS,
    TAKEN,
    Canvas,
    Learnt,
    pack_photo,
    size_of,
    view_of,
)
from .checkpoint import TrainingState
from .densify import GradientStats
from .exposure import Exposures
from .photos import Picture
from .poses import Poses
from .schedule import Schedule
from .step import HOLD_EVERY, SSIM_WEIGHT, Step, changes_number, densify_and_prune

SAME_GRADIENTS = 1e-2
"""Relative difference of the gradients of a parameter up to which a card agrees with the CPU; see `SAME_IMAGE`."""
CHECKED_EVERY = 500
"""Steps between two comparisons with the CPU, besides those whenever Gaussians were added."""
PHOTO_BYTES = 512 << 20
"""Bytes of photos that stay on the card."""


def adapter_for(config: TrainConfig, *, joint: bool) -> tuple[Adapter | None, str]:
    """The graphics card that trains, None for the CPU, and why it is the CPU, if a card could have been used.

    joint: further channels are trained along.

    Raises:
        GpuError: a card was asked for, and it is not there.
    """
    adapter = choose_adapter(config.device)
    if adapter is None:
        return None, ""
    missing = {
        "--features joint": joint,
        "--train.densify mcmc": config.densify == "mcmc",
        "--train.forgive": config.forgive > 0.0,
    }
    for name, used in missing.items():
        if used:
            return None, f"{name} cannot be computed on a graphics card yet, so the CPU trains"
    return adapter, ""


@dataclass(frozen=True, eq=False)
class _Kept:
    """What `state` was, besides its Gaussians, when it was last collected."""

    step: int
    exposures: Exposures | None
    poses: Poses | None


class CardStep:
    """Takes steps on a graphics card (see `Stepper`)."""

    look_every = 100

    def __init__(self, schedule: Schedule, adapter: Adapter) -> None:
        """Open the card and take the memory that the whole training needs.

        Raises:
            GpuError: it cannot be opened, or has less memory.
        """
        self.schedule = schedule
        self.card = Card.open(adapter)
        self.canvas = Canvas(self.card)
        self._reserve()
        self._usual = Step(schedule)
        self._held: torch.Tensor | None = None  # the means that the card's Gaussians were uploaded from
        self._kept = _Kept(0, None, None)
        self._pending: list[tuple[int, Picture]] = []
        self._loss = 0.0
        self._photos: dict[str, int] = {}

    def _reserve(self) -> None:
        """Make room for the most Gaussians in the largest photo, so that too little memory is known before training.

        Raises:
            GpuError: the card's memory does not suffice.
        """
        count, cameras = self.schedule.config.max_gaussians, self.schedule.scene.cameras
        camera = max(cameras, key=lambda each: each.width * each.height)
        view = view_of(camera, self.schedule.rules(0), count)
        self.canvas.reserve(count, size_of(view))
        self.canvas.reserve_backward(count, self._columns, view)
        needed = self.card.bytes
        try:
            self.card.download("plan", np.uint32, PLAN)
        except GpuError as error:
            raise GpuError(
                f"{error}. {count:,} Gaussians in photos of {camera.width}×{camera.height} need {needed / 2**20:.0f} "
                "MiB on the card, and its photos more. Lower --train.max-gaussians or --scene.max-side"
            ) from error

    def take(self, state: TrainingState, picture: Picture) -> float:
        """As `Stepper`. The loss is that of an earlier step."""
        try:
            if state.step % CHECKED_EVERY == 0:
                self.collect(state)
                self._held = None
            if self._held is not state.parameters.values["means"]:
                self._keep(state)
                self._check(state, picture)
                self._upload(state)
            if any(picture.view == each.view for _, each in self._pending):
                self._confirm(state)  # the view's pose and exposure learn from its last use
            self._pending.append((state.step, picture))
            self._run(state, len(self._pending) - 1)
            state.parameters.step += 1
            if changes_number(self.schedule, state.step):
                self.collect(state)
                densify_and_prune(state, self.schedule)
                self._held = None
            elif len(self._pending) == SLOTS:
                self._confirm(state)
        except GpuError:
            self._rewind(state)
            raise
        return self._loss

    def collect(self, state: TrainingState) -> None:
        """As `Stepper`."""
        if self._held is not state.parameters.values["means"] or state.step == self._kept.step:
            return
        try:
            self._confirm(state)
            learnt = self.canvas.fetch(len(state.parameters), self._columns)
        except GpuError:
            self._rewind(state)
            raise
        parameters = state.parameters
        for group in ("values", "first", "second"):
            setattr(parameters, group, {name: torch.from_numpy(each) for name, each in getattr(learnt, group).items()})
        parameters.updates = torch.from_numpy(learnt.updates)
        sums, counts = (torch.from_numpy(np.ascontiguousarray(learnt.pulls[:, column])) for column in (0, 1))
        state.mean_gradients = GradientStats(sums, counts)
        self._held = parameters.values["means"]
        self._keep(state)

    def _keep(self, state: TrainingState) -> None:
        """Remember what `_rewind` needs."""
        self._kept = _Kept(state.step, copy.deepcopy(state.exposures), copy.deepcopy(state.poses))

    def _rewind(self, state: TrainingState) -> None:
        """Bring the state back to when it was last collected: its Gaussians have not changed since."""
        state.parameters.step, state.exposures, state.poses = self._kept.step, self._kept.exposures, self._kept.poses

    def _upload(self, state: TrainingState) -> None:
        """Bring the card up to `state`."""
        parameters, stats = state.parameters, state.mean_gradients
        values, first, second = (
            {name: value.numpy() for name, value in table.items()}
            for table in (parameters.values, parameters.first, parameters.second)
        )
        pulls = torch.stack([stats.sums, stats.counts], 1).numpy()
        self.canvas.put(Learnt(values, first, second, parameters.updates.numpy(), pulls))
        self._held = parameters.values["means"]

    def _run(self, state: TrainingState, slot: int) -> None:
        """Hand a pending step to the card."""
        step, picture = self._pending[slot]
        view = self._view(state, step, picture, len(state.parameters))
        view["slot"] = slot
        photo = self._photo(picture)
        self.canvas.learn(view, photo, columns=self._columns, hold=step % HOLD_EVERY == 0)

    @property
    def _columns(self) -> int:
        """Numbers of a Gaussian."""
        return 11 + 3 * (self.schedule.config.sh_degree + 1) ** 2

    def _view(self, state: TrainingState, step: int, picture: Picture, count: int) -> NDArray[Any]:
        """The settings of a step for the kernels."""
        schedule, config = self.schedule, self.schedule.config
        rates = schedule.rates(step)
        n = 3 * max(_mask_usable(picture), 1)
        camera = picture.camera if state.poses is None else state.poses.camera(picture.view, picture.camera)
        view = view_of(camera, schedule.rules(step), count)
        view["with_pose"] = state.poses is not None
        view["load_share"] = config.load_weight / (1.0 - config.load_weight)
        if state.exposures is not None:
            view["exposure"] = state.exposures.matrices[picture.view].reshape(-1)
        view["with_mean_gradients"] = schedule.records_gradients(step)
        view["l1_weight"], view["ssim_weight"] = (1.0 - SSIM_WEIGHT) / n, SSIM_WEIGHT / n
        view["rates"] = rates.means, rates.log_scales, rates.quats, rates.opacity_logits, rates.sh, rates.sh_rest
        view["opacity_weight"] = config.opacity_weight / count
        view["scale_weight"] = config.scale_weight / (3 * count * schedule.extent)
        view["flatness_weight"] = config.flatness_weight / (count * schedule.extent)
        view["middle"], view["extent"] = schedule.middle.numpy(), schedule.extent
        return view

    def _photo(self, picture: Picture) -> Any:
        """The buffer of a photo: 8 bits a colour, and whether a pixel may be used."""
        name = f"photo {picture.view} {picture.camera.width}"
        if name not in self._photos:
            packed_photo = pack_photo(picture.pixels, picture.mask)
            while self._photos and sum(self._photos.values()) + packed_photo.nbytes > PHOTO_BYTES:
                oldest = next(iter(self._photos))
                self.card.drop(oldest)
                del self._photos[oldest]
            self.card.upload(name, packed_photo)
            self._photos[name] = packed_photo.nbytes
        return self.card.buffers[name]

    def _confirm(self, state: TrainingState) -> None:
        """Wait for the pending steps, and repeat those for which there was no room. Poses and exposures learn from
        them."""
        if not self._pending:
            return
        plan = self.card.download("plan", np.uint32, PLAN)
        while plan[FULL]:
            self._make_room(int(plan[NEEDED]), plan)
            for slot in range(int(plan[TAKEN]), len(self._pending)):
                self._run(state, slot)
            plan = self.card.download("plan", np.uint32, PLAN)
        sums = self.card.download("losses", np.float32, 2 * len(self._pending)).reshape(-1, 2)
        numbers = np.array([3 * max(_mask_usable(picture), 1) for _, picture in self._pending])
        losses = (1.0 - SSIM_WEIGHT) * sums[:, 0] / numbers + SSIM_WEIGHT * (1.0 - sums[:, 1] / numbers)
        self._loss = float(losses[-1]) if np.isfinite(losses).all() else float("nan")
        self._learn(state)
        self._pending.clear()
        self.card.upload("plan", np.zeros(PLAN, np.uint32))

    def _learn(self, state: TrainingState) -> None:
        """Update the poses and exposures of the pending steps' views."""
        many, schedule = len(self._pending), self.schedule
        if state.exposures is not None:
            sums = self.card.download("color_sums", np.float32, COLORS * many).astype(np.float64).reshape(many, 3, 4)
            for (step, picture), own in zip(self._pending, sums, strict=True):
                state.exposures.update(picture.view, own, schedule.done(step))
        if state.poses is not None:
            sums = self.card.download("pose_sums", np.float32, POSE * many).astype(np.float64).reshape(many, POSE)
            for (step, picture), own in zip(self._pending, sums, strict=True):
                state.poses.learn(picture.view, own, schedule.done(step), schedule.extent)

    def _make_room(self, pairs: int, plan: NDArray[Any]) -> None:
        """Room for this many pairs, and permission to go on."""
        self.canvas.make_room(pairs)
        go_on = plan.copy()
        go_on[FULL] = 0
        self.card.upload("plan", go_on)

    def _check(self, state: TrainingState, picture: Picture) -> None:
        """Compute one step's gradients here and on the card.

        Raises:
            GpuError: they differ.
        """
        learnt = replace(state, exposures=copy.deepcopy(state.exposures), poses=copy.deepcopy(state.poses))
        drawn, ours, _ = self._usual.gradients(learnt, picture, state.step)
        planes = self._usual.workspace.take("planes", (6, picture.camera.height, picture.camera.width))
        view = self._view(state, state.step, picture, len(state.parameters))
        for name in ("opacity_weight", "scale_weight", "flatness_weight"):
            view[name] = 0.0
        photo = pack_photo(picture.pixels, picture.mask)
        theirs = self.canvas.compute(state.parameters.arrays(), view, photo=photo)
        self.canvas.require_same_image(theirs.planes, planes)
        # Round Gaussians, as the first ones are, have rotations without a gradient: only rounding.
        turning = float(np.linalg.norm(ours["log_scales"][drawn != 0]))
        for name in PARAMETERS:
            own, other = (each[name][drawn != 0].astype(np.float64) for each in (ours, theirs.gradients))
            length = max(float(np.linalg.norm(own)), turning if name == "quats" else 0.0)
            away = float(np.linalg.norm(other - own))
            if not away <= SAME_GRADIENTS * length:
                raise GpuError(
                    f"{self.card.adapter.name} computes other gradients of {name} than the CPU (relative difference "
                    f"{away / max(length, 1e-30):.2g})"
                )


def _mask_usable(picture: Picture) -> int:
    """Mark the pixels of a photo that may be used."""
    return picture.pixels.shape[0] * picture.pixels.shape[1] if picture.mask is None else int(picture.mask.sum())
