"""The colours of places where fruit may be: one whose colour no certain fruit has is less likely a fruit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit, logit

from ...language.colours import cielab
from ...splatting.gaussians import Gaussians
from ..evidence.claims import members
from ..evidence.cluster import Search

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CERTAIN, ALIKE = 3.0, 3
"""Log odds from which a fruit is certain, and how many certain fruit of its colour a fruit needs, itself included."""
NEAR, FAR = 10.0, 20.0
"""Distance in a and b of CIELAB up to which a colour is that of a certain fruit, and from which it is surely not."""
AGAINST = 3.0
"""Log odds against a fruit whose colour is surely not that of certain ones: of a tree with 160 red apples, three of
five false ones were green and hung among leaves, and it refuses them; of four trees it refuses no true fruit."""
FEWEST, FEWEST_CERTAIN = 30, 10
"""Surface points that tell a colour, and certain fruit that tell which colours fruit have."""


def doubt_unlike(found: Search, gaussians: Gaussians) -> Search:
    """The search with less probable candidates where no certain fruit has their colour."""
    points, owners = found.surface.points.gaussians, found.found.owners
    log_odds = logit(found.probabilities)
    against = measure_unlikeness(colours_of(gaussians, points, owners, len(log_odds)), log_odds)
    return replace(found, probabilities=expit(log_odds - against))


def colours_of(gaussians: Gaussians, points: IntArray, owners: IntArray, count: int) -> FloatArray:
    """(count, 2) mean a and b in CIELAB of the surface points (P,), indices of the Gaussians they came from, that each
    place owns; owners: (P,), -1 for none. NaN where they are fewer than FEWEST."""
    found, shades = np.full((count, 2), np.nan), gaussians.base_colors.detach().cpu()
    for place, own in enumerate(members(owners, count)):
        if len(own) >= FEWEST:
            found[place] = cielab(shades[torch.from_numpy(points[own])].mean(0))[1:].double().numpy()
    return found


def measure_unlikeness(colours: FloatArray, log_odds: FloatArray) -> FloatArray:
    """Measure the log odds (C,) against the places (C,) whose colours (C, 2) lie far from those of ALIKE certain ones;
    0 where a colour is not known, and without enough certain fruit."""
    known = np.isfinite(colours).all(axis=1)
    against, certain = np.zeros(len(colours)), known & (log_odds >= CERTAIN)
    if certain.sum() < FEWEST_CERTAIN:
        return against
    distances = cKDTree(colours[certain]).query(colours[known], [ALIKE])[0][:, 0]
    against[known] = AGAINST * np.clip((distances - NEAR) / (FAR - NEAR), 0.0, 1.0)
    return against
