"""Kernel of PatchMatch stereo: the surface that each pixel of a photo shows, by comparing it with near photos.

A surface is a small plane, given by a vector w: the inverse depth at the ray r = (x, y, 1) of a pixel is w · r. Then
photo j shows the ray at R r + t (w · r), and a pixel tries the planes of its neighbours by copying their vectors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ....compiled.jit import kernel, njit, prange
from .patches import patch_weights, standardise

_SIDE = 9
"""Samples along a side of a patch."""
_BEST, _LEAST = 3, 2
"""A plane is as good as the mean of its highest correlations, with at most and at least this many photos: others may
not see the surface."""
_LEAST_CONTRAST = 1.5
"""Deviation of the grey levels that a patch needs."""
_STEEPEST = 0.15
"""Least cosine of the angle between a ray and the normal of the plane that it meets."""
_WORTH_TRYING = 0.3
"""Least correlation of a plane that neighbours try."""
_NEIGHBOURS = ((1, 0), (-1, 0), (0, 1), (0, -1), (3, 0), (-3, 0), (0, 3), (0, -3))
"""Rows and columns to the neighbours whose planes a pixel tries: all on the other colour of the checkerboard."""
_CHANGES = ((0.0, 1.0), (1.0, 0.0), (1.0, 1.0))
"""Random changes of its own plane that a pixel tries: of the tilt, of the depth, of both."""
_TILT, _DEPTH = 0.6, 0.03
"""Largest such changes in the first iteration: tangent of the tilt, relative depth. Each further one halves them."""

_HALF = _SIDE // 2


@njit(fastmath=False)
def _random(seed: np.uint64) -> float:
    """A number in [-1, 1) that depends on the seed only (splitmix64)."""
    bits = seed + np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    bits = bits ^ (bits >> np.uint64(31))
    return float(bits >> np.uint64(11)) * (2.0 / 9007199254740992.0) - 1.0


@njit(fastmath=False)
def _write_patch(
    picture: NDArray[np.uint8],
    column: int,
    row: int,
    step: int,
    weights: NDArray[np.float32],
    patch: NDArray[np.float32],
) -> bool:
    """Write the standardised patch around a pixel; False if it leaves the picture or is too plain."""
    reach = _HALF * step
    if min(column, row) < reach or column + reach >= picture.shape[1] or row + reach >= picture.shape[0]:
        return False
    for k in range(_SIDE * _SIDE):
        patch[k] = picture[row + (k // _SIDE - _HALF) * step, column + (k % _SIDE - _HALF) * step]
    return standardise(patch, weights) >= _LEAST_CONTRAST


@njit(fastmath=True)
def _correlation(
    picture: NDArray[np.uint8],
    x: float,
    y: float,
    slope: tuple[float, float, float, float],
    weights: NDArray[np.float32],
    patch: NDArray[np.float32],
) -> float:
    """Correlation of a standardised patch with another picture around (x, y), which counts from the middle of the first
    pixel. slope: offsets there per sample across (x, y) and down (x, y)."""
    across_x, across_y, down_x, down_y = slope
    wide, high = _HALF * (abs(across_x) + abs(down_x)), _HALF * (abs(across_y) + abs(down_y))
    if not (x >= wide and y >= high and x + wide < picture.shape[1] - 1 and y + high < picture.shape[0] - 1):
        return -1.0
    mean, square, likeness = 0.0, 0.0, 0.0
    k = 0
    for down in range(-_HALF, _HALF + 1):
        for across in range(-_HALF, _HALF + 1):
            at_x, at_y = x + across_x * across + down_x * down, y + across_y * across + down_y * down
            column, row = int(at_x), int(at_y)
            u, v = np.float32(at_x - column), np.float32(at_y - row)
            upper, lower = picture[row], picture[row + 1]
            above, below = np.float32(upper[column]), np.float32(lower[column])
            above += u * (np.float32(upper[column + 1]) - above)
            below += u * (np.float32(lower[column + 1]) - below)
            value = above + v * (below - above)
            weighted = weights[k] * value
            mean += weighted
            square += weighted * value
            likeness += weighted * patch[k]
            k += 1
    return likeness / np.sqrt(max(square - mean * mean, 1.0))


@njit(fastmath=True)
def _likeness(
    pictures: NDArray[np.uint8],
    near: NDArray[np.int64],
    rotations: NDArray[np.float64],
    translations: NDArray[np.float64],
    lenses: NDArray[np.float64],
    per_sample: float,
    x: float,
    y: float,
    plane: tuple[float, float, float],
    weights: NDArray[np.float32],
    patch: NDArray[np.float32],
    best: NDArray[np.float64],
) -> float:
    """How well a plane explains what near photos show: the mean of the highest correlations, -1 without any. best:
    scratch."""
    a, b, c = plane
    inverse = a * x + b * y + c
    if not inverse > _STEEPEST * np.sqrt((a * a + b * b + c * c) * (x * x + y * y + 1.0)):
        return -1.0
    best[:] = -1.0
    seen = 0
    for n in range(len(near)):
        turn, move, lens = rotations[n], translations[n], lenses[n]
        depth = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] + move[2] * inverse
        if depth <= 0.0:
            continue
        at_x = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] + move[0] * inverse) / depth
        at_y = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] + move[1] * inverse) / depth
        scale = lens[0] * per_sample / depth
        slope = (
            scale * (turn[0, 0] + move[0] * a - at_x * (turn[2, 0] + move[2] * a)),
            scale * (turn[1, 0] + move[1] * a - at_y * (turn[2, 0] + move[2] * a)),
            scale * (turn[0, 1] + move[0] * b - at_x * (turn[2, 1] + move[2] * b)),
            scale * (turn[1, 1] + move[1] * b - at_y * (turn[2, 1] + move[2] * b)),
        )
        bent = lens[0] * (1.0 + lens[3] * (at_x * at_x + at_y * at_y))
        pixel_x, pixel_y = bent * at_x + lens[1] - 0.5, bent * at_y + lens[2] - 0.5
        found = _correlation(pictures[near[n]], pixel_x, pixel_y, slope, weights, patch)
        seen += found > -1.0
        for k in range(_BEST):
            if found > best[k]:
                best[k], found = found, best[k]
    if seen < _LEAST:
        return -1.0
    total = 0.0
    for k in range(min(seen, _BEST)):
        total += best[k]
    return total / min(seen, _BEST)


@njit(fastmath=False)
def _perturb(
    plane: tuple[float, float, float], x: float, y: float, tilt: float, depth: float, seed: np.uint64
) -> tuple[float, float, float]:
    """Give a plane another random tilt and depth at the ray (x, y, 1)."""
    a, b, c = plane
    inverse = a * x + b * y + c
    u, v, w = _random(seed), _random(seed + np.uint64(1)), _random(seed + np.uint64(2))
    # At right angles to the ray, which leaves the depth there as it is.
    along = (u * x + v * y + w) / (x * x + y * y + 1.0)
    factor, turned = 1.0 + depth * _random(seed + np.uint64(3)), tilt * inverse
    return (
        factor * (a + turned * (u - along * x)),
        factor * (b + turned * (v - along * y)),
        factor * (c + turned * (w - along)),
    )


@kernel(fastmath=False)
def match_stereo(
    pictures: NDArray[np.uint8],
    picture: int,
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    step: int,
    rays: NDArray[np.float64],
    guesses: NDArray[np.float64],
    near: NDArray[np.int64],
    rotations: NDArray[np.float64],
    translations: NDArray[np.float64],
    lenses: NDArray[np.float64],
    focal: float,
    iterations: int,
    seed: int,
    planes: NDArray[np.float64],
    likeness: NDArray[np.float64],
) -> None:
    """PatchMatch (Bleyer et al. 2011) on a grid of W columns and H rows of a picture, on alternating colours of a
    checkerboard (Galliani et al. 2015).

    pictures: (P, h, w) grey levels; picture: the one whose pixels at `columns` (W,) and `rows` (H,) are searched; step:
    distance between the samples of a patch, in pixels; rays: (H, W, 2) of these pixels; guesses: (H, W, G) inverse
    depths to begin with; near: (V,) pictures to compare with; rotations: (V, 3, 3) and translations: (V, 3) from the
    camera of `picture` to theirs; lenses: (V, 4) their focal length, principal point and radial distortion
    (SIMPLE_RADIAL), in pixels; focal: of `picture`; seed: of the random changes. Written: planes (H, W, 3), see above;
    likeness (H, W) the mean of the highest correlations, -1 where the picture is too plain or no plane was accepted.
    """
    weights = patch_weights(_HALF).astype(np.float32)
    height, width = likeness.shape
    likeness[:] = -1.0
    for sweep in range(-1, 2 * iterations):  # the first tries the guesses
        for line in prange(height):
            row = np.int64(line)
            patch, best = np.empty(_SIDE * _SIDE, np.float32), np.empty(_BEST)
            for column in range(width):
                if sweep >= 0 and (row + column) % 2 != sweep % 2:
                    continue
                x, y = rays[row, column, 0], rays[row, column, 1]
                if not np.isfinite(x + y):  # beyond what the lens model describes
                    continue
                if not _write_patch(pictures[picture], columns[column], rows[row], step, weights, patch):
                    continue
                most = likeness[row, column]
                plane = (planes[row, column, 0], planes[row, column, 1], planes[row, column, 2])
                number = ((seed * (2 * iterations + 1) + sweep + 1) * height + row) * width + column
                tries = guesses.shape[2] if sweep < 0 else len(_NEIGHBOURS) + len(_CHANGES)
                for trial in range(tries):
                    dice = np.uint64(64 * number + 4 * trial)
                    if sweep < 0:
                        facing = guesses[row, column, trial] / (x * x + y * y + 1.0)
                        tried = _perturb((facing * x, facing * y, facing), x, y, _TILT, 0.0, dice)
                    elif trial < len(_NEIGHBOURS):
                        r, s = row + _NEIGHBOURS[trial][0], column + _NEIGHBOURS[trial][1]
                        if not (0 <= r < height and 0 <= s < width) or likeness[r, s] < _WORTH_TRYING:
                            continue
                        tried = (planes[r, s, 0], planes[r, s, 1], planes[r, s, 2])
                    else:
                        tilt, depth = _CHANGES[trial - len(_NEIGHBOURS)]
                        shrink = 0.5 ** (sweep // 2)
                        tried = _perturb(plane, x, y, tilt * _TILT * shrink, depth * _DEPTH * shrink, dice)
                    found = _likeness(
                        pictures, near, rotations, translations, lenses, step / focal, x, y, tried, weights, patch, best
                    )
                    if found > most:
                        most, plane = found, tried
                likeness[row, column] = most
                planes[row, column, 0], planes[row, column, 1], planes[row, column, 2] = plane
