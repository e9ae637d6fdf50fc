"""What the camera looks at: the whole tree, or a part of its crown if the picture is too narrow for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..config import ALONG, OrchardConfig
from ..shapes.branch import Branch
from ..species import Species

FloatArray = NDArray[np.float64]
NARROW = 0.6
"""A picture that shows less than this share of the width of a crown is narrow."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of the crown, on the side of negative y."""

    center: FloatArray
    """(3,) metres."""
    reach: float
    """Half the width of a picture there, metres."""


def frame_width(config: OrchardConfig, species: Species) -> float:
    """Width of the scene in a picture at the distance of the target, metres."""
    return config.width / config.fruit_pixels * species.diameter


def choose_part(
    rng: np.random.Generator, config: OrchardConfig, species: Species, branches: Sequence[Branch]
) -> Part | None:
    """The part of this tree's crown to look at, where twigs are dense; None: the whole tree."""
    if config.close_ups or config.aim == "tree" or config.path in ALONG or config.trees > 1:
        return None
    twigs = np.vstack([b.points[[2, -1]] for b in branches if b.generation >= 2])
    width = frame_width(config, species)
    low, high = np.percentile(twigs, [5, 95], axis=0)
    if config.aim == "auto" and width > NARROW * (high - low)[:2].max():
        return None
    middle = (low + high) / 2
    front = twigs[:, 1] < np.percentile(twigs[:, 1], 30)
    inner = (np.abs(twigs - middle) < 0.25 * (high - low))[:, [0, 2]].all(axis=1)
    places = twigs[front & inner] if (front & inner).any() else twigs
    crowd = np.array([(np.linalg.norm(twigs - p, axis=1) < 0.5 * width).sum() for p in places])
    best = places[np.argsort(-crowd, kind="stable")[: max(1, len(places) // 10)]]
    return Part(center=best[rng.integers(len(best))], reach=width / 2)
