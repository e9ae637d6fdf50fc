"""Parts of a model: photos that hold together. Where parts are misplaced, few of the predicted points are found."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, minimum_spanning_tree

from ..job import LEAST_PHOTOS, Job
from ..pairs import Pair
from ..views import Observations, Views, deregister_photos
from .guided import find_near_pairs

_SURE = 0.3
"""Points that two photos share, relative to what a photo shares with its best partner (median), which need no check:
wrong links have .07."""
_LEAST_SHARED, _LEAST_SURE = 8, 0.07
"""Points that two photos must share to hold together, absolute and relative as in `_SURE`: chance finds .04 where few
are predicted, right links have .1."""
_LEAST_FOUND = 0.15
"""Share of the points of one photo inside the frame of the other that the other shows: .2 to .8 for right links, .05 to
.09 for wrong ones. The lower share of both directions counts."""
_USUAL = 0.3
"""Observations, relative to the median of all photos, that one of two photos must have: two that were misplaced
together agree."""
_LARGEST_ANGLE, _LARGEST_RATIO = 15.0, 1.25
"""Photos that must share points: the median angle in degrees between their rays to the points that both should show,
beyond which less than .3 of these are found, and the median ratio of the distances."""
_COMPARED = 31
"""Pairs of the most similar angles whose median share is the usual one."""
_LEAST_USUAL = 0.5
"""Share of found points, relative to the usual one, below which two photos contradict each other: from .58 for
right places, .29 to .45 at the open ends of a bent ring."""
_LEAST_INSIDE = 80
"""Points of one photo inside the frame of the other that are enough to judge a pair."""
_HOLDS, _STEPS = 0.7, 3
"""Share of found points, relative to the usual one, from which two photos hold together; and so many such pairs, one
after the other, from one photo to another show that both are placed rightly: leaves may hide what the two could share.
The ends of a bent ring are many pairs apart."""


def keep_largest_part(job: Job, model: Any) -> Any:
    """Return the model without the photos outside its largest part; with all of them if too few would remain."""
    views = Views.of(job, model)
    seen = views.observations()
    shared = seen.count_shared(len(views.images))
    if not shared.any():
        return model
    best = float(np.median(shared.max(axis=1)))
    least = max(_LEAST_SURE * best, _LEAST_SHARED)
    linked = shared >= max(_SURE * best, _LEAST_SHARED)
    shown = [seen.select_shown(view) for view in range(len(views.images))]
    counts = np.array([len(points) for points in shown])
    usual = counts >= _USUAL * np.median(counts)
    _, labels = connected_components(linked, directed=False)
    for i, j in zip(*np.nonzero(np.triu(shared >= least)), strict=True):
        if labels[i] != labels[j] and (usual[i] or usual[j]):
            inside = max(len(_select_framed(views, shown[i], j)), len(_select_framed(views, shown[j], i)))
            linked[i, j] = shared[i, j] >= _LEAST_FOUND * inside
    _, labels = connected_components(linked, directed=False)
    outside = np.flatnonzero(labels != np.argmax(np.bincount(labels)))
    if len(labels) - len(outside) < LEAST_PHOTOS:
        return model
    return deregister_photos(model, [views.images[position].image_id for position in outside])


def _select_framed(views: Views, points: NDArray[np.float64], photo: int) -> NDArray[np.float64]:
    """Select those of the points (N, 3) that lie inside the frame of a photo."""
    photos = np.full(len(points), photo)
    return points[views.inside(photos, views.project(photos, points))]


def keep_consistent(job: Job, model: Any) -> Any:
    """Return the model without the parts that contradict the others; as it is if less than half of it would remain.

    A ring that only one link closes may bend until its other ends do not meet. Nothing there is found, but both ends
    hold to their neighbours, so no part of it is outside. It is cut at its weakest link, and the smaller side is left
    out, to be placed again.
    """
    rest = model
    while 2 * rest.num_reg_images() >= max(model.num_reg_images(), 2 * LEAST_PHOTOS):
        views = Views.of(job, rest)
        seen = views.observations()
        shared = seen.count_shared(len(views.images))
        pair = _find_contradiction(views, seen, shared)
        if pair is None:
            return rest
        side = _side(shared, pair)
        smaller = side if 2 * np.count_nonzero(side) <= len(side) else ~side
        rest = deregister_photos(rest, [views.images[position].image_id for position in np.flatnonzero(smaller)])
    return model


def _find_contradiction(views: Views, seen: Observations, shared: NDArray[np.float64]) -> Pair | None:
    """Find the two photos of similar views that share the fewest points relative to what is usual for their angle and
    for both; None if no two share too few, besides those that a few other photos join."""
    pairs = np.array(find_near_pairs(dict(enumerate(views.images)))).reshape(-1, 2)
    shown = [seen.select_shown(view) for view in range(len(views.images))]
    both = [(_estimate_overlap(views, shown[i], i, j), _estimate_overlap(views, shown[j], j, i)) for i, j in pairs]
    inside, angle, ratio = np.array(both).reshape(-1, 2, 3).max(axis=1).T
    chosen = np.flatnonzero((angle <= _LARGEST_ANGLE) & (ratio <= _LARGEST_RATIO))
    chosen = chosen[np.argsort(angle[chosen], kind="stable")]
    one, other = pairs[chosen].T
    share = shared[one, other] / np.maximum(inside[chosen], 1.0)
    if not share.any():
        return None
    judged = inside[chosen] >= _LEAST_INSIDE
    relative = share / np.maximum(median_filter(share, _COMPARED), 1e-12)
    joined = _find_joined(pairs[chosen[judged & (relative >= _HOLDS)]], len(views.images))[one, other]
    best = np.zeros(len(views.images))  # a blurred photo shares less with all others
    np.maximum.at(best, one, relative)
    np.maximum.at(best, other, relative)
    relative /= np.clip(np.minimum(best[one], best[other]), 1e-12, 1.0)
    relative[~judged | joined] = np.inf
    worst = int(np.argmin(relative))
    return (int(one[worst]), int(other[worst])) if relative[worst] < _LEAST_USUAL else None


def _find_joined(pairs: NDArray[np.int64], photos: int) -> NDArray[np.bool_]:
    """Find (V, V) whether at most `_STEPS` of these pairs (N, 2) lead from one photo to another."""
    adjacent = csr_matrix((np.ones(len(pairs)), pairs.T), (photos, photos))
    steps = dijkstra(adjacent, directed=False, unweighted=True, limit=_STEPS)
    return np.isfinite(steps)


def _estimate_overlap(views: Views, shown: NDArray[np.float64], photo: int, other: int) -> tuple[float, float, float]:
    """Return, of the points that a photo shows inside the frame of another, how many there are, and the medians of the
    angle in degrees between the rays of both, and of the ratio of the distances, at least 1."""
    points = _select_framed(views, shown, other)
    if not len(points):
        return 0.0, np.inf, np.inf
    rays = views.centers[[photo, other], None] - points
    distances = np.linalg.norm(rays, axis=2)
    cosines = np.einsum("nk,nk->n", *rays) / distances.prod(axis=0)
    angle = np.median(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))))
    return float(len(points)), float(angle), float(np.median(distances.max(axis=0) / distances.min(axis=0)))


def _side(shared: NDArray[np.float64], pair: Pair) -> NDArray[np.bool_]:
    """(V,) the side of the first of two photos, after the weakest of the strongest links between them is cut."""
    one, other = pair
    far = np.where(shared > 0, 1.0 / np.maximum(shared, 1.0), 0.0)
    tree = minimum_spanning_tree(csr_matrix(far)).toarray()
    tree = np.maximum(tree, tree.T)
    _, before = breadth_first_order(csr_matrix(tree), one, directed=False)
    links, at = [], other
    while before[at] >= 0:
        links.append((at, before[at]))
        at = before[at]
    if links:
        i, j = max(links, key=lambda link: tree[link])
        tree[i, j] = tree[j, i] = 0.0
    _, labels = connected_components(csr_matrix(tree), directed=False)
    return labels == labels[one]
