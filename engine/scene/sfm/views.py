"""Placed photos as arrays: their pictures, poses and lenses, and models made of points that they show."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import csr_matrix

from ..pycolmap_import import colmap_library
from .job import Job

Pictures = NDArray[np.uint8]
"""(P, H, W) grey copies of the photos in name order; smaller ones have black borders to the right and below."""


def read_pictures(job: Job) -> Pictures:
    """The copies of all photos."""
    sizes = [(photo.copy_height, photo.copy_width) for photo in job.photos]
    return stack_pictures((read_picture(job, photo.copy) for photo in job.photos), sizes)


def read_picture(job: Job, name: str) -> Image.Image:
    """The grey copy of one photo."""
    with Image.open(job.copies / name) as image:
        return image.convert("L")


def stack_pictures(pictures: Iterable[Image.Image], sizes: Sequence[tuple[int, int]]) -> Pictures:
    """Stack the pictures, of these heights and widths, in one array."""
    stack = np.zeros((len(sizes), *np.max(sizes, axis=0)), np.uint8)
    for place, picture, (height, width) in zip(stack, pictures, sizes, strict=True):
        place[:height, :width] = np.asarray(picture)
    return stack


@dataclass(frozen=True, eq=False)
class Views:
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
    def of(cls, job: Job, model: Any) -> Views:
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

    def project(self, view: NDArray[np.int64], points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project points (N, 3), each in one photo, to pixels (N, 2); NaN behind it."""
        local = np.einsum("nij,nj->ni", self.rotations[view], points) + self.translations[view]
        pixels = np.full((len(points), 2), np.nan)
        cameras = np.array([image.camera_id for image in self.images])[view]
        for camera in np.unique(cameras):
            chosen = (cameras == camera) & (local[:, 2] > 1e-9)
            if chosen.any():
                pixels[chosen] = np.asarray(self.model.cameras[camera].img_from_cam(local[chosen])).reshape(-1, 2)
        return pixels

    def inside(self, view: NDArray[np.int64], pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(N,) whether pixels (N, 2), each of one photo, lie in it."""
        inside: NDArray[np.bool_] = ((pixels > 0) & (pixels < self.sizes[view])).all(axis=1)
        return inside

    def observations(self) -> Observations:
        """The points of the model, in id order, and where the views show them."""
        positions = {image.image_id: position for position, image in enumerate(self.images)}
        pixels = [np.array([point.xy for point in image.points2D]).reshape(-1, 2) for image in self.images]
        before = np.cumsum([0] + [len(each) for each in pixels])
        points = [point for _, point in sorted(self.model.points3D.items())]
        elements = np.array(
            [
                (number, positions[each.image_id], each.point2D_idx)
                for number, point in enumerate(points)
                for each in point.track.elements
            ],
            np.int64,
        ).reshape(-1, 3)
        point, view, index = elements[np.lexsort((elements[:, 1], elements[:, 0]))].T
        everything = np.concatenate([np.zeros((0, 2)), *pixels])
        xyz = np.array([point.xyz for point in points], float).reshape(-1, 3)
        return Observations(xyz, point=point, view=view, pixel=everything[before[view] + index])

    def make_model(self, seen: Observations) -> Any:
        """Make a model of the views with the points that they show."""
        pycolmap = colmap_library()
        order = np.lexsort((seen.view, seen.point))
        point, view, pixel = seen.point[order], seen.view[order], seen.pixel[order]
        index = np.empty(len(view), np.int64)
        photos = []
        for position, image in enumerate(self.images):
            mine = np.flatnonzero(view == position)
            index[mine] = np.arange(len(mine))
            camera = self.model.cameras[image.camera_id]
            photos.append(PlacedPhoto(image.image_id, image.name, camera, image.cam_from_world(), pixel[mine]))
        model = model_of(photos)
        starts = np.flatnonzero(np.diff(point, prepend=-1))
        for start, end in pairwise([*starts, len(point)]):
            track = pycolmap.Track()
            for k in range(start, end):
                track.add_element(self.images[view[k]].image_id, int(index[k]))
            model.add_point3D(seen.xyz[point[start]], track)
        return model


@dataclass(frozen=True, eq=False)
class Observations:
    """N points and M observations of them.

    xyz: (N, 3); point, view: (M,) which point each observation shows, and in which view; pixel: (M, 2) where.
    """

    xyz: NDArray[np.float64]
    point: NDArray[np.int64]
    view: NDArray[np.int64]
    pixel: NDArray[np.float64]

    @classmethod
    def concatenate(cls, parts: Sequence[Observations]) -> Observations:
        """Concatenate the points of all parts, one part after the other."""
        before = np.cumsum([0] + [len(each.xyz) for each in parts[:-1]])
        return cls(
            np.concatenate([each.xyz for each in parts]),
            point=np.concatenate([each.point + first for each, first in zip(parts, before, strict=True)]),
            view=np.concatenate([each.view for each in parts]),
            pixel=np.concatenate([each.pixel for each in parts]),
        )

    def select_shown(self, view: int) -> NDArray[np.float64]:
        """Select the points (K, 3) that a view shows."""
        return self.xyz[self.point[self.view == view]]

    def count_shared(self, views: int) -> NDArray[np.float64]:
        """Count the points that both of two views show, (views, views); 0 on the diagonal."""
        shape = views, len(self.xyz)
        sees = csr_matrix((np.ones(len(self.point)), (self.view, self.point)), shape)
        common: NDArray[np.float64] = (sees @ sees.T).toarray()
        np.fill_diagonal(common, 0.0)
        return common

    def select(self, points: NDArray[np.int64]) -> Observations:
        """These points with their observations."""
        number = np.full(len(self.xyz), -1)
        number[points] = np.arange(len(points))
        kept = number[self.point] >= 0
        return Observations(
            self.xyz[points], point=number[self.point[kept]], view=self.view[kept], pixel=self.pixel[kept]
        )


@dataclass(frozen=True, eq=False)
class PlacedPhoto:
    """A photo of a model: its id and name, camera, pose, and the pixels (N, 2) of its features."""

    number: int
    name: str
    camera: Any
    pose: Any
    pixels: NDArray[np.float64]


def deregister_photos(model: Any, photos: Iterable[int]) -> Any:
    """Return a copy of the model that has no place for these photos."""
    less = colmap_library().Reconstruction(model)
    for image in photos:
        less.deregister_frame(less.images[image].frame_id)
    return less


def model_of(photos: Iterable[PlacedPhoto]) -> Any:
    """A model of the photos, without points."""
    pycolmap = colmap_library()
    model = pycolmap.Reconstruction()
    for photo in sorted(photos, key=lambda each: (each.camera.camera_id, each.number)):
        if photo.camera.camera_id not in model.cameras:
            model.add_camera_with_trivial_rig(photo.camera)
        image = pycolmap.Image(
            name=photo.name, keypoints=photo.pixels, camera_id=photo.camera.camera_id, image_id=photo.number
        )
        model.add_image_with_trivial_frame(image, photo.pose)
    return model
