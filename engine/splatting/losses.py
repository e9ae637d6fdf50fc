"""How far a rendering is from its photo: the loss of 3DGS, PSNR and SSIM."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .loss_kernels import l1_and_ssim

_EVERYWHERE = np.zeros((0, 0), np.bool_)


def _sums(
    color: NDArray[np.float32], photo: NDArray[np.uint8], mask: NDArray[np.bool_] | None, ssim_weight: float
) -> tuple[float, float, NDArray[np.float32]]:
    """Mean |x - y|, mean SSIM, and the gradient (3, H, W) of (1 - w) L1 + w (1 - SSIM)."""
    planes = np.ascontiguousarray(color.transpose(2, 0, 1))
    valid = photo[..., 0].size if mask is None else int(mask.sum())
    n = 3 * max(valid, 1)
    gradient = np.empty_like(planes)
    l1_sums, ssim_sums = np.empty((2, *planes.shape[:2]))
    l1_and_ssim(
        planes, np.ascontiguousarray(photo), _EVERYWHERE if mask is None else np.ascontiguousarray(mask),
        np.float32((1.0 - ssim_weight) / n), np.float32(ssim_weight / n), gradient, l1_sums, ssim_sums,
    )  # fmt: skip
    ssim_mean = float(ssim_sums.sum()) / n if valid else 1.0
    return float(l1_sums.sum()) / n, ssim_mean, gradient


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, color: Tensor, photo: NDArray[np.uint8], mask: NDArray[np.bool_] | None, ssim_weight: float
    ) -> Tensor:
        l1, ssim_mean, gradient = _sums(color.detach().numpy(), photo, mask, ssim_weight)
        ctx.gradient = gradient
        return torch.tensor((1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim_mean), dtype=torch.float64)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        gradient = torch.from_numpy(ctx.gradient.transpose(1, 2, 0))
        return gradient * grads[0].to(gradient.dtype), None, None, None


def photometric_loss(
    color: Tensor, photo: NDArray[np.uint8], *, ssim_weight: float = 0.2, mask: NDArray[np.bool_] | None = None
) -> Tensor:
    """(1 - w) · L1 + w · (1 - SSIM), the loss of 3DGS, with its gradient to the colour.

    color: (H, W, 3) float32 sRGB; photo: (H, W, 3) uint8; mask: (H, W) True where the photo may be used. Both means run
    over the usable pixels; SSIM windows see the photo itself where it may not be used. Float64 scalar.
    """
    return _Photometric.apply(color, photo, mask, ssim_weight)


def psnr(color: Tensor, photo: NDArray[np.uint8], *, mask: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio in dB of a rendering (H, W, 3), clamped to [0, 1], over the usable pixels."""
    squared = (color.detach().clamp(0.0, 1.0).double() - torch.from_numpy(photo).double() / 255.0) ** 2
    if mask is not None:
        squared = squared[torch.from_numpy(mask)]
    error = float(squared.mean())
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def ssim(color: Tensor, photo: NDArray[np.uint8], *, mask: NDArray[np.bool_] | None = None) -> float:
    """Structural similarity of a rendering (H, W, 3), clamped to [0, 1], mean over the usable pixels."""
    return _sums(color.detach().clamp(0.0, 1.0).numpy(), photo, mask, 1.0)[1]
