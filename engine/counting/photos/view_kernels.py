"""The kernels that look at spheres in all views."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, njit, prange

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Views = tuple[NDArray[np.float32], NDArray[np.float32], IntArray, IntArray, FloatArray, FloatArray]
"""The arrays of `views.PhotoViews`, in their order."""

NEAREST = 4.0
"""Radii in front of a camera from which a view is used."""
LIKELY = 0.5
"""Probability of the prompt from which a pixel shows fruit."""
FRONT, BEHIND = 2.0, 3.0
"""Radii in front of the surface and behind the centre of a sphere within which a pixel that shows fruit belongs to it:
where fruit is half hidden, the depth of trained Gaussians is off by this much."""
THROUGH = 0.5
"""Radii behind the centre of a sphere from which a pixel without fruit shows what is behind the sphere."""
INNER, OUTER = 0.75, 1.3
"""Radii inside and outside of the outline between which fruit must end."""
FRAMED = 0.5
"""Share of the disc that a view must frame to be chosen."""
SHOWS = 0.15
"""Share of the disc with fruit from which a view shows the sphere."""
SPECK = 0.075
"""Share of the disc with fruit below which a view shows nothing of the sphere, but may show what is behind."""
LEAST_RANK = 0.08
"""Rank below which a view is not chosen."""
CLOSEST_STEPS = 4
"""Most samples along each side of a cell of a crop."""
DEPTH_RANGE = 4.0
"""Depths in a crop are cut off at this many radii from the centre of the sphere."""
PROBABILITY, DEPTH, INSIDE, OTHERS = range(4)
CHANNELS = 4
"""Channels of a crop: probability of the prompt; depth relative to the sphere, in DEPTH_RANGE radii; 1 where the view
has pixels; 1 on known fruit in front of the centre of the sphere, -1 on known fruit behind it."""


@njit
def place(pose: FloatArray, lens: FloatArray, center: FloatArray) -> tuple[float, float, float]:
    """Pixel and depth of a place; the pixel is meaningless behind the camera."""
    x, y, z = pose[0, 3], pose[1, 3], pose[2, 3]
    for axis in range(3):
        x += pose[0, axis] * center[axis]
        y += pose[1, axis] * center[axis]
        z += pose[2, axis] * center[axis]
    safe = z if z > 1e-12 else 1e-12
    return lens[0] * x / safe + lens[2], lens[1] * y / safe + lens[3], z


@njit
def between(values: NDArray[np.float32], start: int, height: int, width: int, u: float, v: float) -> float:
    """The value at a place between pixel centres, -1 outside of them."""
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
def look(
    views: Views, view: int, u: float, v: float, z: float, radius: float, disc: FloatArray, rim: FloatArray
) -> tuple[float, float, float, float, float]:
    """What a view shows at a sphere: shares of its disc that the view frames, of these spots that show fruit, and that
    show what is behind; shares of the outline where fruit ends before something farther away, and where it goes on."""
    probabilities, depths, starts, sizes, _, lenses = views
    start, height, width = starts[view], sizes[view, 0], sizes[view, 1]
    pixels = lenses[view, 0] * radius / z
    framed, fruit, through, ends, goes_on = 0.0, 0.0, 0.0, 0.0, 0.0
    for s in range(len(disc)):
        x, y = u + pixels * disc[s, 0], v + pixels * disc[s, 1]
        shown = between(probabilities, start, height, width, x, y)
        if shown < 0.0:
            continue
        framed += 1.0
        depth = depths[start + int(y) * width + int(x)]
        if shown >= LIKELY:
            surface = z - radius * math.sqrt(max(1.0 - disc[s, 0] ** 2 - disc[s, 1] ** 2, 0.0))
            if depth > surface - FRONT * radius:
                fruit += 1.0 if depth < z + BEHIND * radius else 0.5
        elif depth > z + THROUGH * radius:
            through += 1.0
    for s in range(len(rim)):
        inside = between(
            probabilities, start, height, width, u + INNER * pixels * rim[s, 0], v + INNER * pixels * rim[s, 1]
        )
        x, y = u + OUTER * pixels * rim[s, 0], v + OUTER * pixels * rim[s, 1]
        outside = between(probabilities, start, height, width, x, y)
        if inside < LIKELY or outside < 0.0:
            continue
        depth = depths[start + int(y) * width + int(x)]
        if outside < LIKELY:
            ends += depth > z - THROUGH * radius
        else:
            goes_on += depth > z - radius
    spots = max(framed, 1.0)
    return framed / len(disc), fruit / spots, through / spots, ends / len(rim), goes_on / len(rim)


@njit
def visible_from(views: Views, view: int, center: FloatArray, radius: float) -> tuple[float, float, float]:
    """Pixel and depth of a sphere's centre; depth 0 if the view does not show it."""
    u, v, z = place(views[4][view], views[5][view], center)
    inside = 0.0 <= u < views[3][view, 1] and 0.0 <= v < views[3][view, 0]
    return u, v, z if inside and z > NEAREST * radius else 0.0


