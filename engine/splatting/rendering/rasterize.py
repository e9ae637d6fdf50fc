"""Views of Gaussians: colour, opacity, depth and features with gradients, and sums of pixel features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...compiled.jit import threads
from ...compiled.lanes import LANES
from ...errors import SceneError
from ...scene.camera import Camera
from ..gaussians import PARAMETERS, Gaussians
from ..kernels.accumulate import accumulate_pairs
from ..kernels.blend_backward import sum_pairs
from ..kernels.surface import measure_surface
from ..kernels.tile import CHANNELS, TRANSMITTANCE
from .device import try_on_card
from .render import (
    FAINTEST,
    DrawRules,
    Tiles,
    arrays_of,
    blend_view,
    load_view,
    project_view,
    tile_view,
    to_array,
    view_backward,
)
from .workspace import Workspace

LIFTED_AT_ONCE = 64
"""Channels of a target that `accumulate` sums in one pass over the image."""


@dataclass(frozen=True, eq=False)
class Rendering:
    """A rendered view.

    color: (H, W, 3) sRGB over the background; alpha: (H, W) in [0, 1); weighted_depth: (H, W) Σ α T z in scene units;
    features: (H, W, C) Σ α T f, not divided by alpha; radii: (N,) px half the larger side of the box in which each
    Gaussian was drawn, 0 if it was not drawn; empty if a graphics card drew it.
    """

    color: Tensor
    alpha: Tensor
    weighted_depth: Tensor
    features: Tensor | None
    radii: Tensor

    @property
    def depth(self) -> Tensor:
        """(H, W) expected distance along the viewing direction in scene units; 0 if nothing is drawn."""
        return self.weighted_depth / self.alpha.clamp_min(1e-6)


@dataclass(frozen=True, eq=False)
class Accumulated:
    """Sums over one view's pixels: sums (N, D) Σ α_i T_i · target, weights (N,) Σ α_i T_i."""

    sums: Tensor
    weights: Tensor


