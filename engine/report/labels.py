"""Positions of numbers in a picture: next to the object they name, without overlaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

TURNS = 16
"""Directions from an object in which a place for its number is tried."""
RINGS = (0.0, 12.0, 28.0, 48.0, 75.0, 110.0, 150.0)
"""Pixels of a picture 1,000 high between an object and its number, nearest first."""
_OVER = 0.6
"""Cost, in rings, of covering another object completely."""
CROWD, CROWDED = 40, 0.1
"""Number of objects, and share of the area in which they lie that their texts would cover, from which only texts that
are next to their object, and cover no other, are placed: 158 numbers in front of a tree hid it."""


@dataclass(frozen=True, eq=False)
class Label:
    """A placed text.

    index: of the object it names; box: (4,) px left, top, right, bottom; tied: it is so far away that it needs a line
    to its object.
    """

    index: int
    box: FloatArray
    tied: bool

    @property
    def middle(self) -> FloatArray:
        return (self.box[:2] + self.box[2:]) / 2.0


def place_labels(
    centers: FloatArray, reaches: FloatArray, sizes: FloatArray, *, width: int, height: int, taken: FloatArray
) -> list[Label]:
    """Place texts of sizes (N, 2) px next to objects at centers (N, 2) with upright half sizes reaches (N, 2), px.

    In the order given, each gets the best free place: near, within the picture, not on another text or a `taken` box
    (B, 4), and preferably not on another object; in a crowd never on one, nor away from its own. A text without a free
    place is left out.
    """
    area = np.prod(np.ptp(centers, axis=0)) if len(centers) else 0.0
    crowded = len(centers) >= CROWD and np.prod(sizes, axis=1).sum() > CROWDED * area
    unit = height / 1000.0
    things = np.hstack([centers - reaches, centers + reaches])
    turns = 2.0 * np.pi * (np.arange(TURNS) / TURNS - 0.125)  # upper right first
    ways = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    full = np.asarray(taken, np.float64).reshape(-1, 4)
    labels = []
    for index, (center, reach, size) in enumerate(zip(centers, reaches, sizes, strict=True)):
        boxes, rings = _try_boxes(center, reach, size / 2.0, ways, unit)
        free = (boxes[:, :2] >= 0.0).all(1) & (boxes[:, 2] <= width) & (boxes[:, 3] <= height)
        free &= ~(_measure_overlap(boxes, full) > 0.0).any(1)
        covered = _measure_overlap(boxes, np.delete(things, index, axis=0)).sum(1) / np.prod(size)
        if crowded:
            free &= (rings == 0) & (covered == 0.0)
        if not free.any():
            continue
        costs = np.where(free, rings + covered / _OVER, np.inf)
        best = int(costs.argmin())
        full = np.vstack([full, boxes[best]])
        labels.append(Label(index, boxes[best], bool(rings[best] > 0)))
    return labels


def _try_boxes(
    center: FloatArray, reach: FloatArray, half: FloatArray, ways: FloatArray, unit: float
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the boxes (R·T, 4) around an object to try and the ring (R·T,) of each."""
    gaps = np.array(RINGS) * unit + unit
    # The ellipse of the object and the box of the text: diagonally they can be closer than two boxes.
    around = 1.0 / np.linalg.norm(ways / reach, axis=1)
    next_to = np.min(half / np.maximum(np.abs(ways), 1e-9), axis=1)
    distances = around + next_to
    middles = center + (distances + gaps[:, None])[..., None] * ways
    middles = middles.reshape(-1, 2)
    return np.hstack([middles - half, middles + half]), np.repeat(np.arange(len(RINGS)), len(ways))


def _measure_overlap(boxes: FloatArray, others: FloatArray) -> FloatArray:
    """Measure the area (A, B), px², that boxes (A, 4) and others (B, 4) have in common."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    return np.prod(np.maximum(high - low, 0.0), axis=2)


def round_length(most: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `most` > 0."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= most * (1.0 + 1e-9)))
