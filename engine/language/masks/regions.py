"""Regions of an image that merge from small to large."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

EDGE_WEIGHT = 6.0
"""Weight of the mean step across a common border relative to the difference of the mean colours."""


class RegionGraph:
    """Regions with their mean colours, and the borders between them.

    Two regions of n and m pixels whose colours differ by d, with a mean step e across their border, merge in the order
    of n·m / (n + m) · (d + EDGE_WEIGHT·e)²: Ward's cost, so that specks merge first, with a term for edges, so that a
    shaded side joins its fruit rather than a leaf of the same shade.
    """

    def __init__(self, labels: NDArray[np.int64], colours: NDArray[np.float64]) -> None:
        """labels: (H, W) regions from 0, without gaps; colours: (H, W, 3) in which distance is difference."""
        self._first = int(labels.max()) + 1
        sizes = np.bincount(labels.ravel(), minlength=self._first)
        sums = [np.bincount(labels.ravel(), channel.ravel(), self._first) for channel in np.moveaxis(colours, -1, 0)]
        self._sizes = sizes.tolist()
        self._means = (np.stack(sums, axis=1) / sizes[:, None]).tolist()
        self._parents = list(range(self._first))
        self._borders: list[dict[int, tuple[float, int]]] = [{} for _ in range(self._first)]
        self._queue: list[tuple[float, int, int]] = []
        self._remaining = self._first
        lower, higher, steps, lengths = _borders(labels, colours)
        for a, b, step, length in zip(lower, higher, steps, lengths, strict=True):
            self._borders[a][b] = self._borders[b][a] = (step, length)
            self._queue.append((self._cost(a, b), a, b))
        heapq.heapify(self._queue)

    def merge_until(self, count: int) -> NDArray[np.int64]:
        """Merge until at most `count` regions remain (or none touch); returns the new region, from 0, of each original
        one."""
        while self._remaining > count and self._queue:
            _, a, b = heapq.heappop(self._queue)
            if self._parents[a] == a and self._parents[b] == b:
                self._merge(a, b)
        roots = np.array(self._parents)
        while (roots[roots] != roots).any():
            roots = roots[roots]
        return np.unique(roots[: self._first], return_inverse=True)[1]

    def _merge(self, a: int, b: int) -> None:
        """Replace two regions by a new one with their combined borders."""
        new, n, m = len(self._sizes), self._sizes[a], self._sizes[b]
        self._sizes.append(n + m)
        pairs = zip(self._means[a], self._means[b], strict=True)
        self._means.append([(n * mine + m * other) / (n + m) for mine, other in pairs])
        self._parents[a] = self._parents[b] = new
        self._parents.append(new)
        borders: dict[int, tuple[float, int]] = {}
        for old in (a, b):
            for other, (step, length) in self._borders[old].items():
                if other not in (a, b):
                    before = borders.get(other, (0.0, 0))
                    borders[other] = (before[0] + step, before[1] + length)
                    del self._borders[other][old]
            self._borders[old] = {}
        self._borders.append(borders)
        for other, border in borders.items():
            self._borders[other][new] = border
            heapq.heappush(self._queue, (self._cost(other, new), other, new))
        self._remaining -= 1

    def _cost(self, a: int, b: int) -> float:
        step, length = self._borders[a][b]
        (x, y, z), (u, v, w) = self._means[a], self._means[b]
        difference = ((x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2) ** 0.5 + EDGE_WEIGHT * step / length
        n, m = self._sizes[a], self._sizes[b]
        return n * m / (n + m) * difference * difference


def _borders(
    labels: NDArray[np.int64], colours: NDArray[np.float64]
) -> tuple[list[int], list[int], list[float], list[int]]:
    """Pairs of touching regions, the sum of the steps in colour across their border, and its length in pixels."""
    keys, steps = [], []
    count = int(labels.max()) + 1
    for axis in (0, 1):
        here, there = np.moveaxis(labels, axis, 0)[:-1], np.moveaxis(labels, axis, 0)[1:]
        apart = here != there
        mine, other = here[apart], there[apart]
        keys.append(np.minimum(mine, other) * count + np.maximum(mine, other))
        turned = np.moveaxis(colours, axis, 0)
        steps.append(np.linalg.norm(turned[:-1][apart] - turned[1:][apart], axis=-1))
    pairs, which = np.unique(np.concatenate(keys), return_inverse=True)
    summed = np.bincount(which, np.concatenate(steps), len(pairs))
    lengths = np.bincount(which, minlength=len(pairs))
    return (pairs // count).tolist(), (pairs % count).tolist(), summed.tolist(), lengths.tolist()
