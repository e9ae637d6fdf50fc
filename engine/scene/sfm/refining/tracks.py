"""Longer tracks: each point is searched in all near photos where the cameras predict it, by comparing the pictures.

SIFT finds a leaf again in two or three photos, half a pixel from its place. Patches of the pictures (least squares
matching, Gruen 1985; in all near photos, as in Furukawa and Ponce 2010) find it in five, and nearer to its place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..job import Job
from ..kernels.patches import find_patches
from ..views import Observations, Pictures, Views
from .nearness import near_photos

_LEAST_VIEWS = 3
"""Photos that a track needs: chance matches two."""
_HALF = 6
"""Half the side of a patch, in pixels of the copy."""
_LEAST_CORRELATION = 0.85
_LEAST_CONTRAST = 2.0
"""Standard deviation of the grey levels of a patch."""
_LARGEST_ANGLE = 45.0
"""Largest angle in degrees between the rays of the photos that are compared."""
_BLOCK = 4096
"""Points that are searched at a time, which bounds the memory."""


def lengthen_tracks(job: Job, model: Any, pictures: Pictures, reach: int) -> Any:
    """Return a model with the same cameras, and with the points that at least three photos show, in all photos that do.

    model: of the copies; reach: largest distance in pixels from where the cameras predict a point.
    """
    views = Views.of(job, model)
    xyz, reference, center = _choose_references(views)
    blocks = [slice(start, start + _BLOCK) for start in range(0, len(xyz), _BLOCK)]
    found = [_find_points(views, pictures, xyz[block], reference[block], center[block], reach) for block in blocks]
    point, view = (np.concatenate([np.zeros(0, np.int64)] + [each[column] for each in found]) for column in (0, 1))
    point += np.repeat([block.start for block in blocks], [len(each[0]) for each in found]).astype(np.int64)
    pixel = np.concatenate([np.zeros((0, 2))] + [each[2] for each in found])
    seen = np.bincount(point, minlength=len(xyz)) + 1 >= _LEAST_VIEWS
    own, kept = np.flatnonzero(seen), seen[point]
    return views.make_model(
        Observations(
            xyz,
            point=np.concatenate([own, point[kept]]),
            view=np.concatenate([reference[own], view[kept]]),
            pixel=np.concatenate([center[own], pixel[kept]]),
        )
    )


def _find_points(
    views: Views,
    pictures: Pictures,
    xyz: NDArray[np.float64],
    reference: NDArray[np.int64],
    center: NDArray[np.float64],
    reach: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Find the points: (M,) the point, (M,) the view and (M, 2) the pixel."""
    point, other = _find_near(views, xyz, reference)
    start = views.project(other, xyz[point])
    inside = views.inside(other, start)
    point, other, start = point[inside], other[inside], start[inside]
    found, correlation = np.empty_like(start), np.empty(len(start))
    find_patches(
        pictures, _HALF, views.pictures[reference], center, np.searchsorted(point, np.arange(len(xyz) + 1)),
        views.pictures[other], start, _affine(views, xyz[point], reference[point], other), reach, _LEAST_CONTRAST,
        found, correlation,
    )  # fmt: skip
    good = correlation > _LEAST_CORRELATION
    return point[good], other[good], found[good]


def _choose_references(views: Views) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Return for each point its place (N, 3), the view that sees it from the middle of all that do (N,), and its pixel
    there (N, 2)."""
    seen = views.observations()
    rays = views.centers[seen.view] - seen.xyz[seen.point]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    sums = np.zeros_like(seen.xyz)
    np.add.at(sums, seen.point, rays)
    nearness = np.einsum("ni,ni->n", rays, sums[seen.point])
    best = np.lexsort((seen.view, -nearness, seen.point))
    first = best[np.searchsorted(seen.point[best], np.arange(len(seen.xyz)))]
    return seen.xyz, seen.view[first], seen.pixel[first]


def _find_near(
    views: Views, xyz: NDArray[np.float64], reference: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of a point and a photo in which it is searched, ordered by point."""
    rays = views.centers[None] - xyz[:, None]
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
    rows = np.arange(len(xyz))
    cosines = np.einsum("nvk,nk->nv", rays, rays[rows, reference])
    cosines[rows, reference] = -np.inf
    return near_photos(np.where(cosines > np.cos(np.radians(_LARGEST_ANGLE)), -cosines, np.inf))


def _affine(
    views: Views, xyz: NDArray[np.float64], reference: NDArray[np.int64], other: NDArray[np.int64]
) -> NDArray[np.float64]:
    """(N, 2, 2) pixel offsets in one photo to those in another, of a small surface that faces the first."""
    depth = np.einsum("nj,nj->n", views.rotations[reference][:, 2], xyz) + views.translations[reference][:, 2]
    local = np.einsum("nij,nj->ni", views.rotations[other], xyz) + views.translations[other]
    turn = np.einsum("nij,nkj->nik", views.rotations[other], views.rotations[reference])[:, :, :2]
    moved = turn * (depth / views.focal[reference])[:, None, None]
    slope = local[:, :2] / local[:, 2:]
    result: NDArray[np.float64] = (views.focal[other] / local[:, 2])[:, None, None] * (
        moved[:, :2] - slope[:, :, None] * moved[:, None, 2]
    )
    return result
