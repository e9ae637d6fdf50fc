"""3D Gaussians: the reconstruction that every later stage reads (paper eq. 1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..scene.alignment import Similarity

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic: colour = 0.5 + SH_C0 · sh[0]."""

PARAMETERS = ("means", "log_scales", "quats", "opacity_logits", "sh")
"""The tensors of `Gaussians`, which training changes."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N anisotropic Gaussians in the scene's frame, float32.

    means: (N, 3) scene units; log_scales: (N, 3) natural logarithm of the standard deviations along the own axes;
    quats: (N, 4) rotation w, x, y, z, not necessarily unit; opacity_logits: (N,); sh: (N, K, 3) spherical harmonics of
    sRGB colour, K = (degree + 1)². antialiased: they were trained to fade below the size of a pixel, and are rendered
    that way (see `DrawRules`).
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    opacity_logits: Tensor
    sh: Tensor
    antialiased: bool = field(default=False, kw_only=True)

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Tensor:
        """(N, 3) standard deviations in scene units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """(N,) in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def rotations(self) -> Tensor:
        """(N, 3, 3) rotation matrices whose columns are the Gaussians' own axes."""
        w, x, y, z = torch.nn.functional.normalize(self.quats, dim=-1).unbind(-1)
        rows = [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ]
        return torch.stack(rows, -2)

    @property
    def covariances(self) -> Tensor:
        """(N, 3, 3) R diag(σ²) Rᵀ in squared scene units (paper eq. 1)."""
        axes = self.rotations * self.scales[:, None, :]
        return axes @ axes.transpose(-1, -2)

    @property
    def base_colors(self) -> Tensor:
        """(N, 3) sRGB in [0, 1] without view dependence."""
        return (0.5 + SH_C0 * self.sh[:, 0]).clamp(0.0, 1.0)

    @property
    def sh_degree(self) -> int:
        return round(self.sh.shape[1] ** 0.5) - 1

    def select(self, index: Tensor) -> Gaussians:
        """The Gaussians at `index` (bool mask (N,) or integer indices)."""
        return replace(self, **{name: getattr(self, name)[index] for name in PARAMETERS})


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """Concatenate the Gaussians of all parts, which are of one degree, in their order."""
    whole: dict[str, Any] = {name: torch.cat([getattr(each, name) for each in parts]) for name in PARAMETERS}
    return replace(parts[0], **whole)


def transform_gaussians(gaussians: Gaussians, moved: Similarity) -> Gaussians:
    """Move the Gaussians to the frame that a similarity leads to, without turning the directions of their colours."""
    means = torch.from_numpy(moved.apply(gaussians.means.double().numpy())).float()
    x, y, z, w = Rotation.from_matrix(moved.rotation).as_quat()
    turn = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float32)
    return replace(
        gaussians,
        means=means,
        log_scales=gaussians.log_scales + math.log(moved.scale),
        quats=gaussians.quats @ turn.T,
    )


def make_round_gaussians(
    means: NDArray[np.float64],
    sizes: NDArray[np.float64],
    colors: NDArray[np.float64],
    *,
    opacity: float,
    sh_degree: int = 0,
) -> Gaussians:
    """Make N isotropic Gaussians. means: (N, 3) and sizes: (N,) standard deviations in scene units; colors: (N, 3)
    sRGB."""
    n = len(means)
    return Gaussians(
        means=torch.from_numpy(means).float(),
        log_scales=torch.from_numpy(np.log(sizes)).float()[:, None].repeat(1, 3),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logits=torch.full((n,), logit(opacity)),
        sh=harmonics_of(colors, sh_degree),
    )


def harmonics_of(colors: NDArray[np.float64], degree: int = 0) -> Tensor:
    """(N, (degree + 1)², 3) spherical harmonics of view-independent colours (N, 3), sRGB in [0, 1]."""
    sh = torch.zeros(len(colors), (degree + 1) ** 2, 3)
    sh[:, 0] = torch.from_numpy((colors - 0.5) / SH_C0).float()
    return sh


def logit(opacity: float) -> float:
    """The logit of this opacity in (0, 1)."""
    return math.log(opacity / (1.0 - opacity))
