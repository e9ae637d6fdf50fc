"""Sharpness of photos, compared with the photos taken just before and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

FULL_BLUR = 2.0
"""Standard deviation in pixels of the blurred copy that a photo is compared with."""
NEIGHBOURS = 4
"""Photos before, and after, that a photo is compared with."""
LEAST_SHARE = 0.5
"""A photo with a smaller share of its neighbours' sharpness is blurred. On the sample, the sharp photos have 0.90 or
more, a Gaussian blur of 1 px leaves at most 0.40, one of 2 px 0.20, and motion over 4 px 0.42."""
LEAST_SHARE_OF_ALL = 0.3
"""The same compared with the median of all photos, for a series of blurred photos."""
SOFT = 3.0
"""Sharpness below which the photos are soft as a whole: sharp ones have 8 to 13, those with a blur of 2 px about 2."""


def sharpness(grey: NDArray[np.float32]) -> float:
    """How much more contrast (H, W) neighbouring pixels have than in a blurred copy: min over d of E[(∂_d I)²] /
    E[(∂_d (G * I))²], with the four directions d of a pixel's neighbours.

    A blurred photo changes little when it is blurred again. The least of the directions shows motion blur, which
    leaves the direction across it sharp. A photo without any contrast has 0.
    """
    blurred = ndimage.gaussian_filter(grey, FULL_BLUR)
    shares = [
        _contrast(before) / max(_contrast(after), 1e-9)
        for before, after in zip(_differences(grey), _differences(blurred), strict=True)
    ]
    return float(min(shares))


def _differences(grey: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """To the right, below, and along both diagonals."""
    return [
        grey[:, 1:] - grey[:, :-1],
        grey[1:] - grey[:-1],
        grey[1:, 1:] - grey[:-1, :-1],
        grey[1:, :-1] - grey[:-1, 1:],
    ]


def _contrast(differences: NDArray[np.float32]) -> float:
    return float(np.mean(np.square(differences))) if differences.size else 0.0


def relative_sharpness(values: Sequence[float]) -> list[float]:
    """The sharpness of each photo over the median of its neighbours in order; 1.0 without neighbours."""
    shares = []
    for index, value in enumerate(values):
        near = [*values[max(0, index - NEIGHBOURS) : index], *values[index + 1 : index + 1 + NEIGHBOURS]]
        usual = float(np.median(near)) if near else 0.0
        shares.append(value / usual if usual > 0.0 else 1.0)
    return shares


def find_blurred(values: Sequence[float]) -> list[bool]:
    """Find which photos are blurred, by the sharpness of all photos in order."""
    least = LEAST_SHARE_OF_ALL * float(np.median(values)) if values else 0.0
    return [
        share < LEAST_SHARE or value < least for value, share in zip(values, relative_sharpness(values), strict=True)
    ]
