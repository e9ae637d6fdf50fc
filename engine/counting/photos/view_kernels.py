"""The kernels that look at spheres in all views."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, njit, prange

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Views = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], IntArray, IntArray, FloatArray, FloatArray]
"""The arrays of `views.PhotoViews`, in their order."""

NEAREST = 4.0
"""Radii in front of a camera from which a view is used."""
LIKELY = 0.5
"""Probability of the prompt from which a pixel shows fruit."""
BEHIND = 4.0
"""Radii behind the centre of a sphere from which a pixel that shows fruit counts half: where fruit is half hidden, the
depth of trained Gaussians is off by this much, and in front of a fruit it may be off by any amount."""
THROUGH = 0.5
"""Radii behind the centre of a sphere from which a pixel without fruit shows what is behind the sphere."""
AGREEING = 0.4
"""Radii by which the centre of a pixel's fruit may be off: half of the width of a Gaussian weight."""
BEYOND = 0.7
"""Radii by which the centre of a sphere may lie outside a view that shows the rest of it: a fruit at the edge of a
photo is often hidden in all others."""
SHOWS = 0.12
"""Share of the disc with this fruit from which a view shows the sphere."""
LEAST_RANK = 0.08
"""Rank below which a view is not chosen."""
MEASURED, LEAST_MEASURED = 1.3, 6.0
"""Radii around the centre of a sphere in which pixels tell the radius of their fruit, and the summed weight of pixels
from which a view counts."""
CLOSEST_STEPS = 4
"""Most samples along each side of a cell of a crop."""
DEPTH_RANGE = 4.0
"""Depths in a crop are cut off at this many radii from the centre of the sphere."""
LEAST_SHOWN = 0.05
"""Probability below which the offset of a pixel means nothing."""
FARTHEST_OFF = 2.0
"""Offsets in a crop are cut off at this many radii."""
PROBABILITY, DEPTH, INSIDE, OTHERS, OWN, RIGHT, DOWN = range(7)
CHANNELS = 7
"""Channels of a crop: probability of the prompt; depth relative to the sphere, in DEPTH_RANGE radii; 1 where the view
has pixels; 1 on known fruit in front of the centre of the sphere, -1 on known fruit behind it; the part of the
probability whose fruit has its centre where the sphere has it, and no known fruit has it; how far right and down of the
sphere's centre the centre of the pixel's fruit is, in FARTHEST_OFF radii, times the probability."""


@njit
def project(pose: FloatArray, lens: FloatArray, center: FloatArray) -> tuple[float, float, float]:
    """Project a place to its pixel and depth; the pixel is meaningless behind the camera."""
    x, y, z = pose[0, 3], pose[1, 3], pose[2, 3]
    for axis in range(3):
        x += pose[0, axis] * center[axis]
        y += pose[1, axis] * center[axis]
        z += pose[2, axis] * center[axis]
    safe = z if z > 1e-12 else 1e-12
    return lens[0] * x / safe + lens[2], lens[1] * y / safe + lens[3], z


@njit
def sample_bilinear(values: NDArray[np.float32], start: int, height: int, width: int, u: float, v: float) -> float:
    """Interpolate the value at a place between pixel centres; -1 outside of them."""
    x, y = u - 0.5, v - 0.5
    column, row = math.floor(x), math.floor(y)
    if column < 0 or row < 0 or column + 1 >= width or row + 1 >= height:
        return -1.0
    right, down = x - column, y - row
    at = start + row * width + column
    above = values[at] * (1.0 - right) + values[at + 1] * right
    below = values[at + width] * (1.0 - right) + values[at + width + 1] * right
    return above * (1.0 - down) + below * down


@njit
def agreement(square: float) -> float:
    """1 where the centre of a pixel's fruit is that of the sphere, less where it is off; square: of radii."""
    return math.exp(-0.5 * square / AGREEING**2)


