"""What `rasterize` draws, on a graphics card: views with further channels, surfaces, sums of pixel features."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ...scene.camera import Camera
from ..gaussians import PARAMETERS, Gaussians
from ..rendering.render import DrawRules, arrays_of, blend_view, project_view, tile_view
from ..rendering.workspace import Workspace
from .adapters import Adapter
from .card import Card
from .drawing import Canvas, Size, size_of, view_of

TOGETHER, CHUNK = 8, 16
"""Channels that the kernels blend, and sum, at once."""

FloatArray = NDArray[np.float32]


class CardViews:
    """Draws on a card. The first view is drawn on the CPU too; a card that draws another one is not used."""

    def __init__(self, adapter: Adapter) -> None:
        """Open the card.

        Raises:
            GpuError: it cannot be opened.
        """
        self.canvas = Canvas(Card.open(adapter))
        self._shown: list[tuple[Tensor, int]] = []
        self._agreed = False

    def draw(
        self, gaussians: Gaussians, camera: Camera, rules: DrawRules, features: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(CHANNELS, H, W) planes as `kernels.blend` writes them, and (C, H, W) the features (N, C).

        Raises:
            GpuError: the card failed, or draws something else than the CPU.
        """
        view = view_of(camera, rules, len(gaussians))
        planes = self._draw_planes(gaussians, camera, rules, view)
        size, card = size_of(view), self.canvas.card
        blended = np.zeros((features.shape[1], size.height, size.width), np.float32)
        fit = card.adapter.largest_buffer // (4 * TOGETHER * max(size.width * size.height, len(gaussians), 1))
        at_once = TOGETHER * max(fit, 1)
        for first in range(0, len(blended), at_once):
            part = blended[first : first + at_once]
            view["channels"] = len(part)
            card.upload("view", view.view(np.uint32))
            card.upload("features", features[:, first : first + at_once])
            card.buffer("blended", part.size)
            self._run("blend_features", size, -(-len(part) // TOGETHER))
            part[:] = card.download("blended", np.float32, part.size).reshape(part.shape)
        return planes, blended

    def surface(self, camera: Camera) -> FloatArray:
        """(H, W) depth of the front surface in the view that was drawn last, as `kernels.surface` measures it."""
        size = Size(camera.width, camera.height)
        self._run("measure_surface", size, 1)
        depths = self.canvas.card.download("depths", np.float32, size.width * size.height)
        return depths.reshape(size.height, size.width)

    def accumulate(
        self, gaussians: Gaussians, camera: Camera, rules: DrawRules, target: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Sums (N, D) of the target (H, W, D) by blending weight, and the weights (N,).

        Raises:
            GpuError: as `draw`.
        """
        view = view_of(camera, rules, len(gaussians))
        self._draw_planes(gaussians, camera, rules, view)
        canvas, count, channels, size = self.canvas, len(gaussians), target.shape[2], size_of(view)
        card = canvas.card
        card.buffer("pair_sums", CHUNK * canvas.capacity)
        card.buffer("lifted", CHUNK * count)
        lifted = np.zeros((count, channels + 1), np.float32)
        values = np.zeros((size.height, size.width, CHUNK), np.float32)
        for first in range(0, channels + 1, CHUNK):
            part = lifted[:, first : first + CHUNK]
            own = target[..., first : first + CHUNK]
            values[..., : own.shape[2]] = own
            values[..., own.shape[2] :] = 1.0  # the first of these sums the weights
            card.upload("target_values", values)
            held = canvas.list_buffers(size)
            work = card.record()
            work.run(canvas.program("accumulate"), "accumulate", held, size.columns, size.rows)
            work.run_for(canvas.program("accumulate"), "gather", held, count * CHUNK)
            work.submit()
            part[:] = card.download("lifted", np.float32, count * CHUNK).reshape(count, CHUNK)[:, : part.shape[1]]
        return lifted[:, :channels].copy(), lifted[:, channels].copy()

    def _run(self, entry: str, size: Size, layers: int) -> None:
        """Run an entry point of `blended` over the view that was drawn last."""
        card = self.canvas.card
        card.buffer("depths", size.width * size.height)
        for name in ("features", "blended"):
            card.buffer(name, 1)
        work = card.record()
        work.run(self.canvas.program("blended"), entry, self.canvas.list_buffers(size), size.columns, size.rows, layers)
        work.submit()

    def _draw_planes(self, gaussians: Gaussians, camera: Camera, rules: DrawRules, view: NDArray[Any]) -> FloatArray:
        """Draw the planes of a view."""
        canvas = self.canvas
        tensors = [getattr(gaussians, name) for name in PARAMETERS]
        if [(id(each), each._version) for each in tensors] != [(id(each), version) for each, version in self._shown]:
            canvas.show(arrays_of(gaussians))
            self._shown = [(each, each._version) for each in tensors]
        planes = canvas.planes(view)
        if not self._agreed:
            self._compare(gaussians, camera, rules, planes)
        return planes

    def _compare(self, gaussians: Gaussians, camera: Camera, rules: DrawRules, planes: FloatArray) -> None:
        """Raises GpuError if the CPU draws something else."""
        workspace = Workspace()
        tiles = tile_view(project_view(arrays_of(gaussians), camera, rules, workspace), camera, rules, workspace)
        ours = blend_view(tiles, np.zeros((len(gaussians), 0), np.float32), camera, workspace)
        self.canvas.require_same_image(planes, ours)
        self._agreed = True
