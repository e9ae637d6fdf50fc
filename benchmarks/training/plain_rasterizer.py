"""A 3DGS rasteriser in plain PyTorch without kernels, the baseline of `scripts/benchmark.py`.

float32, autograd, vectorised over Gaussians and over the pixels of a tile; a loop over tiles. The steps and constants
are those of 3DGS (Kerbl et al. 2023): boxes of three standard deviations, one sort of (tile, depth) pairs, α below
1/255 dropped and limited to 0.99, torch's convolution for SSIM, `torch.optim.Adam` over all parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, normalize

TILE = 16
NEAR = 0.2
SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH_C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera: K (3, 3), world_to_camera (4, 4), both float32; size in pixels."""

    K: Tensor
    world_to_camera: Tensor
    width: int
    height: int

    @staticmethod
    def of(K: np.ndarray, world_to_camera: np.ndarray, width: int, height: int) -> View:
        return View(torch.from_numpy(K).float(), torch.from_numpy(world_to_camera).float(), width, height)


@dataclass(frozen=True, eq=False)
class Splats:
    """Projected Gaussians: means (N, 2) px, conics (N, 3) as xx, xy, yy, opacities (N,), colors (N, 3), depths (N,),
    radii (N,) px, 0 if not in front of the camera."""

    means: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor
    radii: Tensor


def harmonics(degree: int, d: Tensor) -> Tensor:
    """(N, (degree + 1)²) basis values of unit directions (N, 3)."""
    x, y, z = d.unbind(-1)
    rows = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        rows += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        rows += [SH_C2[0] * x * y, SH_C2[1] * y * z, SH_C2[2] * (2 * z * z - x * x - y * y)]
        rows += [SH_C2[3] * x * z, SH_C2[4] * (x * x - y * y)]
    if degree >= 3:
        rows += [SH_C3[0] * y * (3 * x * x - y * y), SH_C3[1] * x * y * z, SH_C3[2] * y * (4 * z * z - x * x - y * y)]
        rows += [SH_C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y), SH_C3[4] * x * (4 * z * z - x * x - y * y)]
        rows += [SH_C3[5] * z * (x * x - y * y), SH_C3[6] * x * (x * x - 3 * y * y)]
    return torch.stack(rows, -1)


def compute_rotations(quats: Tensor) -> Tensor:
    """Compute rotations (N, 3, 3) of quaternions wxyz of any length."""
    w, x, y, z = normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def project(parameters: Mapping[str, Tensor], view: View) -> Splats:
    """EWA projection of means (N, 3), log_scales (N, 3), quats (N, 4), opacity_logits (N,), sh (N, K, 3)."""
    R, t, K = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3], view.K
    local = parameters["means"] @ R.T + t
    x, y, depth = local.unbind(-1)
    z = depth.clamp_min(NEAR)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    u = (x / z).clamp(-0.65 * view.width / fx, 0.65 * view.width / fx)
    v = (y / z).clamp(-0.65 * view.height / fy, 0.65 * view.height / fy)
    zero = torch.zeros_like(z)
    J = torch.stack([torch.stack([fx / z, zero, -fx * u / z], -1), torch.stack([zero, fy / z, -fy * v / z], -1)], -2)
    half = J @ R @ (compute_rotations(parameters["quats"]) * parameters["log_scales"].exp()[:, None, :])
    covariance = half @ half.transpose(-1, -2)
    xx, xy, yy = covariance[:, 0, 0] + 0.3, covariance[:, 0, 1], covariance[:, 1, 1] + 0.3
    determinant = xx * yy - xy * xy
    middle = 0.5 * (xx + yy)
    radii = 3 * (middle + (middle * middle - determinant).clamp_min(0.1).sqrt()).sqrt()
    sh = parameters["sh"]
    center = -(R.T @ t)
    basis = harmonics(round(sh.shape[1] ** 0.5) - 1, normalize(parameters["means"] - center, dim=-1))
    return Splats(
        means=torch.stack([fx * x / z + cx, fy * y / z + cy], -1),
        conics=torch.stack([yy, -xy, xx], -1) / determinant[:, None],
        opacities=parameters["opacity_logits"].sigmoid(),
        colors=(0.5 + (basis[:, :, None] * sh).sum(1)).clamp_min(0.0),
        depths=depth,
        radii=torch.where(depth > NEAR, radii, zero).detach(),
    )