@njit
def look(
    views: Views, view: int, u: float, v: float, z: float, radius: float, disc: FloatArray
) -> tuple[float, float, float, float]:
    """What a view shows at a sphere: the shares of its disc that the view frames, and that show fruit, fruit with this
    centre, and what is behind."""
    probabilities, offsets, depths, starts, sizes, _, lenses = views
    start, height, width = starts[view], sizes[view, 0], sizes[view, 1]
    across, along = lenses[view, 0] * radius / z, lenses[view, 1] * radius / z
    framed, fruit, own, through = 0.0, 0.0, 0.0, 0.0
    for s in range(len(disc)):
        x, y = u + across * disc[s, 0], v + along * disc[s, 1]
        shown = sample_bilinear(probabilities, start, height, width, x, y)
        if shown < 0.0:
            continue
        framed += 1.0
        at = start + int(y) * width + int(x)
        depth = depths[at]
        if shown >= LIKELY:
            weight = 1.0 if depth < z + BEHIND * radius else 0.5
            fruit += weight
            right, down = (int(x) + 0.5 - u) / across - offsets[at, 0], (int(y) + 0.5 - v) / along - offsets[at, 1]
            own += weight * agreement(right * right + down * down)
        elif depth > z + THROUGH * radius:
            through += 1.0
    spots = len(disc)
    return framed / spots, fruit / spots, own / spots, through / spots


@njit
def project_visible(views: Views, view: int, center: FloatArray, radius: float) -> tuple[float, float, float]:
    """Project a sphere's centre to its pixel and depth; depth 0 if the view does not show it."""
    u, v, z = project(views[5][view], views[6][view], center)
    if z <= NEAREST * radius:
        return u, v, 0.0
    beside, below = BEYOND * radius * views[6][view, 0] / z, BEYOND * radius * views[6][view, 1] / z
    inside = -beside <= u < views[4][view, 1] + beside and -below <= v < views[4][view, 0] + below
    return u, v, z if inside else 0.0


@kernel
def score_spheres(
    views: Views,
    centers: FloatArray,
    radius: float,
    disc: FloatArray,
    weights: FloatArray,
    scores: FloatArray,
) -> None:
    """Fill scores (C,) with how well spheres of one radius explain what the views show; weights: (3,) of a fruit with
    this centre, of other fruit, and of what is seen through."""
    for c in prange(len(centers)):
        total = 0.0
        for view in range(len(views[3])):
            u, v, z = project_visible(views, view, centers[c], radius)
            if z <= 0.0:
                continue
            _, fruit, own, through = look(views, view, u, v, z, radius, disc)
            total += weights[0] * own - weights[1] * (fruit - own) - weights[2] * through
        scores[c] = total


@kernel
def choose_views(
    views: Views,
    centers: FloatArray,
    radii: FloatArray,
    disc: FloatArray,
    chosen: IntArray,
    sums: FloatArray,
) -> None:
    """Fill chosen (C, K) with the views that show most of each sphere, best first, -1 where there are fewer, and sums
    (C, 5) over all views: shares of fruit, of what is seen through and of fruit with this centre, views with enough of
    it, and the shares that they frame."""
    for c in prange(len(centers)):
        ranks, ranked, number = np.empty(len(views[3])), np.empty(len(views[3]), np.int64), 0
        for view in range(len(views[3])):
            u, v, z = project_visible(views, view, centers[c], radii[c])
            if z <= 0.0:
                continue
            framed, fruit, own, through = look(views, view, u, v, z, radii[c], disc)
            rank = own + 0.3 * fruit + 0.1 * through
            if rank > LEAST_RANK:
                ranks[number], ranked[number] = rank, view
                number += 1
            sums[c, 0] += fruit
            sums[c, 1] += through
            sums[c, 2] += own
            sums[c, 3] += own >= SHOWS
            sums[c, 4] += framed
        for k in range(chosen.shape[1]):
            best = -1
            for place in range(number):
                if ranks[place] > LEAST_RANK and (best < 0 or ranks[place] > ranks[best]):
                    best = place
            chosen[c, k] = -1
            if best >= 0:
                chosen[c, k], ranks[best] = ranked[best], -1.0


