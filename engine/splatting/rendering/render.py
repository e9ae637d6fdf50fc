"""Renders one view from plain arrays, stage by stage, and its gradients; used by `rasterize` and `train`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...compiled.blocks import BLOCK
from ...compiled.jit import threads
from ...scene.camera import Camera
from ..gaussians import PARAMETERS, Gaussians
from ..kernels.blend import blend
from ..kernels.blend_backward import blend_backward, sum_pairs
from ..kernels.load import loads_backward, measure_loads
from ..kernels.project import project
from ..kernels.project_backward import MOMENT, project_backward
from ..kernels.records import HALF_HEIGHT, HALF_WIDTH, RECORD, TILE_HEIGHT, TILE_WIDTH
from ..kernels.tile import CHANNELS
from ..kernels.tile_lists import fill_tiles, list_pairs, order_by_load, pair_starts, sort_by_depth
from .workspace import Workspace

FAINTEST = 1.0 / 255.0
"""The least α that is rendered."""
NEAR, NEAR_DISTANCE = 0.2, 2.5
"""A camera with a quarter of the Gaussians within 2.5 units renders nothing nearer than 0.2, as 3DGS (see
`near_plane`).

Nearer than that, a single stray Gaussian can hide the whole photo from a camera that training did not use.
"""
LOOKED_AT = 10_000
"""Above this number of Gaussians, every n-th determines the near plane."""
Arrays = Mapping[str, NDArray[np.float32]]
"""Parameters, or their gradients, by the field names of `Gaussians`: contiguous float32."""


def to_array(tensor: Tensor) -> NDArray[Any]:
    """Return a tensor as a contiguous array of float32 for kernels."""
    return tensor.detach().to(torch.float32).contiguous().numpy()


def arrays_of(gaussians: Gaussians) -> dict[str, NDArray[np.float32]]:
    """The parameters as arrays for kernels."""
    return {name: to_array(getattr(gaussians, name)) for name in PARAMETERS}


@dataclass(frozen=True, kw_only=True)
class DrawRules:
    """How a view is rendered.

    sh_degree: harmonics are evaluated up to it; antialiased: a Gaussian smaller than a pixel becomes fainter instead of
    larger (Mip-Splatting's 2D filter, Yu et al. 2024, eq. 10); pair_alpha: a Gaussian is listed in the tiles where its
    α reaches this (the paper's τ, eq. 3; 1/255 leaves out nothing that would be drawn); literal_pairs: list it only in
    the tile that holds its mean, as eq. 3 is printed.
    """

    sh_degree: int
    antialiased: bool = False
    pair_alpha: float = FAINTEST
    literal_pairs: bool = False


@dataclass(frozen=True, eq=False)
class Projection:
    """Gaussians as ellipses on the image: records (N, RECORD); room (N,) the most tiles each may meet."""

    records: NDArray[np.float32]
    room: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Tiles:
    """One view's ellipses and the lists of its tiles.

    records: (N, RECORD); starts: (N + 1,) where each Gaussian's pairs begin; counts: (N,) how many they are; columns:
    tiles in a row; tile_starts: (tiles + 1,); gaussian_of, pair_of: of each entry of the lists; order: (tiles,) in
    which tiles are handed out.
    """

    records: NDArray[np.float32]
    starts: NDArray[np.int64]
    counts: NDArray[np.int32]
    columns: int
    tile_starts: NDArray[np.int64]
    gaussian_of: NDArray[np.int32]
    pair_of: NDArray[np.int32]
    order: NDArray[np.int64]

    @property
    def pairs(self) -> int:
        """Capacity for pairs; a few at the end of a Gaussian's part may be unused."""
        return int(self.starts[-1])

    @property
    def radii(self) -> NDArray[np.float32]:
        """(N,) px half the larger side of the box each Gaussian was drawn in, 0 where it was not drawn."""
        larger = np.maximum(self.records[:, HALF_WIDTH], self.records[:, HALF_HEIGHT])
        return np.where(self.counts > 0, larger, np.float32(0))


def camera_values(camera: Camera) -> NDArray[np.float32]:
    """(21,) rotation row by row, translation, fx, fy, cx, cy, width, height, centre: the camera as kernels read it."""
    pose, K = camera.world_to_camera, camera.K
    values = [*pose[:3, :3].ravel(), *pose[:3, 3], K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height]
    return np.array([*values, *camera.center], dtype=np.float32)


def near_plane(means: NDArray[np.float32], camera: Camera) -> float:
    """The depth, in scene units, up to which a camera renders nothing.

    About a twelfth of the distance within which it has a quarter of the Gaussians: 0.2 × 2ᵏ for 2.5 × 2ᵏ. Powers of
    two, so that it is stable while Gaussians move and are added or removed.
    """
    if len(means) == 0:
        return NEAR
    away = means[:: -(-len(means) // LOOKED_AT)] - camera.center.astype(means.dtype)
    quarter = len(away) // 4
    squared = float(np.partition(np.einsum("nk,nk->n", away, away), quarter)[quarter])
    if not (0.0 < squared < math.inf):
        return NEAR
    return math.ldexp(NEAR, round(0.5 * math.log2(squared / NEAR_DISTANCE**2)))


def project_view(
    parameters: Arrays,
    camera: Camera,
    rules: DrawRules,
    workspace: Workspace,
    offsets: NDArray[np.float32] | None = None,
) -> Projection:
    """Gaussians → ellipses and colours. offsets: (N, 2) px added to the projected means."""
    n = len(parameters["means"])
    records = workspace.take("records", (n, RECORD))
    room = workspace.take("room", (n,), np.int32)
    project(
        threads(), *(parameters[name] for name in PARAMETERS), rules.sh_degree, rules.antialiased,
        np.zeros((0, 2), np.float32) if offsets is None else offsets, camera_values(camera),
        np.float32(near_plane(parameters["means"], camera)), np.float32(rules.pair_alpha), records, room,
    )  # fmt: skip
    return Projection(records, room)


def tile_view(projection: Projection, camera: Camera, rules: DrawRules, workspace: Workspace) -> Tiles:
    """Ellipses → the Gaussians of each tile, nearest first."""
    records, n = projection.records, len(projection.records)
    columns, rows = -(-camera.width // TILE_WIDTH), -(-camera.height // TILE_HEIGHT)
    starts = pair_starts(projection.room)
    pairs = int(starts[-1])
    tile_of = workspace.take("tile_of", (pairs,), np.int32)
    counts = workspace.take("counts", (n,), np.int32)
    list_pairs(threads(), records, starts, camera.width, camera.height, columns, rules.literal_pairs, tile_of, counts)
    tile_starts = np.empty(columns * rows + 1, np.int64)
    gaussian_of = workspace.take("gaussian_of", (pairs,), np.int32)
    pair_of = workspace.take("pair_of", (pairs,), np.int32)
    fill_tiles(sort_by_depth(records, counts), starts, counts, tile_of, tile_starts, gaussian_of, pair_of)
    order = order_by_load(tile_starts)
    return Tiles(records, starts, counts, columns, tile_starts, gaussian_of, pair_of, order)


def blend_view(
    tiles: Tiles, features: NDArray[np.float32], camera: Camera, workspace: Workspace
) -> NDArray[np.float32]:
    """(CHANNELS + C, H, W) planes: red, green, blue, Σ α T z, final transmittance, last entry that counted, features.

    features: (N, C) further channels.
    """
    planes = workspace.take("planes", (CHANNELS + features.shape[1], camera.height, camera.width))
    blend(
        threads(), tiles.columns, tiles.order, tiles.records.reshape(-1), features, tiles.tile_starts,
        tiles.gaussian_of, planes,
    )  # fmt: skip
    return planes


def load_view(tiles: Tiles, planes: NDArray[np.float32], workspace: Workspace) -> NDArray[np.float32]:
    """(2, H, W) the number of Gaussians that each pixel blended (the paper's ℓ, eq. 4), and a smooth approximation of
    it."""
    loads = workspace.take("loads", (2, *planes.shape[1:]))
    measure_loads(
        threads(), tiles.columns, tiles.order, tiles.records.reshape(-1), tiles.tile_starts, tiles.gaussian_of, planes,
        loads,
    )  # fmt: skip
    return loads


def view_backward(
    parameters: Arrays,
    camera: Camera,
    rules: DrawRules,
    tiles: Tiles,
    planes: NDArray[np.float32],
    gradients: NDArray[np.float32],
    workspace: Workspace,
    *,
    features: NDArray[np.float32],
    background: NDArray[np.float32],
    load_gradient: NDArray[np.float32] | None = None,
    with_depth: bool = True,
    with_mean_gradients: bool = True,
    features_push: bool = True,
) -> dict[str, NDArray[Any]]:
    """Gradients of a view's pixels → gradients of the parameters, by name.

    gradients: (5 + C, H, W) of red, green, blue (over `background` (3,)), Σ α T z, alpha, features; load_gradient:
    (H, W) of the pixels' loads as `load_view` gives them; with_depth: False where the gradient of Σ α T z is known to
    be 0; with_mean_gradients: False to skip `mean_gradients`, which are then 0; features_push: False if the gradient of
    the features should reach only the features, not the Gaussians.

    Besides the parameters' gradients it returns those of `features` (N, C); of the projected means as `offsets` (N, 2),
    and as `mean_gradients` (N, 2) their absolute values summed over pixels; and of the camera as `pose` (15,), see
    `poses.twist_gradient`. A row of a Gaussian that was not drawn (`tiles.counts` is 0) is 0 in `offsets`,
    `mean_gradients` and `features`, and left as it was in the others.
    """
    n, channels = features.shape
    moments = workspace.take("moments", (tiles.pairs, MOMENT))
    feature_moments = workspace.take("feature_moments", (tiles.pairs, channels))
    blend_backward(
        threads(), tiles.columns, tiles.order, tiles.records.reshape(-1), features, tiles.tile_starts,
        tiles.gaussian_of, tiles.pair_of, background, planes, gradients, with_depth, with_mean_gradients, features_push,
        moments, feature_moments,
    )  # fmt: skip
    if load_gradient is not None:
        loads_backward(
            threads(), tiles.columns, tiles.order, tiles.records.reshape(-1), tiles.tile_starts, tiles.gaussian_of,
            tiles.pair_of, planes, load_gradient, moments,
        )  # fmt: skip
    shapes: dict[str, tuple[int, ...]] = {name: values.shape for name, values in parameters.items()}
    shapes |= {"offsets": (n, 2), "mean_gradients": (n, 2), "features": (n, channels)}
    pose_sums = np.empty((-(-n // BLOCK), 15), np.float32)
    parameter_gradients: dict[str, Any] = {name: workspace.take(f"d_{name}", shape) for name, shape in shapes.items()}
    project_backward(
        threads(), *(parameters[name] for name in PARAMETERS), rules.sh_degree, rules.antialiased,
        camera_values(camera), tiles.records, tiles.starts, tiles.counts, moments,
        *(parameter_gradients[name] for name in (*PARAMETERS, "offsets", "mean_gradients")), pose_sums,
    )  # fmt: skip
    parameter_gradients["pose"] = pose_sums.sum(0, dtype=np.float64)
    if channels > 0:
        sum_pairs(tiles.starts, tiles.counts, feature_moments, parameter_gradients["features"])
    return parameter_gradients
