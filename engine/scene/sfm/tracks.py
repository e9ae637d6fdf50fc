"""Longer tracks: each point is searched in all near photos where the cameras predict it, by comparing the pictures.

SIFT finds a leaf again in two or three photos, half a pixel from its place. Patches of the pictures (least squares
matching, Gruen 1985; in all near photos, as in Furukawa and Ponce 2010) find it in five, and nearer to its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..pycolmap_import import colmap_library
from .job import Job
from .patch_kernels import find_patches

_LEAST_VIEWS = 3
"""Photos that a track needs: chance matches two."""
_HALF = 6
"""Half the side of a patch, in pixels of the copy."""
_LEAST_CORRELATION = 0.85
_LEAST_CONTRAST = 2.0
"""Standard deviation of the grey levels of a patch."""
_NEAREST = 12
"""Photos in which a point is searched: those that see it from the most similar directions."""
_LARGEST_ANGLE = 45.0
"""Largest angle in degrees between the rays of the photos that are compared."""
_BLOCK = 4096
"""Points that are searched at a time, which bounds the memory."""

Pictures = NDArray[np.uint8]
"""(P, H, W) grey copies of the photos in name order; smaller ones have black borders to the right and below."""


def read_pictures(job: Job) -> Pictures:
    height = max(photo.copy_height for photo in job.photos)
    width = max(photo.copy_width for photo in job.photos)
    pictures = np.zeros((len(job.photos), height, width), np.uint8)
    for index, photo in enumerate(job.photos):
        with Image.open(job.copies / photo.copy) as image:
            pictures[index, : photo.copy_height, : photo.copy_width] = np.asarray(image.convert("L"))
    return pictures


@dataclass(frozen=True, eq=False)
class _Views:
    """The placed photos of a model, V of them.

    images: of the model, in name order; pictures: (V,) their pictures; rotations (V, 3, 3), translations (V, 3) and
    centers (V, 3): of their poses; focal: (V,) pixels; sizes: (V, 2) width and height in pixels.
    """

    model: Any
    images: Sequence[Any]
    pictures: NDArray[np.int64]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    centers: NDArray[np.float64]
    focal: NDArray[np.float64]
    sizes: NDArray[np.float64]

    @classmethod
    def of(cls, job: Job, model: Any) -> _Views:
        numbers = {photo.copy: index for index, photo in enumerate(job.photos)}
        images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
        poses = [image.cam_from_world() for image in images]
        cameras = [model.cameras[image.camera_id] for image in images]
        return cls(
            model=model,
            images=images,
            pictures=np.array([numbers[image.name] for image in images]),
            rotations=np.stack([pose.rotation.matrix() for pose in poses]),
            translations=np.stack([pose.translation for pose in poses]),
            centers=np.stack([image.projection_center() for image in images]),
            focal=np.array([camera.mean_focal_length() for camera in cameras]),
            sizes=np.array([(camera.width, camera.height) for camera in cameras], float),
        )

    def projected(self, view: NDArray[np.int64], points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) pixels of points (N, 3), each in one photo; NaN behind it."""
        local = np.einsum("nij,nj->ni", self.rotations[view], points) + self.translations[view]
        pixels = np.full((len(points), 2), np.nan)
        cameras = np.array([image.camera_id for image in self.images])[view]
        for camera in np.unique(cameras):
            chosen = (cameras == camera) & (local[:, 2] > 1e-9)
            if chosen.any():
                pixels[chosen] = np.asarray(self.model.cameras[camera].img_from_cam(local[chosen])).reshape(-1, 2)
        return pixels


def longer_tracks(job: Job, model: Any, pictures: Pictures, reach: int) -> Any:
    """A model with the same cameras, and with the points that at least three photos show, in all photos that do.

    model: of the copies; reach: largest distance in pixels from where the cameras predict a point.
    """
    views = _Views.of(job, model)
    xyz, reference, center = _references(views)
    blocks = [slice(start, start + _BLOCK) for start in range(0, len(xyz), _BLOCK)]
    found = [_found(views, pictures, xyz[block], reference[block], center[block], reach) for block in blocks]
    point, view = (np.concatenate([np.zeros(0, np.int64)] + [each[column] for each in found]) for column in (0, 1))
    point += np.repeat([block.start for block in blocks], [len(each[0]) for each in found]).astype(np.int64)
    pixel = np.concatenate([np.zeros((0, 2))] + [each[2] for each in found])
    seen = np.bincount(point, minlength=len(xyz)) + 1 >= _LEAST_VIEWS
    own, kept = np.flatnonzero(seen), seen[point]
    return _model(
        views,
        xyz,
        point=np.concatenate([own, point[kept]]),
        view=np.concatenate([reference[own], view[kept]]),
        pixel=np.concatenate([center[own], pixel[kept]]),
    )