@kernel
def measure_radii(
    views: Views,
    centers: FloatArray,
    radii: FloatArray,
    chosen: IntArray,
    blurs: FloatArray,
    sums: FloatArray,
) -> None:
    """Fill sums (C, 4) over the chosen views (C, K) of each sphere: of weights, of squared offsets from their mean, of
    their products with places in scene units, and of the former times the squared blurs (V,), in pixels, in squared
    scene units."""
    probabilities, offsets, _, starts, sizes, poses, lenses = views
    for c in prange(len(centers)):
        for k in range(chosen.shape[1]):
            view = chosen[c, k]
            if view < 0:
                break
            u, v, z = project(poses[view], lenses[view], centers[c])
            start, height, width = starts[view], sizes[view, 0], sizes[view, 1]
            across, along = lenses[view, 0] * radii[c] / z, lenses[view, 1] * radii[c] / z
            top, bottom = max(int(v - MEASURED * along), 0), min(int(v + MEASURED * along) + 1, height)
            left, right = max(int(u - MEASURED * across), 0), min(int(u + MEASURED * across) + 1, width)
            total, x_sum, y_sum, p_sum, q_sum, xp, yq, pp, qq = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for row in range(top, bottom):
                for column in range(left, right):
                    at = start + row * width + column
                    if probabilities[at] < LIKELY:
                        continue
                    x, y = (column + 0.5 - u) / across, (row + 0.5 - v) / along
                    p, q = offsets[at, 0], offsets[at, 1]
                    weight = agreement((x - p) ** 2 + (y - q) ** 2)
                    total += weight
                    x_sum, y_sum = x_sum + weight * x, y_sum + weight * y
                    p_sum, q_sum = p_sum + weight * p, q_sum + weight * q
                    xp, yq = xp + weight * x * p, yq + weight * y * q
                    pp, qq = pp + weight * p * p, qq + weight * q * q
            if total < LEAST_MEASURED:
                continue
            square = pp + qq - (p_sum * p_sum + q_sum * q_sum) / total
            product = xp + yq - (x_sum * p_sum + y_sum * q_sum) / total
            pixel = z / lenses[view, 0]
            sums[c, 0] += total
            sums[c, 1] += square
            sums[c, 2] += product * radii[c]
            sums[c, 3] += square * (blurs[view] * pixel) ** 2


@njit
def _fill(
    views: Views, view: int, u: float, v: float, z: float, radius: float, span: float,
    discs: FloatArray, known: int, crop: NDArray[np.float32],
) -> None:  # fmt: skip
    """Fill all channels of a crop (CHANNELS, n, n) but OTHERS. discs: (M, 4) of `known` fruit, see `_disc`."""
    probabilities, offsets, depths, starts, sizes, _, lenses = views
    start, height, width = starts[view], sizes[view, 0], sizes[view, 1]
    cells = crop.shape[1]
    across, along = lenses[view, 0] * radius / z, lenses[view, 1] * radius / z
    steps = int(min(max(round(2.0 * span * max(across, along) / cells), 1.0), CLOSEST_STEPS))
    for row in range(cells):
        for column in range(cells):
            probability, depth, inside, own, right, down = 0.0, 0.0, 0, 0.0, 0.0, 0.0
            for i in range(steps):
                y = v + (2.0 * (row + (i + 0.5) / steps) / cells - 1.0) * span * along
                for j in range(steps):
                    x = u + (2.0 * (column + (j + 0.5) / steps) / cells - 1.0) * span * across
                    shown = sample_bilinear(probabilities, start, height, width, x, y)
                    if shown < 0.0:
                        continue
                    at = start + int(y) * width + int(x)
                    relative = (depths[at] - z) / radius
                    inside += 1
                    probability += shown
                    depth += min(max(relative, -DEPTH_RANGE), DEPTH_RANGE) / DEPTH_RANGE
                    if shown < LEAST_SHOWN:
                        continue
                    middle_x, middle_y = (int(x) + 0.5 - u) / across, (int(y) + 0.5 - v) / along
                    off_x, off_y = middle_x - offsets[at, 0], middle_y - offsets[at, 1]
                    mine = agreement(off_x * off_x + off_y * off_y)
                    other = 0.0
                    for m in range(known):
                        x_m = (middle_x - discs[m, 0]) / discs[m, 2] - offsets[at, 0]
                        y_m = (middle_y - discs[m, 1]) / discs[m, 2] - offsets[at, 1]
                        other = max(other, agreement(x_m * x_m + y_m * y_m))
                    own += shown * mine * mine / max(mine + other, 1e-6)
                    right += shown * min(max(off_x, -FARTHEST_OFF), FARTHEST_OFF) / FARTHEST_OFF
                    down += shown * min(max(off_y, -FARTHEST_OFF), FARTHEST_OFF) / FARTHEST_OFF
            if inside > 0:
                crop[PROBABILITY, row, column] = probability / inside
                crop[DEPTH, row, column] = depth / inside
                crop[INSIDE, row, column] = 1.0
                crop[OWN, row, column] = own / inside
                crop[RIGHT, row, column] = right / inside
                crop[DOWN, row, column] = down / inside


