"""Gaussians seen by a camera: colour, opacity, depth and features with gradients, and sums of pixel features."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..compiled import threads
from ..errors import SceneError
from ..scene.camera import Camera
from .blending_kernels import CHANNELS, TRANSMITTANCE, accumulate_pairs, blend, blend_backward, sum_pairs
from .gaussians import Gaussians
from .lanes import LANES
from .projection_kernels import (
    HALF_HEIGHT,
    HALF_WIDTH,
    MOMENT,
    RECORD,
    TILE_HEIGHT,
    TILE_WIDTH,
    project,
    project_backward,
)
from .tiling_kernels import depth_order, fill_tiles, list_pairs, pair_starts

NEAR, NEAR_DISTANCE = 0.2, 2.5
"""A camera with a quarter of the Gaussians within 2.5 units draws nothing nearer than 0.2, as 3DGS (see `near_plane`).

Nearer still, a single stray Gaussian hides the whole photo from a camera that training did not use.
"""
LIFTED_AT_ONCE = 64
"""Channels of a target that `accumulate` sums in one go over the image."""


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees.

    color: (H, W, 3) sRGB over the background; alpha: (H, W) in [0, 1); weighted_depth: (H, W) Σ α T z in scene units;
    features: (H, W, C) Σ α T f, not divided by alpha; radii: (N,) px half the larger side of the box each Gaussian was
    drawn in, 0 where it was not drawn.
    """

    color: Tensor
    alpha: Tensor
    weighted_depth: Tensor
    features: Tensor | None
    radii: Tensor

    @property
    def depth(self) -> Tensor:
        """(H, W) expected distance along the viewing direction in scene units; 0 where nothing is drawn."""
        return self.weighted_depth / self.alpha.clamp_min(1e-6)


@dataclass(frozen=True, eq=False)
class Accumulated:
    """Sums over one view's pixels: sums (N, D) Σ α_i T_i · target, weights (N,) Σ α_i T_i."""

    sums: Tensor
    weights: Tensor


@dataclass(frozen=True, eq=False)
class _Tiles:
    """One view's projected Gaussians and the lists of its tiles."""

    records: NDArray[np.float32]  # (N, RECORD)
    starts: NDArray[np.int64]  # (N + 1,) where each Gaussian's pairs begin
    counts: NDArray[np.int32]  # (N,) how many they are
    columns: int
    tile_starts: NDArray[np.int64]
    gaussian_of: NDArray[np.int32]
    pair_of: NDArray[np.int32]
    radii: NDArray[np.float32]

    @property
    def pairs(self) -> int:
        """Room for pairs; a few at the end of a Gaussian's part may be unused."""
        return len(self.pair_of)


def camera_values(camera: Camera) -> NDArray[np.float32]:
    """(21,) rotation row by row, translation, fx, fy, cx, cy, width, height, centre: what kernels read of a camera."""
    pose, K = camera.world_to_camera, camera.K
    values = [*pose[:3, :3].ravel(), *pose[:3, 3], K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height]
    return np.array([*values, *camera.center], dtype=np.float32)


def near_plane(means: Tensor, camera: Camera) -> float:
    """The depth, in scene units, up to which a camera draws nothing.

    About a twelfth of the distance within which it has a quarter of the Gaussians: 0.2 × 2ᵏ for 2.5 × 2ᵏ. Whole powers
    of two, so that it stays while Gaussians move, come and go.
    """
    if len(means) == 0:
        return NEAR
    away: NDArray[Any] = means.detach().numpy() - camera.center.astype(np.float32)
    quarter = len(means) // 4
    squared = float(np.partition(np.einsum("nk,nk->n", away, away), quarter)[quarter])
    if not (0.0 < squared < math.inf):
        return NEAR
    return math.ldexp(NEAR, round(0.5 * math.log2(squared / NEAR_DISTANCE**2)))


def _flat(tensor: Tensor) -> NDArray[Any]:
    return tensor.detach().to(torch.float32).contiguous().numpy()


