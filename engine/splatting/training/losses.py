"""The loss of 3DGS, PSNR and SSIM of a rendering against its photo."""

from __future__ import annotations

import math
from collections.abc import Hashable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..kernels.loss import SCRATCH_PLANES, l1_and_ssim, padded_size
from ..rendering.workspace import Workspace

_EVERYWHERE = np.zeros((0, 0), np.bool_)
REMEMBERED = 400 << 20
"""Bytes of window means and variances of photos that a loss keeps."""


class PhotometricLoss:
    """(1 - w) · L1 + w · (1 - SSIM), the loss of 3DGS, and its gradient.

    Both means run over the usable pixels; where the photo may not be used, SSIM windows contain the photo itself.
    Values that depend on the photo alone are cached between calls, up to a limit.
    """

    def __init__(self, ssim_weight: float, workspace: Workspace) -> None:
        self.ssim_weight = ssim_weight
        self.workspace = workspace
        self._size = (0, 0)
        self._moments: dict[Hashable, NDArray[np.float32]] = {}
        self._bytes = 0

    def backward(
        self,
        image: NDArray[np.float32],
        photo: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
        gradient: NDArray[np.float32],
        *,
        key: Hashable | None = None,
    ) -> float:
        """The loss of an image (3, H, W), sRGB, against a photo (H, W, 3); its gradient is written to (3, H, W).

        mask: (H, W) True where the photo may be used; key: identifies the photo within one loss, None to cache nothing.
        Photos stored plane by plane are read fastest.
        """
        l1, ssim_mean = self._means(image, photo, mask, gradient, key)
        return (1.0 - self.ssim_weight) * l1 + self.ssim_weight * (1.0 - ssim_mean)

    def _means(
        self,
        image: NDArray[np.float32],
        photo: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
        gradient: NDArray[np.float32],
        key: Hashable | None,
    ) -> tuple[float, float]:
        """Mean |x - y| and mean SSIM over the usable pixels."""
        height, width = photo.shape[:2]
        valid = height * width if mask is None else int(mask.sum())
        n = 3 * max(valid, 1)
        moments, known = self._photo_moments(key, (2, 3, padded_size(height, width)))
        l1_sums, ssim_sums = np.empty((2, 3, height))
        scratch = self.workspace.zeros("loss", (SCRATCH_PLANES, moments.shape[2]))
        if self._size != (height, width):  # pixels of another photo would count at the right edge
            scratch.fill(0.0)
            self._size = (height, width)
        l1_and_ssim(
            image, np.ascontiguousarray(photo.transpose(2, 0, 1)),
            _EVERYWHERE if mask is None else np.ascontiguousarray(mask),
            np.float32((1.0 - self.ssim_weight) / n), np.float32(self.ssim_weight / n), moments, known,
            scratch, gradient, l1_sums, ssim_sums,
        )  # fmt: skip
        return float(l1_sums.sum()) / n, float(ssim_sums.sum()) / n if valid else 1.0

    def _photo_moments(self, key: Hashable | None, shape: tuple[int, ...]) -> tuple[NDArray[np.float32], bool]:
        """The cache of a photo's moments, and whether it is filled."""
        kept = self._moments.get(key)
        if kept is not None and kept.shape == shape:
            return kept, True
        size = 4 * math.prod(shape)
        if key is None or self._bytes + size > REMEMBERED:
            return self.workspace.take("photo_moments", shape), False
        self._moments[key] = np.empty(shape, np.float32)
        self._bytes += size
        return self._moments[key], False


def unevenness(loads: NDArray[np.float32]) -> tuple[float, NDArray[np.float32]]:
    """Standard deviation over mean of the pixels' loads (H, W), and its gradient.

    The paper's eq. 4 minimises it: a step takes as long as its heaviest tiles.
    """
    mean, spread = float(loads.mean(dtype=np.float64)), float(loads.std(dtype=np.float64))
    if mean < 1e-9 or spread < 1e-9:
        return 0.0, np.zeros_like(loads)
    gradient = ((loads - np.float32(mean)) / np.float32(spread) - np.float32(spread / mean)) / (loads.size * mean)
    return spread / mean, gradient.astype(np.float32)


def psnr(color: Tensor, photo: NDArray[np.uint8], *, mask: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio in dB of a rendering (H, W, 3), clamped to [0, 1], over the usable pixels.

    At most 120, because an error of 0 would be infinite.
    """
    # Copies: PyTorch warns of arrays that may only be read, such as mapped photos.
    squared = (color.detach().clamp(0.0, 1.0).double() - torch.from_numpy(photo.astype(np.float64)) / 255.0) ** 2
    if mask is not None:
        squared = squared[torch.from_numpy(mask.copy())]
    error = float(squared.mean())
    return -10.0 * math.log10(max(error, 1e-12))


def ssim(color: Tensor, photo: NDArray[np.uint8], *, mask: NDArray[np.bool_] | None = None) -> float:
    """Structural similarity of a rendering (H, W, 3), clamped to [0, 1], mean over the usable pixels."""
    planes = color.detach().clamp(0.0, 1.0).float().permute(2, 0, 1).contiguous().numpy()
    return 1.0 - PhotometricLoss(1.0, Workspace()).backward(planes, photo, mask, np.empty_like(planes))