@njit
def _disc(
    views: Views, view: int, u: float, v: float, z: float, radius: float, other: FloatArray, other_radius: float,
    disc: FloatArray,
) -> bool:  # fmt: skip
    """Fill disc (4,) with a known fruit as a crop shows it: middle and radius, in radii of the sphere, and 1 in front
    of the sphere's centre, -1 behind it; False if it is too close to the camera."""
    x, y, depth = project(views[5][view], views[6][view], other)
    across, along = views[6][view, 0] * radius / z, views[6][view, 1] * radius / z
    disc[0], disc[1], disc[2] = (x - u) / across, (y - v) / along, other_radius * z / (max(depth, 1e-12) * radius)
    disc[3] = 1.0 if depth < z else -1.0
    return depth >= 2.0 * other_radius


@njit
def _cover(disc: FloatArray, span: float, crop: NDArray[np.float32]) -> None:
    """Draw a known fruit into the channel OTHERS of a crop; one in front covers one behind."""
    cells = crop.shape[1]
    for row in range(cells):
        down = (2.0 * (row + 0.5) / cells - 1.0) * span - disc[1]
        for column in range(cells):
            right = (2.0 * (column + 0.5) / cells - 1.0) * span - disc[0]
            if right * right + down * down <= disc[2] ** 2 and (disc[3] > 0.0 or crop[OTHERS, row, column] == 0.0):
                crop[OTHERS, row, column] = disc[3]


@kernel
def cut_crops(
    views: Views,
    centers: FloatArray,
    radii: FloatArray,
    chosen: IntArray,
    others: FloatArray,
    other_radii: FloatArray,
    near: IntArray,
    span: float,
    crops: NDArray[np.float32],
) -> None:
    """Fill crops (C, K, CHANNELS, n, n), zeros before: the surroundings of C spheres, `span` radii to each side, in the
    views that were chosen (C, K), -1 for none; near: (C, M) which of the other fruit are drawn, -1 after the last."""
    for c in prange(len(centers)):
        discs = np.empty((near.shape[1], 4))
        for k in range(chosen.shape[1]):
            view = chosen[c, k]
            if view < 0:
                break
            u, v, z = project(views[5][view], views[6][view], centers[c])
            known = 0
            for m in range(near.shape[1]):
                other = near[c, m]
                if other < 0:
                    break
                if _disc(views, view, u, v, z, radii[c], others[other], other_radii[other], discs[known]):
                    _cover(discs[known], span, crops[c, k])
                    known += 1
            _fill(views, view, u, v, z, radii[c], span, discs, known, crops[c, k])
