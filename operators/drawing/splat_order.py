"""The order in which splats are drawn: back to front along the view."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]

FAINTEST = 1.0 / 255.0
"""Least opacity of a drawn Gaussian, as in the engine's rasteriser."""
TURNED = math.radians(0.25)
"""Rotation of a view above which splats are sorted again; moving without rotation does not change the order."""
LOOKED_AT = 10_000
NEAR, NEAR_DISTANCE = 0.2, 2.5


def select_shown(means: FloatArray, opacities: FloatArray, centre: Sequence[float], reach: float) -> NDArray[np.int64]:
    """Select the indices of the finite splats within `reach` of `centre` (object frame) that are not too faint."""
    away = means - np.asarray(centre, np.float32)
    squared = np.einsum("nk,nk->n", away, away)
    with np.errstate(over="ignore"):
        return np.flatnonzero((squared <= np.float32(min(reach, 1e18)) ** 2) & (opacities >= FAINTEST))


def sort_back_to_front(means: FloatArray, towards: Sequence[float]) -> NDArray[np.int64]:
    """Return the indices (N,) that sort means (N, 3) from the farthest to the nearest.

    towards: (3,) any vector that points from the scene to the viewer. Depths become 32-bit integers, sorted 16 bits at
    a time: NumPy sorts those by counting, three times as fast as floats. Equal ones keep their order.
    """
    depth = means @ np.asarray(towards, np.float32)
    if not len(depth):
        return np.zeros(0, np.int64)
    low, high = float(depth.min()), float(depth.max())
    if not high > low:
        return np.arange(len(depth))
    keys = ((depth.astype(np.float64) - low) * ((2**32 - 1) / (high - low))).astype(np.uint32)
    by_low = np.argsort((keys & 0xFFFF).astype(np.uint16), kind="stable")
    by_high = np.argsort((keys >> 16).astype(np.uint16)[by_low], kind="stable")
    return by_low[by_high]


def has_turned(before: Sequence[float], now: Sequence[float]) -> bool:
    """Whether two view directions differ so much that the order may change."""
    a, b = np.asarray(before, np.float64), np.asarray(now, np.float64)
    return float(np.linalg.norm(np.cross(a, b))) > math.sin(TURNED) * float(a @ a) ** 0.5 * float(b @ b) ** 0.5 or (
        float(a @ b) <= 0.0
    )


def find_near_distance(means: FloatArray, eye: Sequence[float]) -> float:
    """Find the depth up to which a perspective view draws nothing, in the object's unit, as `near_plane` of the engine
    for a camera at `eye`: about a twelfth of the distance within which it has a quarter of the Gaussians."""
    if not len(means):
        return NEAR
    away = means[:: -(-len(means) // LOOKED_AT)] - np.asarray(eye, np.float32)
    quarter = len(away) // 4
    squared = float(np.partition(np.einsum("nk,nk->n", away, away), quarter)[quarter])
    if not 0.0 < squared < math.inf:
        return NEAR
    return math.ldexp(NEAR, round(0.5 * math.log2(squared / NEAR_DISTANCE**2)))