@torch.no_grad()
def tile_lists(splats: Splats, width: int, height: int) -> tuple[Tensor, list[int]]:
    """Gaussians of all tiles, tile by tile and nearest first, and the number of each tile."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    low = ((splats.means - splats.radii[:, None]) / TILE).floor().long()
    high = ((splats.means + splats.radii[:, None]) / TILE).floor().long() + 1
    x0, x1 = low[:, 0].clamp(0, columns), high[:, 0].clamp(0, columns)
    y0, y1 = low[:, 1].clamp(0, rows), high[:, 1].clamp(0, rows)
    counts = torch.where(splats.radii > 0, (x1 - x0) * (y1 - y0), 0)
    order = splats.depths.argsort(stable=True)
    gaussian = order.repeat_interleave(counts[order])
    starts = counts[order].cumsum(0) - counts[order]
    place = torch.arange(len(gaussian)) - starts.repeat_interleave(counts[order])
    across = (x1 - x0)[gaussian]
    tile = (y0[gaussian] + place // across) * columns + x0[gaussian] + place % across
    by_tile = tile.argsort(stable=True)
    return gaussian[by_tile], torch.bincount(tile, minlength=columns * rows).tolist()


def blend(splats: Splats, gaussian: Tensor, sizes: list[int], width: int, height: int) -> Tensor:
    """(H, W, 3) colours on black."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    y, x = torch.meshgrid(torch.arange(TILE) + 0.5, torch.arange(TILE) + 0.5, indexing="ij")
    tiles = []
    for tile, chosen in enumerate(gaussian.split(sizes)):
        if len(chosen) == 0:
            tiles.append(torch.zeros(TILE * TILE, 3))
            continue
        means, conics = splats.means[chosen], splats.conics[chosen]
        dx = (x.reshape(1, -1) + (tile % columns) * TILE) - means[:, :1]
        dy = (y.reshape(1, -1) + (tile // columns) * TILE) - means[:, 1:]
        power = -0.5 * (conics[:, :1] * dx * dx + conics[:, 2:] * dy * dy) - conics[:, 1:2] * dx * dy
        alpha = (splats.opacities[chosen, None] * power.exp()).clamp_max(0.99)
        alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
        before = torch.cat([torch.ones_like(alpha[:1]), (1 - alpha).cumprod(0)[:-1]])
        weight = torch.where(before >= 1e-4, alpha * before, 0.0)
        tiles.append(weight.T @ splats.colors[chosen])
    image = torch.stack(tiles).reshape(rows, columns, TILE, TILE, 3).transpose(1, 2)
    return image.reshape(rows * TILE, columns * TILE, 3)[:height, :width]


def loss(color: Tensor, photo: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM), 11×11 Gaussian window with σ = 1.5. color, photo: (H, W, 3) in [0, 1]."""
    line = torch.exp(-0.5 * ((torch.arange(11.0) - 5) / 1.5) ** 2)
    line = line / line.sum()
    window = torch.outer(line, line).expand(3, 1, 11, 11)
    a, b = color.permute(2, 0, 1)[None], photo.permute(2, 0, 1)[None]

    def mean(image: Tensor) -> Tensor:
        return conv2d(image, window, padding=5, groups=3)

    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    top = (2 * mean_a * mean_b + 0.01**2) * (2 * covariance + 0.03**2)
    ssim = top / ((mean_a**2 + mean_b**2 + 0.01**2) * (var_a + var_b + 0.03**2))
    return (1 - ssim_weight) * (color - photo).abs().mean() + ssim_weight * (1 - ssim.mean())


def bytes_needed(pairs: int) -> int:
    """Approximate memory of autograd for this many pairs: ten tables of one float per pixel of a tile."""
    return 10 * 4 * TILE * TILE * pairs