def _tile(parameters: Sequence[Tensor], offsets: Tensor, degree: int, camera: Camera) -> _Tiles:
    means, log_scales, quats, opacity_logits, sh = (_flat(parameter) for parameter in parameters)
    n = len(means)
    records = np.empty((n, RECORD), np.float32)
    room = np.empty(n, np.int32)
    values = camera_values(camera)
    near = np.float32(near_plane(parameters[0], camera))
    project(means, log_scales, quats, opacity_logits, sh, degree, _flat(offsets), values, near, records, room)
    starts = pair_starts(room)
    columns = -(-camera.width // TILE_WIDTH)
    rows = -(-camera.height // TILE_HEIGHT)
    tile_of = np.empty(starts[-1], np.int32)
    counts = np.empty(n, np.int32)
    list_pairs(records, starts, camera.width, camera.height, columns, tile_of, counts)
    tile_starts = np.empty(columns * rows + 1, np.int64)
    gaussian_of = np.empty(starts[-1], np.int32)
    pair_of = np.empty(starts[-1], np.int32)
    fill_tiles(depth_order(records, counts), starts, counts, tile_of, tile_starts, gaussian_of, pair_of)
    radii = np.where(counts > 0, np.maximum(records[:, HALF_WIDTH], records[:, HALF_HEIGHT]), np.float32(0))
    return _Tiles(records, starts, counts, columns, tile_starts, gaussian_of, pair_of, radii)


class _Render(torch.autograd.Function):
    """Projection and blending as one step of autograd."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        log_scales: Tensor,
        quats: Tensor,
        opacity_logits: Tensor,
        sh: Tensor,
        features: Tensor,
        background: Tensor,
        offsets: Tensor,
        degree: int,
        camera: Camera,
        pulls: Tensor | None,
    ) -> tuple[Tensor, ...]:
        parameters = (means, log_scales, quats, opacity_logits, sh)
        tiles = _tile(parameters, offsets, degree, camera)
        planes = np.empty((CHANNELS + features.shape[1], camera.height, camera.width), np.float32)
        blend(
            threads(), tiles.columns, tiles.records.reshape(-1), _flat(features),
            tiles.tile_starts, tiles.gaussian_of, planes,
        )  # fmt: skip
        ctx.save_for_backward(*parameters, features, background)
        ctx.tiles, ctx.planes, ctx.degree, ctx.camera, ctx.pulls = tiles, planes, degree, camera, pulls
        ctx.set_materialize_grads(False)
        out = torch.from_numpy(planes)
        left = out[TRANSMITTANCE]
        color = torch.addcmul(out[:3], background.detach()[:, None, None], left[None])
        radii = torch.from_numpy(tiles.radii)
        ctx.mark_non_differentiable(radii)
        return color, 1.0 - left, out[3], out[CHANNELS:], radii

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        *parameters, features, background = ctx.saved_tensors
        means, log_scales, quats, _, sh = parameters
        tiles: _Tiles = ctx.tiles
        color, alpha, depth, extra, _ = grads
        planes = ctx.planes
        gradients = np.empty((5 + features.shape[1], *planes.shape[1:]), np.float32)
        for place, gradient in ((slice(0, 3), color), (3, depth), (4, alpha), (slice(5, None), extra)):
            gradients[place] = 0.0 if gradient is None else gradient.numpy()
        moments = np.empty((tiles.pairs, MOMENT), np.float32)
        feature_moments = np.empty((tiles.pairs, features.shape[1]), np.float32)
        blend_backward(
            threads(), tiles.columns, tiles.records.reshape(-1), _flat(features), tiles.tile_starts,
            tiles.gaussian_of, tiles.pair_of, _flat(background), planes, gradients, moments, feature_moments,
        )  # fmt: skip
        pulled = [np.empty(parameter.shape, np.float32) for parameter in (*parameters, torch.empty(len(means), 2))]
        project_backward(
            _flat(means), _flat(log_scales), _flat(quats), _flat(sh), ctx.degree, camera_values(ctx.camera),
            tiles.records, tiles.starts, tiles.counts, moments, *pulled,
            np.empty((len(means), 2), np.float32) if ctx.pulls is None else ctx.pulls.numpy(),
        )  # fmt: skip
        d_features = np.zeros(features.shape, np.float32)
        if features.shape[1] > 0:
            sum_pairs(tiles.starts, tiles.counts, feature_moments, d_features)
        d_background = None
        if ctx.needs_input_grad[6] and color is not None:
            d_background = (color * torch.from_numpy(planes[TRANSMITTANCE])).sum((1, 2))
        *d_parameters, d_offsets = (torch.from_numpy(gradient) for gradient in pulled)
        return (*d_parameters, torch.from_numpy(d_features), d_background, d_offsets, None, None, None)


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    features: Tensor | None = None,
    background: Tensor | None = None,
    sh_degree: int | None = None,
    screen_offsets: Tensor | None = None,
    screen_pulls: Tensor | None = None,
) -> Rendering:
    """Draw Gaussians, with gradients to all their parameters, the features, the background and the offsets.

    features: (N, C) further channels, blended as the colour is; background: (3,) sRGB behind everything, black when
    not given; sh_degree: evaluate the harmonics up to this degree only; screen_offsets: (N, 2) px added to the
    projected means: zeros that require a gradient receive that of the projected means (3DGS densifies by it);
    screen_pulls: (N, 2) float32, filled by the backward pass with the sums over pixels of that gradient's absolute
    values, which do not cancel (AbsGS, Ye et al. 2024).

    Pixel centres lie at +0.5. The camera must have no distortion. A splat beyond `near_plane` is drawn where its
    α ≥ 1/255 with 3DGS's low-pass of 0.3 px²; a pixel stops at a transmittance of 1e-4. The bytes do not depend on the
    number of threads.

    Raises:
        SceneError: the camera has distortion, or features have another length than the Gaussians.
    """
    _check_camera(camera)
    n = len(gaussians)
    extra = torch.zeros(n, 0) if features is None else features
    if len(extra) != n:
        raise SceneError(f"{len(extra)} features were given for {n} Gaussians; give one row each")
    behind = torch.zeros(3) if background is None else background
    offsets = torch.zeros(n, 2) if screen_offsets is None else screen_offsets
    degree = gaussians.sh_degree if sh_degree is None else min(sh_degree, gaussians.sh_degree)
    parameters = (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh)
    color, alpha, depth, blended, radii = _Render.apply(
        *parameters, extra, behind, offsets, degree, camera, screen_pulls
    )
    return Rendering(
        color=color.permute(1, 2, 0),
        alpha=alpha,
        weighted_depth=depth,
        features=None if features is None else blended.permute(1, 2, 0),
        radii=radii,
    )


@torch.no_grad()
def accumulate(gaussians: Gaussians, camera: Camera, target: Tensor) -> Accumulated:
    """Sum a view's pixel features into the Gaussians that drew them: Σ_v α_i(v) T_i(v) · target(v), and Σ_v α_i T_i.

    target: (H, W, D) float32 at the camera's size. The mean feature of a Gaussian is the sums over all views divided by
    the weights over all views (Marrie et al. 2024, eq. 3).

    Raises:
        SceneError: the target's size differs from the camera's, or the camera has distortion.
    """
    _check_camera(camera)
    if target.ndim != 3 or tuple(target.shape[:2]) != (camera.height, camera.width):
        raise SceneError(
            f"the target is {tuple(target.shape)}; its first two sizes must be the camera's"
            f" ({camera.height}, {camera.width})"
        )
    n, channels = len(gaussians), target.shape[2]
    parameters = (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh)
    tiles = _tile(parameters, torch.zeros(n, 2), 0, camera)
    sums = np.empty((n, channels), np.float32)
    weights = np.empty(n, np.float32)
    for begin in range(0, max(channels, 1), LIFTED_AT_ONCE):
        part = _flat(target[:, :, begin : begin + LIFTED_AT_ONCE])
        columns = part.shape[2]
        padded = -(-columns // LANES) * LANES
        pairs = np.empty((tiles.pairs, padded + 1), np.float32)
        accumulate_pairs(
            threads(), tiles.columns, tiles.records.reshape(-1), tiles.tile_starts,
            tiles.gaussian_of, tiles.pair_of, part, pairs,
        )  # fmt: skip
        summed = np.empty((n, padded + 1), np.float32)
        sum_pairs(tiles.starts, tiles.counts, pairs, summed)
        sums[:, begin : begin + columns] = summed[:, :columns]
        weights[:] = summed[:, padded]
    return Accumulated(torch.from_numpy(sums), torch.from_numpy(weights))


def _check_camera(camera: Camera) -> None:
    if camera.distortion is not None and np.any(camera.distortion):
        raise SceneError("the camera has lens distortion; undistort its photo first (the scene readers do)")
