"""The kernel that tests spheres in a rendered view."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, prange

FloatArray = NDArray[np.float64]


@kernel
def measure_discs(
    depth: NDArray[np.float32],
    fruit: NDArray[np.float32],
    pose: FloatArray,
    K: FloatArray,
    centers: FloatArray,
    radii: FloatArray,
    disc: FloatArray,
    rim: float,
    tolerance: float,
    stop: float,
    shown: float,
    least_share: float,
    best: FloatArray,
    sums: FloatArray,
) -> None:
    """Add the evidence of one picture about C spheres; see `visibility.ViewEvidence`.

    best: (C,) visible share, -1 for none; sums: (C, 4) spots that are stopped, that are free, the probability of those
    stopped, and pictures that show at least `least_share`; disc: (S, 2) spots of the unit disc; shown: least
    probability of a spot that shows the fruit and not a leaf in front.
    """
    height, width = depth.shape
    for c in prange(len(radii)):
        radius = radii[c]
        x, y, z = pose[0, 3], pose[1, 3], pose[2, 3]
        for axis in range(3):
            x += pose[0, axis] * centers[c, axis]
            y += pose[1, axis] * centers[c, axis]
            z += pose[2, axis] * centers[c, axis]
        if z <= 2.0 * radius:
            continue
        left, right = K[0, 0] * (x - radius) / z + K[0, 2], K[0, 0] * (x + radius) / z + K[0, 2]
        upper, lower = K[1, 1] * (y - radius) / z + K[1, 2], K[1, 1] * (y + radius) / z + K[1, 2]
        if right < 0.0 or lower < 0.0 or left >= width or upper >= height:  # as most spheres of a long row
            continue
        framed, passed, seen = 0, 0, 0
        for s in range(len(disc)):
            u = K[0, 0] * (x + radius * disc[s, 0]) / z + K[0, 2]
            v = K[1, 1] * (y + radius * disc[s, 1]) / z + K[1, 2]
            if u < 0.0 or v < 0.0 or u >= width or v >= height:
                continue
            framed += 1
            row, column = int(v), int(u)
            off = disc[s, 0] ** 2 + disc[s, 1] ** 2
            chord = math.sqrt(1.0 - off)
            behind = (depth[row, column] - z) / radius
            if behind <= -chord - tolerance:
                continue
            stopped = behind < stop * chord
            passed += not stopped
            seen += stopped and fruit[row, column] >= shown
            if off < rim * rim:
                sums[c, 1] += 1.0
                if stopped:
                    sums[c, 0] += 1.0
                    sums[c, 2] += fruit[row, column]
        share = seen / max(len(disc) - passed, len(disc) / 2)
        sums[c, 3] += share >= least_share
        if 2 * framed >= len(disc) and share > best[c]:
            best[c] = share
