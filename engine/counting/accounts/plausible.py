"""Which decisions of a user cannot be about one fruit of the tree: parts too far apart, absurd sizes and positions.

Every limit is a multiple of the size of fruit, so it does not depend on the units of the scene. A limit is wide: it
refuses slips of the hand, not opinions.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ...errors import CountingError

FloatArray = NDArray[np.float64]

MERGE_LENGTHS = 2.0
"""Largest distance between the centres of two parts of a fruit, in lengths of the largest or in usual diameters."""
SIZE_RATIO = 5.0
"""Largest ratio between the diameter of a fruit that the user made or scaled, and the usual one, either way."""
REACH_EXTENTS = 3.0
"""Largest distance of a fruit that the user made or moved from the middle of the cameras, in the cameras' reach."""


def check_merge(ids: Sequence[int], centers: FloatArray, lengths: FloatArray, usual: float) -> None:
    """Refuse to merge fruit that cannot be parts of one.

    centers, lengths: (P, 3) and (P,) of the parts; usual: the usual diameter of fruit, 0 if unknown; scene units.

    Raises:
        CountingError: two of them are too far apart.
    """
    length = max(usual, float(lengths.max(initial=0.0)))
    pairs = combinations(range(len(ids)), 2)
    distances = [(float(np.linalg.norm(centers[i] - centers[j])), ids[i], ids[j]) for i, j in pairs]
    apart, first, second = max(distances, default=(0.0, 0, 0))
    if apart > MERGE_LENGTHS * length:
        raise CountingError(
            f"Fruit {first} and {second} are {apart / length:.1f} fruit lengths apart, so they are not parts of one "
            f"fruit; Merge joins parts up to {MERGE_LENGTHS:.0f} lengths apart. Use Reject for what is not a fruit"
        )


def check_size(name: str, diameter: float, usual: float) -> None:
    """Refuse a diameter that no fruit of this tree has; every one is accepted if `usual` is 0, unknown.

    Raises:
        CountingError: it is much larger or smaller than usual.
    """
    ratio = diameter / usual if usual > 0.0 else 1.0
    if not 1.0 / SIZE_RATIO <= ratio <= SIZE_RATIO:
        raise CountingError(
            f"The diameter of {name} is {ratio:.3g} times the usual one; from {1.0 / SIZE_RATIO:.1f} to "
            f"{SIZE_RATIO:.0f} times is possible. Choose another size"
        )


def check_position(name: str, center: FloatArray, cameras: FloatArray) -> None:
    """Refuse a position (3,) far from the tree; every one is accepted without cameras, (C, 3) their centres.

    Raises:
        CountingError: it is much farther from the middle of the cameras than any of them.
    """
    if len(cameras) < 2:
        return
    middle = cameras.mean(axis=0)
    reach = float(np.linalg.norm(cameras - middle, axis=1).max())
    away = float(np.linalg.norm(center - middle)) / reach if reach > 0.0 else 0.0
    if not away <= REACH_EXTENTS:
        raise CountingError(
            f"{name} is {away:.1f} times as far from the middle of the photos as the farthest photo; up to "
            f"{REACH_EXTENTS:.0f} times is possible. Choose a position on the tree"
        )
