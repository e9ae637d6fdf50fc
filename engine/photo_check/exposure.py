"""Changes of brightness and colour between photos of the same content."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .features import Link
from .links import Pair

WINDOW = 3
"""Photos are compared with this many following ones; those farther away may be lit from another side."""
EXPOSURE_STEP = 0.7
"""Change of brightness, in stops (factors of 2), that is a jump. Neighbours of the sample differ by at most 0.14."""
COLOUR_STEP = 0.4
"""The same for the ratio of red to blue, in factors of 2; neighbours of the sample differ by at most 0.10."""
_DARKEST = 0.002
_MOST_COLOURFUL = 4.0
"""Largest over smallest channel of the points whose colours are compared: among stronger colours, small changes of the
darkest channel look like a shift."""
_LEAST_POINTS = 10


@dataclass(frozen=True, kw_only=True)
class Change:
    """Change from one photo to another of common content: brightness and red over blue, in factors of 2."""

    exposure: float
    colour: float


def change_of(link: Link, first: NDArray[np.float32], second: NDArray[np.float32]) -> Change:
    """The median change at the matching points; (N, 3) linear colours of each photo's points."""
    before, after = first[link.first] + _DARKEST, second[link.second] + _DARKEST
    exposure = np.log2(after.mean(axis=1) / before.mean(axis=1))
    plain = before.max(axis=1) < _MOST_COLOURFUL * before.min(axis=1)
    ratios = np.log2(after[plain] / before[plain])
    shift = float(np.median(ratios[:, 0] - ratios[:, 2])) if plain.sum() >= _LEAST_POINTS else 0.0
    return Change(exposure=float(np.median(exposure)), colour=shift)


def changes(links: Mapping[Pair, Link], colors: Sequence[NDArray[np.float32]]) -> dict[Pair, Change]:
    """The changes between linked photos that are close in order."""
    return {(i, j): change_of(link, colors[i], colors[j]) for (i, j), link in links.items() if j - i <= WINDOW}


def most_involved(pairs: Sequence[Pair]) -> list[int]:
    """Few photos that all pairs include, in order: a single bright photo, not its neighbours as well."""
    left, chosen = list(pairs), []
    while left:
        counts = Counter(photo for pair in left for photo in pair)
        photo = min(counts, key=lambda each: (-counts[each], each))
        chosen.append(photo)
        left = [pair for pair in left if photo not in pair]
    return sorted(chosen)