def _found(
    views: _Views,
    pictures: Pictures,
    xyz: NDArray[np.float64],
    reference: NDArray[np.int64],
    center: NDArray[np.float64],
    reach: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Where points are found: (M,) the point, (M,) the view and (M, 2) the pixel."""
    point, other = _near(views, xyz, reference)
    start = views.projected(other, xyz[point])
    inside = ((start > 0) & (start < views.sizes[other])).all(1)
    point, other, start = point[inside], other[inside], start[inside]
    found, correlation = np.empty_like(start), np.empty(len(start))
    find_patches(
        pictures, _HALF, views.pictures[reference], center, np.searchsorted(point, np.arange(len(xyz) + 1)),
        views.pictures[other], start, _affine(views, xyz[point], reference[point], other), reach, _LEAST_CONTRAST,
        found, correlation,
    )  # fmt: skip
    good = correlation > _LEAST_CORRELATION
    return point[good], other[good], found[good]


def _references(views: _Views) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Of each point: its place (N, 3), the view that sees it from the middle of all that do (N,), and its pixel there
    (N, 2)."""
    positions = {image.image_id: position for position, image in enumerate(views.images)}
    pixels = [np.array([point.xy for point in image.points2D]).reshape(-1, 2) for image in views.images]
    before = np.cumsum([0] + [len(each) for each in pixels])
    points = [point for _, point in sorted(views.model.points3D.items())]
    xyz = np.array([point.xyz for point in points], float).reshape(-1, 3)
    elements = np.array(
        [
            (number, positions[each.image_id], each.point2D_idx)
            for number, point in enumerate(points)
            for each in point.track.elements
        ],
        np.int64,
    ).reshape(-1, 3)
    number, position, index = elements[np.lexsort((elements[:, 1], elements[:, 0]))].T
    rays = views.centers[position] - xyz[number]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    sums = np.zeros_like(xyz)
    np.add.at(sums, number, rays)
    nearness = np.einsum("ni,ni->n", rays, sums[number])
    best = np.lexsort((position, -nearness, number))
    first = best[np.searchsorted(number[best], np.arange(len(points)))]
    everything = np.concatenate([np.zeros((0, 2)), *pixels])
    return xyz, position[first], everything[before[position[first]] + index[first]]


def _near(
    views: _Views, xyz: NDArray[np.float64], reference: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a point and a photo in which it is searched, ordered by point."""
    rays = views.centers[None] - xyz[:, None]
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
    rows = np.arange(len(xyz))
    cosines = np.einsum("nvk,nk->nv", rays, rays[rows, reference])
    cosines[rows, reference] = -np.inf
    nearest = np.argsort(-cosines, axis=1, kind="stable")[:, : min(_NEAREST, len(views.images) - 1)]
    point, column = np.nonzero(np.take_along_axis(cosines, nearest, 1) > np.cos(np.radians(_LARGEST_ANGLE)))
    return point, nearest[point, column]


def _affine(
    views: _Views, xyz: NDArray[np.float64], reference: NDArray[np.int64], other: NDArray[np.int64]
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


def _model(
    views: _Views, xyz: NDArray[np.float64], *, point: NDArray[np.int64], view: NDArray[np.int64], pixel: Any
) -> Any:
    """A model of the views with these points and observations."""
    pycolmap = colmap_library()
    order = np.lexsort((view, point))
    point, view, pixel = point[order], view[order], pixel[order]
    model = pycolmap.Reconstruction()
    for number in sorted({image.camera_id for image in views.images}):
        model.add_camera_with_trivial_rig(views.model.cameras[number])
    index = np.empty(len(view), np.int64)
    for position, image in enumerate(views.images):
        mine = np.flatnonzero(view == position)
        index[mine] = np.arange(len(mine))
        copy = pycolmap.Image(
            name=image.name, keypoints=pixel[mine], camera_id=image.camera_id, image_id=image.image_id
        )
        model.add_image_with_trivial_frame(copy, image.cam_from_world())
    tracks: dict[int, Any] = {}
    for k in range(len(point)):
        track = tracks.setdefault(int(point[k]), pycolmap.Track())
        track.add_element(views.images[view[k]].image_id, int(index[k]))
    for number, track in tracks.items():
        model.add_point3D(xyz[number], track)
    return model
