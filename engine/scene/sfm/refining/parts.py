"""Parts of a model: photos that hold together. Chance joins parts in which few of the predicted points are found."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from ..job import LEAST_PHOTOS, Job
from ..views import Observations, Views, without

_SURE = 0.3
"""Points that two photos share, relative to what a photo shares with its best partner (median), which need no check:
wrong links have .07."""
_LEAST_SHARED = 8
"""Points that two photos must share to hold together."""
_LEAST_FOUND = 0.15
"""Share of the points of one photo inside the frame of the other that the other shows: .2 to .8 for right links, .05 to
.09 for wrong ones. The lower share of both directions counts."""
_USUAL = 0.3
"""Observations, relative to the median of all photos, that one of two photos must have: two that were misplaced
together agree."""


def largest_part(job: Job, model: Any) -> Any:
    """The model without the photos outside its largest part; with all of them if too few would remain."""
    views = Views.of(job, model)
    seen = views.observations()
    shared = seen.shared(len(views.images))
    if not shared.any():
        return model
    linked = shared >= max(_SURE * float(np.median(shared.max(axis=1))), _LEAST_SHARED)
    counts = np.bincount(seen.view, minlength=len(views.images))
    usual = counts >= _USUAL * np.median(counts)
    _, labels = connected_components(linked, directed=False)
    for i, j in zip(*np.nonzero(np.triu(shared >= _LEAST_SHARED)), strict=True):
        if labels[i] != labels[j] and (usual[i] or usual[j]):
            inside = max(_inside(views, seen, i, j), _inside(views, seen, j, i))
            linked[i, j] = shared[i, j] >= _LEAST_FOUND * inside
    _, labels = connected_components(linked, directed=False)
    outside = np.flatnonzero(labels != np.argmax(np.bincount(labels)))
    if len(labels) - len(outside) < LEAST_PHOTOS:
        return model
    return without(model, [views.images[position].image_id for position in outside])


def _inside(views: Views, seen: Observations, photo: int, other: int) -> int:
    """How many points that a photo shows lie inside the frame of the other."""
    points = seen.xyz[seen.point[seen.view == photo]]
    others = np.full(len(points), other)
    return int(np.count_nonzero(views.inside(others, views.projected(others, points))))