class _Render(torch.autograd.Function):
    """Projection and blending as one autograd function."""

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
        rules: DrawRules,
        camera: Camera,
        mean_gradients: Tensor | None,
    ) -> tuple[Tensor, ...]:
        parameters = arrays_of(Gaussians(means, log_scales, quats, opacity_logits, sh))
        workspace = Workspace()
        tiles = tile_view(
            project_view(parameters, camera, rules, workspace, to_array(offsets)), camera, rules, workspace
        )
        planes = blend_view(tiles, to_array(features), camera, workspace)
        ctx.save_for_backward(means, log_scales, quats, opacity_logits, sh, features, background)
        ctx.tiles, ctx.planes, ctx.rules, ctx.camera, ctx.mean_gradients = tiles, planes, rules, camera, mean_gradients
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
        tiles: Tiles = ctx.tiles
        color, alpha, depth, extra, _ = grads
        planes = ctx.planes
        gradients = np.empty((5 + features.shape[1], *planes.shape[1:]), np.float32)
        for place, gradient in ((slice(0, 3), color), (3, depth), (4, alpha), (slice(5, None), extra)):
            gradients[place] = 0.0 if gradient is None else gradient.numpy()
        parameter_gradients = view_backward(
            arrays_of(Gaussians(*parameters)), ctx.camera, ctx.rules, tiles, planes, gradients, Workspace(),
            features=to_array(features), background=to_array(background),
            with_depth=depth is not None, with_mean_gradients=ctx.mean_gradients is not None,
        )  # fmt: skip
        undrawn = tiles.counts == 0
        for name in PARAMETERS:
            parameter_gradients[name][undrawn] = 0.0
        if ctx.mean_gradients is not None:
            ctx.mean_gradients.copy_(torch.from_numpy(parameter_gradients["mean_gradients"]))
        d_background = None
        if ctx.needs_input_grad[6] and color is not None:
            d_background = (color * torch.from_numpy(planes[TRANSMITTANCE])).sum((1, 2))
        *d_parameters, d_features, d_offsets = (
            torch.from_numpy(parameter_gradients[name]) for name in (*PARAMETERS, "features", "offsets")
        )
        return (*d_parameters, d_features, d_background, d_offsets, None, None, None)


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    features: Tensor | None = None,
    background: Tensor | None = None,
    sh_degree: int | None = None,
    pair_alpha: float = FAINTEST,
    literal_pairs: bool = False,
    screen_offsets: Tensor | None = None,
    screen_pulls: Tensor | None = None,
) -> Rendering:
    """Render Gaussians, with gradients to all their parameters, the features, the background and the offsets.

    features: (N, C) further channels, blended like colour; background: (3,) sRGB, black if not given; sh_degree:
    evaluate the harmonics up to this degree only; pair_alpha, literal_pairs: see `DrawRules`; screen_offsets: (N, 2) px
    added to the projected means: zeros that require a gradient receive the gradient of the projected means (3DGS
    densifies by it); screen_pulls: (N, 2) float32, filled by the backward pass with the sums over pixels of the
    absolute values of that gradient, which do not cancel (AbsGS, Ye et al. 2024).

    Pixel centres lie at +0.5. The camera must have no distortion. A splat beyond `near_plane` is drawn where its α ≥
    1/255, with 3DGS's low-pass of 0.3 px²; a pixel stops at a transmittance of 1e-4. The bytes do not depend on the
    number of threads.

    Raises:
        SceneError: the camera has distortion, or features have another length than the Gaussians.
    """
    check_camera(camera)
    n = len(gaussians)
    extra = torch.zeros(n, 0) if features is None else features
    if len(extra) != n:
        raise SceneError(f"{len(extra)} features were given for {n} Gaussians. Give one row each")
    behind = torch.zeros(3) if background is None else background
    offsets = torch.zeros(n, 2) if screen_offsets is None else screen_offsets
    rules = DrawRules(
        sh_degree=gaussians.sh_degree if sh_degree is None else min(sh_degree, gaussians.sh_degree),
        antialiased=gaussians.antialiased,
        pair_alpha=pair_alpha,
        literal_pairs=literal_pairs,
    )
    leaves = [getattr(gaussians, name) for name in PARAMETERS]
    learns = torch.is_grad_enabled() and any(each.requires_grad for each in (*leaves, extra, behind))
    if not learns and screen_offsets is None and screen_pulls is None:
        drawn = try_on_card(lambda views: views.draw(gaussians, camera, rules, to_array(extra)))
        if drawn is not None:
            return _rendering(*drawn, behind, features is not None)
    color, alpha, depth, blended, radii = _Render.apply(*leaves, extra, behind, offsets, rules, camera, screen_pulls)
    return Rendering(
        color=color.permute(1, 2, 0),
        alpha=alpha,
        weighted_depth=depth,
        features=None if features is None else blended.permute(1, 2, 0),
        radii=radii,
    )


def _rendering(
    planes: NDArray[np.float32], blended: NDArray[np.float32], background: Tensor, with_features: bool
) -> Rendering:
    """A view from the planes and features of a graphics card; radii are not known there."""
    left = torch.from_numpy(planes[TRANSMITTANCE])
    color = torch.addcmul(torch.from_numpy(planes[:3]), background.detach()[:, None, None], left[None])
    return Rendering(
        color=color.permute(1, 2, 0),
        alpha=1.0 - left,
        weighted_depth=torch.from_numpy(planes[3]),
        features=torch.from_numpy(blended).permute(1, 2, 0) if with_features else None,
        radii=torch.zeros(0),
    )


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """The front surface of a view. depth: (H, W) float32 along the viewing direction, scene units, at which half of the
    light has been stopped, NOTHING where it never is; features: (H, W, C) float32 Σ α T f.

    The mean depth Σ α T z lies behind a leaf that lets a tenth of the light through; this depth does not.
    """

    depth: NDArray[np.float32]
    features: NDArray[np.float32]


