"""Kernel that finds small patches of one picture in another: search by correlation, then least squares matching."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ....compiled.jit import kernel, njit, prange

_ITERATIONS = 10
"""Largest number of Gauss-Newton steps."""
_SMALL_STEP = 0.02
"""Step in pixels below which the iteration ends."""
_LEAST_FOUND = 0.5
"""Correlation at whole pixels below which there is nothing to refine."""
_DRIFT = 2.0
"""Largest distance in pixels of the result from the best whole pixel."""


@njit(fastmath=False)
def patch_weights(half: int) -> NDArray[np.float64]:
    """Gaussian weights of the samples of a patch, row by row, whose sum is 1. Outside parallel kernels: there, the sum
    would depend on the number of threads."""
    side = 2 * half + 1
    weights = np.empty(side * side)
    for k in range(side * side):
        across, down = k % side - half, k // side - half
        weights[k] = np.exp(-(across * across + down * down) / (2.0 * (0.6 * half) ** 2))
    total = 0.0
    for k in range(side * side):
        total += weights[k]
    return weights / total


@njit(fastmath=False)
def _sample(picture: NDArray[np.uint8], x: float, y: float) -> float:
    """Grey level at a pixel position (the centre of the first pixel is at 0.5), linear between pixels; NaN outside."""
    x, y = x - 0.5, y - 0.5
    column, row = int(np.floor(x)), int(np.floor(y))
    if column < 0 or row < 0 or column + 1 >= picture.shape[1] or row + 1 >= picture.shape[0]:
        return np.nan
    u, v = x - column, y - row
    upper = (1.0 - u) * picture[row, column] + u * picture[row, column + 1]
    lower = (1.0 - u) * picture[row + 1, column] + u * picture[row + 1, column + 1]
    return (1.0 - v) * upper + v * lower


@njit(fastmath=False)
def standardise(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Subtract the weighted mean of the values and divide them by their deviation, which is returned."""
    mean = 0.0
    for k in range(len(values)):
        mean += weights[k] * values[k]
    variance = 0.0
    for k in range(len(values)):
        values[k] -= mean
        variance += weights[k] * values[k] ** 2
    deviation = np.sqrt(variance)
    scale = 1.0 / max(deviation, 1e-9)
    for k in range(len(values)):
        values[k] *= scale
    return deviation


@njit(fastmath=False)
def _take(
    picture: NDArray[np.uint8],
    middle: NDArray[np.float64],
    affine: NDArray[np.float64],
    x: float,
    y: float,
    half: int,
    values: NDArray[np.float64],
) -> None:
    """Sample a picture on a grid around `middle`, which the map `affine` turns, with its own middle at (x, y)."""
    side = 2 * half + 1
    for down in range(side):
        for across in range(side):
            u, v = x + (across - half), y + (down - half)
            at_x, at_y = affine[0, 0] * u + affine[0, 1] * v, affine[1, 0] * u + affine[1, 1] * v
            values[down * side + across] = _sample(picture, middle[0] + at_x, middle[1] + at_y)


@njit(fastmath=False)
def _best_shift(
    around: NDArray[np.float64], patch: NDArray[np.float64], weights: NDArray[np.float64], half: int, reach: int
) -> tuple[float, float]:
    """The whole-pixel shift of the sampled surroundings that correlates most with the patch; NaN if nothing does."""
    best, at_x, at_y = _LEAST_FOUND, np.nan, np.nan
    side, wide = 2 * half + 1, 2 * (half + reach) + 1
    for row in range(2 * reach + 1):
        for column in range(2 * reach + 1):
            likeness, mean, square = 0.0, 0.0, 0.0
            for down in range(side):
                for across in range(side):
                    k = down * side + across
                    value = around[(row + down) * wide + column + across]
                    weighted = weights[k] * value
                    mean += weighted
                    square += weighted * value
                    likeness += weighted * patch[k]
            likeness /= np.sqrt(max(square - mean * mean, 1e-12))
            if likeness > best:
                best, at_x, at_y = likeness, column - reach, row - reach
    return at_x, at_y


