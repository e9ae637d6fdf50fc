"""3DGS with its published settings, trained with the plain rasteriser, as a lower bound for our quality.

Kerbl et al. 2023: learning rates, densification and opacity resets as in the authors' code (7,000 steps, the shorter of
their two trainings). The plain rasteriser cannot afford a large scene: one is scaled down.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...engine.config import SceneConfig, TrainConfig
from ...engine.progress import Progress, part, silent
from ...engine.scene.camera import Camera, Scene
from ...engine.scene.read import read_scene
from ...engine.splatting.gaussians import SH_C0
from ...engine.splatting.training.initialise import neighbour_distances
from ...engine.splatting.training.losses import psnr, ssim
from ...engine.splatting.training.photos import PhotoShelf
from ...engine.splatting.training.schedule import view_at
from ...engine.splatting.training.train import choose_held_out, train
from . import plain_rasterizer

STEPS = 7_000
LONGEST = 30_000
"""Steps over which the rate of the means falls; densification ends at half of them."""
MEANS_RATE, LAST_MEANS_RATE = 1.6e-4, 1.6e-6
RATES = {"log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 5e-2, "sh": 2.5e-3, "sh_rest": 2.5e-3 / 20}
DEGREE, DEGREE_EVERY = 3, 1000
DENSIFY_FROM, DENSIFY_EVERY, GRADIENT, SMALL = 500, 100, 2e-4, 0.01
FAINT, RESET_EVERY, RESET_TO, LARGE, LARGE_PIXELS = 0.005, 3000, 0.01, 0.1, 20

DOWNSCALE, GAUSSIANS = 4.0, 3000
"""Settings of the small scene."""


@dataclass(frozen=True)
class Trained:
    """One training: its steps, seconds and Gaussians; held-out PSNR in dB and SSIM."""

    name: str
    steps: int
    seconds: float
    gaussians: int
    psnr: float
    ssim: float


def compare_with_published(
    scene_folder: Path,
    *,
    steps: int | None = None,
    gaussians: int = GAUSSIANS,
    downscale: float = DOWNSCALE,
    progress: Progress = silent,
) -> list[Trained]:
    """Train one small scene as published, then with ours, to the same final number of Gaussians.

    steps: of the first and of the last, 7,000 if not given; between them the standard's.
    """
    steps = steps or STEPS
    scene = read_scene(scene_folder, SceneConfig(downscale=downscale))
    theirs = train_published(scene, steps=steps, most=gaussians, progress=part(progress, 0.0, 0.8))
    config = TrainConfig(max_gaussians=theirs.gaussians)
    train(scene, replace(config, steps=2))  # compiles
    rows = [theirs]
    for k, wanted in enumerate((config, replace(config, steps=steps))):
        begun = time.perf_counter()
        ours = train(scene, wanted, progress=part(progress, 0.8 + 0.1 * k, 0.9 + 0.1 * k))
        seconds = time.perf_counter() - begun
        rows.append(Trained("ours", ours.steps, seconds, len(ours.gaussians), ours.psnr or 0.0, ours.ssim or 0.0))
    return rows


def train_published(
    scene: Scene, *, steps: int = STEPS, most: int = GAUSSIANS, seed: int = 0, progress: Progress = silent
) -> Trained:
    """Train on all but every eighth photo; at most `most` Gaussians, from a third as many points of the cloud."""
    begun = time.perf_counter()
    aside = choose_held_out(scene, TrainConfig().holdout_every)
    views = [view for view in range(len(scene.cameras)) if view not in aside]
    model = _Model(scene, most, seed)
    with closing(PhotoShelf(scene)) as shelf:
        for step in range(steps):
            picture = shelf.picture(view_at(step, views, seed))
            model.step(step, picture.camera, torch.from_numpy(np.ascontiguousarray(picture.pixels)).float() / 255)
            if step % 20 == 0:
                progress(step / steps, f"3DGS as published, step {step}/{steps}, {len(model)} Gaussians")
        scores = [model.score(picture.camera, picture.pixels) for picture in map(shelf.picture, sorted(aside))]
    mean_psnr, mean_ssim = np.mean(scores, 0)
    return Trained(
        "3DGS as published", steps, time.perf_counter() - begun, len(model), float(mean_psnr), float(mean_ssim)
    )


class _Model:
    """Parameters, torch's Adam over them, and the statistics of densification.

    values: as in `Gaussians`, but with the harmonics in two: sh (N, 1, 3) and sh_rest (N, 15, 3). Since the last
    densification: mean_gradients (N,) lengths of the gradients of projected means in half-images; counts (N,) views
    that rendered them; widest (N,) px.
    """

    mean_gradients: Tensor
    counts: Tensor
    widest: Tensor

    def __init__(self, scene: Scene, most: int, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.extent, self.most = scene.extent, most
        kept = np.sort(self.random.permutation(len(scene.points))[: most // 3])
        points, n = scene.points[kept], len(kept)
        colors = torch.from_numpy(scene.colors[kept] / 255.0 - 0.5).float() / SH_C0
        values = {
            "means": torch.from_numpy(points).float(),
            "log_scales": torch.from_numpy(np.log(neighbour_distances(points))).float()[:, None].repeat(1, 3),
            "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            "opacity_logits": torch.full((n,), math.log(0.1 / 0.9)),
            "sh": colors[:, None],
            "sh_rest": torch.zeros(n, (DEGREE + 1) ** 2 - 1, 3),
        }
        self.values = {name: value.requires_grad_() for name, value in values.items()}
        groups = [{"params": [value], "name": name, "lr": RATES.get(name, 0.0)} for name, value in self.values.items()]
        self.adam = torch.optim.Adam(groups, eps=1e-15)
        self._forget()

    def __len__(self) -> int:
        return len(self.values["means"])

    def step(self, step: int, camera: Camera, photo: Tensor) -> None:
        """Render, compare, update; densify and prune when due."""
        falls = (LAST_MEANS_RATE / MEANS_RATE) ** (step / LONGEST)
        self.adam.param_groups[0]["lr"] = MEANS_RATE * self.extent * falls
        splats, color = self._draw(camera, min(step // DEGREE_EVERY, DEGREE))
        splats.means.retain_grad()
        self.adam.zero_grad()
        plain_rasterizer.loss(color, photo).backward()  # type: ignore[no-untyped-call]
        self.adam.step()
        done = step + 1
        if done < LONGEST // 2:
            self._watch(splats, camera)
            if done > DENSIFY_FROM and done % DENSIFY_EVERY == 0:
                self._densify_and_prune(after_reset=done > RESET_EVERY)
            if done % RESET_EVERY == 0:
                logits = self.values["opacity_logits"].detach().clamp(max=math.log(RESET_TO / (1 - RESET_TO)))
                self._replace("opacity_logits", logits, torch.zeros_like)

    @torch.no_grad()
    def score(self, camera: Camera, photo: NDArray[np.uint8]) -> tuple[float, float]:
        """PSNR in dB and SSIM of one view."""
        color = self._draw(camera, DEGREE)[1]
        return psnr(color, photo), ssim(color, photo)

    def _draw(self, camera: Camera, degree: int) -> tuple[plain_rasterizer.Splats, Tensor]:
        view = plain_rasterizer.View.of(camera.K, camera.world_to_camera, camera.width, camera.height)
        rest = self.values["sh_rest"][:, : (degree + 1) ** 2 - 1]
        splats = plain_rasterizer.project(self.values | {"sh": torch.cat([self.values["sh"], rest], 1)}, view)
        lists = plain_rasterizer.tile_lists(splats, view.width, view.height)
        return splats, plain_rasterizer.blend(splats, *lists, view.width, view.height)

    @torch.no_grad()
    def _watch(self, splats: plain_rasterizer.Splats, camera: Camera) -> None:
        assert splats.means.grad is not None
        seen = (splats.radii > 0) & (splats.means.grad != 0).any(1)
        halves = splats.means.grad * torch.tensor([0.5 * camera.width, 0.5 * camera.height])
        self.mean_gradients += torch.where(seen, halves.norm(dim=1), 0.0)
        self.counts += seen
        self.widest = torch.maximum(self.widest, torch.where(seen, splats.radii, 0.0))

    @torch.no_grad()
    def _densify_and_prune(self, *, after_reset: bool) -> None:
        values = {name: value.detach() for name, value in self.values.items()}
        gradient = self.mean_gradients / self.counts.clamp_min(1)
        chosen = torch.zeros(len(self), dtype=torch.bool)
        room = max(self.most - len(self), 0)
        chosen[gradient.argsort(descending=True, stable=True)[: min(int((gradient >= GRADIENT).sum()), room)]] = True
        sizes = values["log_scales"].exp().amax(1)
        cloned, split = chosen & (sizes <= SMALL * self.extent), chosen & (sizes > SMALL * self.extent)
        halves = {name: value[split].repeat(2, *[1] * (value.dim() - 1)) for name, value in values.items()}
        drawn = torch.from_numpy(self.random.standard_normal(halves["means"].shape)).float()
        turned = plain_rasterizer.compute_rotations(halves["quats"]) @ (halves["log_scales"].exp() * drawn)[..., None]
        halves["means"] = halves["means"] + turned[..., 0]
        halves["log_scales"] = halves["log_scales"] - math.log(1.6)
        added = {name: torch.cat([value[cloned], halves[name]]) for name, value in values.items()}
        useless = (values["opacity_logits"].sigmoid() < FAINT) | split
        if after_reset:
            useless |= (self.widest > LARGE_PIXELS) | (sizes > LARGE * self.extent)
        for name, value in values.items():
            self._replace(
                name,
                torch.cat([value[~useless], added[name]]),
                partial(_keep, keep=~useless, added=torch.zeros_like(added[name])),
            )
        self._forget()

    def _replace(self, name: str, value: Tensor, change: Callable[[Tensor], Tensor]) -> None:
        """Replace a parameter's tensor; `change` makes its moments from the old ones."""
        group = next(group for group in self.adam.param_groups if group["name"] == name)
        state = self.adam.state.pop(self.values[name], None)
        self.values[name] = value.clone().requires_grad_()
        group["params"] = [self.values[name]]
        if state:
            for key in ("exp_avg", "exp_avg_sq"):
                state[key] = change(state[key])
            self.adam.state[self.values[name]] = state

    def _forget(self) -> None:
        self.mean_gradients, self.counts, self.widest = (torch.zeros(len(self)) for _ in range(3))


def _keep(moments: Tensor, *, keep: Tensor, added: Tensor) -> Tensor:
    return torch.cat([moments[keep], added])