@torch.no_grad()
def draw_surface(gaussians: Gaussians, camera: Camera, features: Tensor) -> SurfaceView:
    """The front surface of a view, with further channels, features (N, C), blended like colour.

    Raises:
        SceneError: the camera has distortion.
    """
    check_camera(camera)
    rules, workspace = DrawRules(sh_degree=0, antialiased=gaussians.antialiased), Workspace()
    drawn = try_on_card(
        lambda views: (views.draw(gaussians, camera, rules, to_array(features))[1], views.surface(camera))
    )
    if drawn is not None:
        return SurfaceView(drawn[1], np.ascontiguousarray(drawn[0].transpose(1, 2, 0)))
    tiles = tile_view(project_view(arrays_of(gaussians), camera, rules, workspace), camera, rules, workspace)
    planes = blend_view(tiles, to_array(features), camera, workspace)
    depth = np.empty((camera.height, camera.width), np.float32)
    measure_surface(
        threads(), tiles.columns, tiles.order, tiles.records.reshape(-1), tiles.tile_starts, tiles.gaussian_of, depth
    )
    return SurfaceView(depth, np.ascontiguousarray(planes[CHANNELS:].transpose(1, 2, 0)))


@torch.no_grad()
def accumulate(gaussians: Gaussians, camera: Camera, target: Tensor) -> Accumulated:
    """Sum the pixel features of a view into the Gaussians that rendered them: Σ_v α_i(v) T_i(v) · target(v), and Σ_v
    α_i T_i.

    target: (H, W, D) float32 at the camera's size. The mean feature of a Gaussian is the sum over all views divided by
    the weight over all views (Marrie et al. 2024, eq. 3).

    Raises:
        SceneError: the target's size differs from the camera's, or the camera has distortion.
    """
    check_camera(camera)
    if target.ndim != 3 or tuple(target.shape[:2]) != (camera.height, camera.width):
        raise SceneError(
            f"The target is {tuple(target.shape)}. Its first two sizes must be the camera's"
            f" ({camera.height}, {camera.width})"
        )
    n, channels = len(gaussians), target.shape[2]
    rules, workspace = DrawRules(sh_degree=0, antialiased=gaussians.antialiased), Workspace()
    lifted = try_on_card(lambda views: views.accumulate(gaussians, camera, rules, to_array(target)))
    if lifted is not None:
        return Accumulated(*map(torch.from_numpy, lifted))
    tiles = tile_view(project_view(arrays_of(gaussians), camera, rules, workspace), camera, rules, workspace)
    sums = np.empty((n, channels), np.float32)
    weights = np.empty(n, np.float32)
    for begin in range(0, max(channels, 1), LIFTED_AT_ONCE):
        part = to_array(target[:, :, begin : begin + LIFTED_AT_ONCE])
        columns = part.shape[2]
        padded = -(-columns // LANES) * LANES
        pairs = np.empty((tiles.pairs, padded + 1), np.float32)
        accumulate_pairs(
            threads(), tiles.columns, tiles.order, tiles.records.reshape(-1), tiles.tile_starts,
            tiles.gaussian_of, tiles.pair_of, part, pairs,
        )  # fmt: skip
        summed = np.empty((n, padded + 1), np.float32)
        sum_pairs(tiles.starts, tiles.counts, pairs, summed)
        sums[:, begin : begin + columns] = summed[:, :columns]
        weights[:] = summed[:, padded]
    return Accumulated(torch.from_numpy(sums), torch.from_numpy(weights))


@dataclass(frozen=True, eq=False)
class Load:
    """The cost of rendering a view. pixels: (H, W) Gaussians that each pixel blended (the paper's ℓ, eq. 4); tiles:
    (rows, columns) Gaussians in the list of each tile, by which tiles are scheduled."""

    pixels: NDArray[np.float32]
    tiles: NDArray[np.int64]


def measure_load(gaussians: Gaussians, camera: Camera, rules: DrawRules) -> Load:
    """The load of one view.

    Raises:
        SceneError: the camera has distortion.
    """
    check_camera(camera)
    workspace = Workspace()
    tiles = tile_view(project_view(arrays_of(gaussians), camera, rules, workspace), camera, rules, workspace)
    planes = blend_view(tiles, np.zeros((len(gaussians), 0), np.float32), camera, workspace)
    return Load(load_view(tiles, planes, workspace)[0], np.diff(tiles.tile_starts).reshape(-1, tiles.columns))


def check_camera(camera: Camera) -> None:
    """Refuse a camera with lens distortion, which is not supported."""
    if camera.distortion is not None and np.any(camera.distortion):
        raise SceneError("The camera has lens distortion. Undistort its photo first (the scene readers do)")