@kernel
def score_spheres(
    views: Views,
    centers: FloatArray,
    radius: float,
    disc: FloatArray,
    rim: FloatArray,
    weights: FloatArray,
    scores: FloatArray,
) -> None:
    """Fill scores (C,) with how well spheres of one radius explain what the views show; weights: (4,) of fruit, of its
    outline, of what is seen through and of fruit that goes on."""
    for c in prange(len(centers)):
        total = 0.0
        for view in range(len(views[2])):
            u, v, z = visible_from(views, view, centers[c], radius)
            if z <= 0.0:
                continue
            _, fruit, through, ends, goes_on = look(views, view, u, v, z, radius, disc, rim)
            total -= weights[2] * through
            if fruit >= SPECK:
                total += weights[0] * fruit + weights[1] * ends - weights[3] * goes_on
        scores[c] = total


@kernel
def choose_views(
    views: Views,
    centers: FloatArray,
    radii: FloatArray,
    disc: FloatArray,
    rim: FloatArray,
    chosen: IntArray,
    sums: FloatArray,
) -> None:
    """Fill chosen (C, K) with the views that show most of each sphere, best first, -1 where there are fewer, and sums
    (C, 5) over all views: shares of fruit, of what is seen through and of the outline, views with enough fruit, and
    views that frame the sphere."""
    for c in prange(len(centers)):
        ranks = np.full(len(views[2]), -1.0)
        for view in range(len(ranks)):
            u, v, z = visible_from(views, view, centers[c], radii[c])
            if z <= 0.0:
                continue
            framed, fruit, through, ends, _ = look(views, view, u, v, z, radii[c], disc, rim)
            if framed <= FRAMED:
                continue
            ranks[view] = fruit + 0.5 * ends + 0.1 * through
            sums[c, 0] += fruit
            sums[c, 1] += through
            sums[c, 2] += ends
            sums[c, 3] += fruit >= SHOWS
            sums[c, 4] += 1.0
        for k in range(chosen.shape[1]):
            best = -1
            for view in range(len(ranks)):
                if ranks[view] > LEAST_RANK and (best < 0 or ranks[view] > ranks[best]):
                    best = view
            chosen[c, k] = best
            if best >= 0:
                ranks[best] = -1.0


@njit
def _fill(
    views: Views, view: int, u: float, v: float, z: float, radius: float, span: float, crop: NDArray[np.float32]
) -> None:
    """Fill the channels PROBABILITY, DEPTH and INSIDE of a crop (CHANNELS, n, n)."""
    probabilities, depths, starts, sizes, _, lenses = views
    start, height, width = starts[view], sizes[view, 0], sizes[view, 1]
    cells = crop.shape[1]
    half = span * lenses[view, 0] * radius / z
    steps = int(min(max(round(2.0 * half / cells), 1.0), CLOSEST_STEPS))
    for row in range(cells):
        for column in range(cells):
            probability, depth, inside = 0.0, 0.0, 0
            for i in range(steps):
                y = v + (2.0 * (row + (i + 0.5) / steps) / cells - 1.0) * half
                for j in range(steps):
                    x = u + (2.0 * (column + (j + 0.5) / steps) / cells - 1.0) * half
                    shown = between(probabilities, start, height, width, x, y)
                    if shown < 0.0:
                        continue
                    relative = (depths[start + int(y) * width + int(x)] - z) / radius
                    inside += 1
                    probability += shown
                    depth += min(max(relative, -DEPTH_RANGE), DEPTH_RANGE) / DEPTH_RANGE
            if inside > 0:
                crop[PROBABILITY, row, column] = probability / inside
                crop[DEPTH, row, column] = depth / inside
                crop[INSIDE, row, column] = 1.0


@njit
def _cover(
    views: Views, view: int, u: float, v: float, z: float, radius: float, span: float,
    other: FloatArray, other_radius: float, crop: NDArray[np.float32],
) -> None:  # fmt: skip
    """Draw a known fruit into the channel OTHERS of a crop; one in front covers one behind."""
    x, y, depth = place(views[4][view], views[5][view], other)
    if depth < 2.0 * other_radius:
        return
    cells, scale = crop.shape[1], views[5][view, 0] * radius / z
    middle_x, middle_y, reach = (x - u) / scale, (y - v) / scale, other_radius * z / (depth * radius)
    side = 1.0 if depth < z else -1.0
    for row in range(cells):
        down = (2.0 * (row + 0.5) / cells - 1.0) * span - middle_y
        for column in range(cells):
            right = (2.0 * (column + 0.5) / cells - 1.0) * span - middle_x
            if right * right + down * down <= reach * reach and (side > 0.0 or crop[OTHERS, row, column] == 0.0):
                crop[OTHERS, row, column] = side


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
        for k in range(chosen.shape[1]):
            view = chosen[c, k]
            if view < 0:
                break
            u, v, z = place(views[4][view], views[5][view], centers[c])
            crop = crops[c, k]
            _fill(views, view, u, v, z, radii[c], span, crop)
            for m in range(near.shape[1]):
                other = near[c, m]
                if other < 0:
                    break
                _cover(views, view, u, v, z, radii[c], span, others[other], other_radii[other], crop)