@njit(fastmath=False)
def _least_squares(
    target: NDArray[np.uint8],
    middle: NDArray[np.float64],
    affine: NDArray[np.float64],
    x: float,
    y: float,
    half: int,
    patch: NDArray[np.float64],
    weights: NDArray[np.float64],
    values: NDArray[np.float64],
    dx: NDArray[np.float64],
    dy: NDArray[np.float64],
    rim: NDArray[np.float64],
) -> tuple[float, float]:
    """The shift (x, y) after least squares matching; NaN where the grey levels do not determine it. The last four
    arrays are scratch."""
    side = 2 * half + 1
    size = side * side
    for _ in range(_ITERATIONS):
        _take(target, middle, affine, x, y, half + 1, rim)
        for down in range(side):
            for across in range(side):
                k, at = down * side + across, (down + 1) * (side + 2) + across + 1
                values[k], dx[k] = rim[at], (rim[at + 1] - rim[at - 1]) / 2
                dy[k] = (rim[at + side + 2] - rim[at - side - 2]) / 2
        contrast = max(standardise(values, weights), 1e-9)
        mean_x, mean_y = (weights * dx).sum(), (weights * dy).sum()
        xx, xy, yy, error_x, error_y = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(size):
            slope_x, slope_y = (dx[k] - mean_x) / contrast, (dy[k] - mean_y) / contrast
            error = weights[k] * (patch[k] - values[k])
            xx += weights[k] * slope_x * slope_x
            xy += weights[k] * slope_x * slope_y
            yy += weights[k] * slope_y * slope_y
            error_x += slope_x * error
            error_y += slope_y * error
        determinant = xx * yy - xy * xy
        if not determinant > 1e-9:
            return np.nan, np.nan
        step_x = (yy * error_x - xy * error_y) / determinant
        step_y = (xx * error_y - xy * error_x) / determinant
        length = np.hypot(step_x, step_y)
        x += step_x / max(length, 1.0)
        y += step_y / max(length, 1.0)
        if not length > _SMALL_STEP:
            break
    return x, y


@kernel(fastmath=False)
def find_patches(
    pictures: NDArray[np.uint8],
    half: int,
    reference: NDArray[np.int64],
    center: NDArray[np.float64],
    first: NDArray[np.int64],
    other: NDArray[np.int64],
    start: NDArray[np.float64],
    affine: NDArray[np.float64],
    reach: int,
    least_contrast: float,
    found: NDArray[np.float64],
    correlation: NDArray[np.float64],
) -> None:
    """Find the patches around pixels of pictures in other pictures, to a fraction of a pixel (Gruen 1985).

    pictures: (P, H, W) grey levels; half: half the side of a patch, in pixels; reference: (N,) picture of each patch;
    center: (N, 2) its middle there; first: (N + 1,) where the searches of each patch begin; other: (M,) the picture of
    each search; start: (M, 2) where the patch is expected in it; affine: (M, 2, 2) offsets in `reference` to offsets in
    `other`; reach: pixels of `reference` around `start` to search; least_contrast: deviation of grey levels that a
    patch needs. Written: found (M, 2) pixels of `other`; correlation (M,) with Gaussian weights, -1 where nothing was
    found.
    """
    side, wide = 2 * half + 1, 2 * (half + reach) + 1
    size = side * side
    weights = patch_weights(half)
    straight = np.eye(2)
    for n in prange(len(reference)):
        patch, values, dx, dy = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
        around, rim = np.empty(wide * wide), np.empty((side + 2) ** 2)
        _take(pictures[reference[n]], center[n], straight, 0.0, 0.0, half, patch)
        usable = standardise(patch, weights) > least_contrast
        for m in range(first[n], first[n + 1]):
            correlation[m] = -1.0
            if not usable:
                continue
            target = pictures[other[m]]
            _take(target, start[m], affine[m], 0.0, 0.0, half + reach, around)
            at_x, at_y = _best_shift(around, patch, weights, half, reach)
            if np.isnan(at_x):
                continue
            x, y = _least_squares(target, start[m], affine[m], at_x, at_y, half, patch, weights, values, dx, dy, rim)
            if not np.hypot(x - at_x, y - at_y) < _DRIFT:  # NaN too
                continue
            _take(target, start[m], affine[m], x, y, half, values)
            standardise(values, weights)
            likeness = (weights * patch * values).sum()
            if likeness > 0.0:
                correlation[m] = likeness
                found[m, 0] = start[m, 0] + affine[m, 0, 0] * x + affine[m, 0, 1] * y
                found[m, 1] = start[m, 1] + affine[m, 1, 0] * x + affine[m, 1, 1] * y
