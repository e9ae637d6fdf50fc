"""Parts of a model: photos that hold together. Two parts that hardly any point joins were joined by chance."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ...pycolmap_import import colmap_library
from ..job import LEAST_PHOTOS

_WEAK = 0.1
"""Points that two photos share, relative to what a photo shares with its best partner (median), below which they do not
hold together. Wrong links have .06, right ones .3."""
_LEAST_SHARED = 8
"""The same as a number of points."""


def largest_part(model: Any) -> Any:
    """A copy without the photos outside the largest part; with all of them if too few would remain."""
    kept = colmap_library().Reconstruction(model)
    images = sorted(image for image in model.images if model.images[image].has_pose)
    shared = _shared(model, images)
    if not shared.any():
        return kept
    least = max(_WEAK * float(np.median(shared.max(axis=1))), _LEAST_SHARED)
    _, labels = connected_components(shared >= least, directed=False)
    largest = np.argmax(np.bincount(labels))
    if np.count_nonzero(labels == largest) >= LEAST_PHOTOS:
        for image in np.array(images)[labels != largest]:
            kept.deregister_frame(kept.images[int(image)].frame_id)
    return kept


def _shared(model: Any, images: list[int]) -> NDArray[np.int64]:
    """(P, P) the number of points that both of two photos show; 0 on the diagonal."""
    column = {image: position for position, image in enumerate(images)}
    seen = np.array(
        [
            (row, column[element.image_id])
            for row, point in enumerate(model.points3D.values())
            for element in point.track.elements
        ],
        np.int64,
    ).reshape(-1, 2)
    rows, columns = np.unique(seen, axis=0).T
    table = csr_array((np.ones(len(rows), np.int64), (rows, columns)), shape=(model.num_points3D(), len(images)))
    shared: NDArray[np.int64] = (table.T @ table).toarray()
    np.fill_diagonal(shared, 0)
    return shared
