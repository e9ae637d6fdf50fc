"""Parts of a model: photos that hold together. Chance joins parts in which few of the predicted points are found."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ...pycolmap_import import colmap_library
from ..job import LEAST_PHOTOS

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


def largest_part(model: Any) -> Any:
    """A copy without the photos outside the largest part; with all of them if too few would remain."""
    kept = colmap_library().Reconstruction(model)
    images = sorted(image for image in model.images if model.images[image].has_pose)
    seen = _seen(model, images)
    shared = (seen.T @ seen).toarray()
    np.fill_diagonal(shared, 0)
    if not shared.any():
        return kept
    linked = shared >= max(_SURE * float(np.median(shared.max(axis=1))), _LEAST_SHARED)
    counts = seen.sum(axis=0)
    usual = counts >= _USUAL * np.median(counts)
    _, labels = connected_components(linked, directed=False)
    for i, j in zip(*np.nonzero(np.triu(shared >= _LEAST_SHARED)), strict=True):
        if labels[i] != labels[j] and (usual[i] or usual[j]):
            inside = max(_inside(model, images, seen, i, j), _inside(model, images, seen, j, i))
            linked[i, j] = shared[i, j] >= _LEAST_FOUND * inside
    _, labels = connected_components(linked, directed=False)
    largest = np.argmax(np.bincount(labels))
    if np.count_nonzero(labels == largest) >= LEAST_PHOTOS:
        for image in np.array(images)[labels != largest]:
            kept.deregister_frame(kept.images[int(image)].frame_id)
    return kept


def _seen(model: Any, images: list[int]) -> csr_array:
    """(N, P) 1 where a photo shows a point, with the points in id order."""
    column = {image: position for position, image in enumerate(images)}
    pairs = np.array(
        [
            (row, column[element.image_id])
            for row, (_, point) in enumerate(sorted(model.points3D.items()))
            for element in point.track.elements
        ],
        np.int64,
    ).reshape(-1, 2)
    rows, columns = np.unique(pairs, axis=0).T
    return csr_array((np.ones(len(rows), np.int64), (rows, columns)), shape=(model.num_points3D(), len(images)))


def _inside(model: Any, images: list[int], seen: csr_array, photo: int, other: int) -> int:
    """How many points that a photo shows lie inside the frame of the other."""
    numbers = np.array(sorted(model.points3D))[seen[:, [photo]].nonzero()[0]]
    image = model.images[images[other]]
    camera = image.camera
    pixels = [image.project_point(model.points3D[int(number)].xyz) for number in numbers]
    return sum(0 <= p[0] < camera.width and 0 <= p[1] < camera.height for p in pixels if p is not None)
