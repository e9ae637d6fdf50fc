"""The reference implementation of the rasteriser: float64, autograd, no tiles. Slow; for tests and for reading."""

from __future__ import annotations

import torch
from torch import Tensor

from ...scene.camera import Camera
from ..gaussians import SH_C0, Gaussians
from .rasterize import Rendering
from .render import near_plane

_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
)  # fmt: skip


def harmonics(degree: int, directions: Tensor) -> Tensor:
    """(N, (degree + 1)²) real spherical harmonics of unit directions (N, 3), in 3DGS's order and signs."""
    x, y, z = directions.unbind(-1)
    rows = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        rows += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        rows += [_C2[0] * x * y, _C2[1] * y * z, _C2[2] * (2 * z * z - x * x - y * y)]
        rows += [_C2[3] * x * z, _C2[4] * (x * x - y * y)]
    if degree >= 3:
        rows += [_C3[0] * y * (3 * x * x - y * y), _C3[1] * x * y * z, _C3[2] * y * (4 * z * z - x * x - y * y)]
        rows += [_C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y), _C3[4] * x * (4 * z * z - x * x - y * y)]
        rows += [_C3[5] * z * (x * x - y * y), _C3[6] * x * (x * x - 3 * y * y)]
    return torch.stack(rows, -1)


def _ellipses(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """(N, 2) projected means in pixels, (N, 2, 2) covariances C + 0.3 I with C = J W Σ Wᵀ Jᵀ, and (N,) opacities, times
    √(det C / det(C + 0.3 I)) when antialiased."""
    K = torch.from_numpy(camera.K)
    pose = torch.from_numpy(camera.world_to_camera)
    local = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = local.unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    wide, high = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    u = (x / z).clamp(-cx / fx - wide, (camera.width - cx) / fx + wide)
    v = (y / z).clamp(-cy / fy - high, (camera.height - cy) / fy + high)
    zero = torch.zeros_like(z)
    J = torch.stack([torch.stack([fx / z, zero, -fx * u / z], -1), torch.stack([zero, fy / z, -fy * v / z], -1)], -2)
    A = J @ pose[:3, :3]
    narrow = A @ gaussians.covariances @ A.transpose(-1, -2)
    covariances = narrow + 0.3 * torch.eye(2, dtype=torch.float64)
    opacities = gaussians.opacities
    if gaussians.antialiased:
        opacities = opacities * (torch.linalg.det(narrow) / torch.linalg.det(covariances)).clamp_min(1e-12).sqrt()
    return torch.stack([fx * x / z + cx, fy * y / z + cy], -1), covariances, opacities


def blending_weights(gaussians: Gaussians, camera: Camera, offsets: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """(N', H, W) weights α_i T_i of the Gaussians in front of the camera, and (N',) their indices, nearest first."""
    pose = torch.from_numpy(camera.world_to_camera)
    depths = gaussians.means @ pose[2, :3] + pose[2, 3]
    order = depths.argsort(stable=True)
    order = order[depths[order] > near_plane(gaussians.means.detach().numpy(), camera)]
    nearest_first = gaussians.select(order)
    means, covariances, opacities = _ellipses(nearest_first, camera)
    if offsets is not None:
        means = means + offsets[order]
    y, x = torch.meshgrid(
        torch.arange(camera.height, dtype=torch.float64) + 0.5,
        torch.arange(camera.width, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    d = torch.stack([x, y], -1) - means[:, None, None, :]
    power = -0.5 * torch.einsum("nhwi,nij,nhwj->nhw", d, torch.linalg.inv(covariances), d)
    alpha = (opacities[:, None, None] * power.exp()).clamp_max(0.99)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    before = torch.cumprod(torch.cat([torch.ones_like(alpha[:1]), 1 - alpha[:-1]]), 0)
    # A stopped pixel adds nothing more; up to there the transmittance is the plain product.
    return torch.where(before >= 1e-4, alpha * before, 0.0), order


def render_reference(
    gaussians: Gaussians,
    camera: Camera,
    *,
    features: Tensor | None = None,
    background: Tensor | None = None,
    screen_offsets: Tensor | None = None,
) -> Rendering:
    """What `rasterize.render` computes, in float64 from float64 parameters; memory grows with N · H · W."""
    weights, order = blending_weights(gaussians, camera, screen_offsets)
    center = torch.from_numpy(camera.center)
    directions = torch.nn.functional.normalize(gaussians.means - center, dim=-1)
    basis = harmonics(gaussians.sh_degree, directions)
    colors = (0.5 + (basis[:, :, None] * gaussians.sh).sum(1)).clamp_min(0.0)
    pose = torch.from_numpy(camera.world_to_camera)
    depths = gaussians.means @ pose[2, :3] + pose[2, 3]
    alpha = weights.sum(0)
    color = torch.einsum("nhw,nc->hwc", weights, colors[order])
    if background is not None:
        color = color + (1 - alpha)[..., None] * background
    return Rendering(
        color=color,
        alpha=alpha,
        weighted_depth=torch.einsum("nhw,n->hw", weights, depths[order]),
        features=None if features is None else torch.einsum("nhw,nc->hwc", weights, features[order]),
        radii=torch.zeros(len(gaussians)),
    )
