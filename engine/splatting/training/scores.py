"""How well Gaussians reproduce held-out photos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...scene.photos.resample import shrink, shrink_mask
from ..gaussians import Gaussians
from ..rendering.rasterize import render
from .exposure import fit_exposure
from .losses import psnr, ssim
from .photos import Picture

JUDGED_SIDE = 300
"""Longest side, pixels, to which photo and render are reduced before a reconstruction is judged. The same Gaussians
have a lower SSIM and PSNR in larger photos, which show finer leaves; the limits were chosen on photos of 300×225."""


@dataclass(frozen=True)
class ViewScore:
    """Quality of a held-out photo. psnr: dB, and ssim: at the size of the photo; reduced_psnr, reduced_ssim: of photo
    and render reduced to JUDGED_SIDE, which can be compared between photos of any size."""

    name: str
    psnr: float
    ssim: float
    reduced_psnr: float
    reduced_ssim: float


def score_view(gaussians: Gaussians, picture: Picture, name: str, *, exposure: bool) -> ViewScore:
    """The quality of a photo. exposure: whether the render first gets the exposure of the photo."""
    with torch.no_grad():
        color = render(gaussians, picture.camera).color
    if exposure:
        color = torch.from_numpy(fit_exposure(color.numpy(), picture.pixels, picture.mask))
    small = _reduce(color, picture)
    return ViewScore(
        name=name,
        psnr=psnr(color, picture.pixels, mask=picture.mask),
        ssim=ssim(color, picture.pixels, mask=picture.mask),
        reduced_psnr=psnr(small.color, small.photo, mask=small.mask),
        reduced_ssim=ssim(small.color, small.photo, mask=small.mask),
    )


@dataclass(frozen=True, eq=False)
class _Pair:
    """A render (H, W, 3) in [0, 1], its photo (H, W, 3) uint8 and the usable pixels (H, W), None for all."""

    color: Tensor
    photo: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None


def _reduce(color: Tensor, picture: Picture) -> _Pair:
    """Average render and photo over the area of larger pixels, so that no side is above JUDGED_SIDE; unchanged if no
    such pixel is usable as a whole."""
    photo, mask = picture.pixels, picture.mask
    height, width = photo.shape[:2]
    factor = JUDGED_SIDE / max(height, width)
    size = max(round(width * factor), 1), max(round(height * factor), 1)
    usable = None if mask is None or factor >= 1.0 else shrink_mask(mask, *size)
    if factor >= 1.0 or (usable is not None and not usable.any()):
        return _Pair(color, photo, mask)
    smaller = torch.from_numpy(shrink(color.clamp(0.0, 1.0).numpy(), *size))
    averaged = np.rint(shrink(photo.astype(np.float32), *size)).astype(np.uint8)
    return _Pair(smaller, averaged, usable)
