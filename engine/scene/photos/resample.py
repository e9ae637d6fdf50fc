"""Resampling of pixel arrays: exact area averages and bilinear interpolation. Pixel centres are at +0.5."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from .lens import SourceMap

WHOLE = 0.999
"""Share of a new pixel from which all of it is usable: 1, but for rounding."""


def shrink(image: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Resize (H, W, C) to (height, width, C); each new pixel is the exact average of the area it covers."""
    if image.shape[:2] == (height, width):
        return image
    channels = image.shape[2]
    rows = _coverage(image.shape[0], height) @ image.reshape(image.shape[0], -1)
    columns = rows.reshape(height, -1, channels).transpose(1, 0, 2).reshape(image.shape[1], -1)
    averaged = _coverage(image.shape[1], width) @ columns
    return np.ascontiguousarray(averaged.reshape(width, height, channels).transpose(1, 0, 2))


def shrink_mask(mask: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
    """Resize (H, W) to (height, width); True where all of the area that a new pixel covers is."""
    return shrink(mask[..., None].astype(np.float32), width, height)[..., 0] > WHOLE


def _coverage(old: int, new: int) -> sparse.csr_array:
    """(new, old) weights: the share of each old pixel in each new one along one axis; rows sum to 1."""
    edges = np.unique(np.concatenate([np.arange(old + 1) * new, np.arange(new + 1) * old]))  # in 1 / (old * new)
    starts, lengths = edges[:-1], np.diff(edges)
    weights = (lengths / old).astype(np.float32)
    return sparse.csr_array((weights, (starts // old, starts // new)), shape=(new, old))


def look_up(image: NDArray[np.float32], source: SourceMap) -> NDArray[np.float32]:
    """Bilinear values of (H, W, C) at the pixels of the source map; 0 where it is not valid."""
    at = source.pixels.transpose(2, 0, 1)[::-1] - np.float32(0.5)
    sampled = [
        ndimage.map_coordinates(image[..., channel], at, order=1, mode="nearest", output=np.float32)
        for channel in range(image.shape[2])
    ]
    return np.stack(sampled, axis=2) * source.valid[..., None]
