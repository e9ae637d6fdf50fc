"""SIFT features of photos: found by pycolmap, kept in its database, read as arrays."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...progress import Progress
from ..pycolmap_import import colmap_library
from .job import Copy, Job

_BLOCK = 10
"""Photos between two reports of progress: the work that a cancel loses."""
_MOST = 8192
"""Features per photo."""
_FEW_PIXELS = 400_000
"""If most copies have at most this many pixels, descriptors are pooled over sizes: 4 times as long, and they join more
photos. Descriptors of all photos are of one kind, because they are compared."""
_LARGEST_PATCH = 1.0
"""Largest region of a pooled descriptor, in sizes of the feature: beyond the edge of a leaf lies the background."""


@dataclass(frozen=True, eq=False)
class Features:
    """The features of one photo.

    positions: (N, 2) float32, pixels of the copy; sizes: (N,) float32, pixels; descriptors: (N, 128) uint8 RootSIFT.
    """

    positions: NDArray[np.float32]
    sizes: NDArray[np.float32]
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.positions)

    def largest(self, count: int) -> NDArray[np.int64]:
        """Which features are the `count` largest, in their own order: they are found again in other photos."""
        return np.sort(np.argsort(-self.sizes, kind="stable")[:count])

    def select(self, index: NDArray[Any]) -> Features:
        return Features(self.positions[index], self.sizes[index], self.descriptors[index])


def add_photos(job: Job) -> None:
    """Add the photos and their cameras to the database, unless an earlier run did.

    Photos of one size share a camera, unless EXIF gives them other focal lengths; without EXIF the focal length starts
    at 1.2 times the longer side.
    """
    pycolmap = colmap_library()
    with job.open_database() as database:
        listed = database.num_images()
    if listed == len(job.photos):
        return
    job.database.unlink()
    job.open_database().close()
    for group in _by_camera(job.photos):
        first = group[0]
        options = pycolmap.ImageReaderOptions()
        options.camera_model = "SIMPLE_RADIAL"
        if first.focal:
            options.camera_params = f"{first.copy_focal},{first.copy_width / 2},{first.copy_height / 2},0"
        pycolmap.import_images(
            job.database, job.copies, pycolmap.CameraMode.SINGLE, [photo.copy for photo in group], options
        )


def _by_camera(photos: Sequence[Copy]) -> list[list[Copy]]:
    """Photos of one camera: of the same size, and with the same focal length if EXIF gives it."""

    def camera(photo: Copy) -> tuple[int, int, float]:
        return photo.width, photo.height, photo.focal

    return [list(group) for _, group in itertools.groupby(sorted(photos, key=camera), camera)]


def find_features(job: Job, report: Progress) -> None:
    """SIFT for photos that have no features yet; tuned for leaves a few pixels wide in small photos."""
    pycolmap = colmap_library()
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False  # another device finds other features
    options.num_threads = job.threads
    options.sift.max_num_features = _MOST
    options.sift.peak_threshold = 0.002
    options.sift.edge_threshold = 15.0
    options.sift.octave_resolution = 4
    options.sift.upright = job.config.upright
    options.sift.dsp_max_scale = _LARGEST_PATCH
    options.sift.domain_size_pooling = are_small(job.photos)
    names = [photo.copy for photo in job.photos]
    for start in range(0, len(names), _BLOCK):
        report(start / len(names), f"finding features: photo {start + 1} of {len(names)}")
        chunk = names[start : start + _BLOCK]
        pycolmap.extract_features(job.database, job.copies, chunk, pycolmap.CameraMode.AUTO, extraction_options=options)


def are_small(photos: Sequence[Copy]) -> bool:
    """Whether most of the copies have few pixels."""
    return bool(np.median([photo.copy_width * photo.copy_height for photo in photos]) <= _FEW_PIXELS)


def read_features(job: Job) -> list[Features]:
    """The features of all photos, in name order."""
    with job.open_database() as database:
        return [
            _features(database.read_keypoints(image), database.read_descriptors(image).data)
            for image in image_ids(database, job)
        ]


def image_ids(database: Any, job: Job) -> list[int]:
    """The database's numbers of the photos, in name order."""
    numbers = {image.name: image.image_id for image in database.read_all_images()}
    return [numbers[photo.copy] for photo in job.photos]


def photo_ids(job: Job) -> list[int]:
    """The database's numbers of the photos, in name order; opens and closes it."""
    with job.open_database() as database:
        return image_ids(database, job)


def _features(keypoints: NDArray[np.float32], descriptors: NDArray[np.uint8]) -> Features:
    keypoints = np.asarray(keypoints, np.float32).reshape(-1, 6)
    areas = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    return Features(
        positions=np.ascontiguousarray(keypoints[:, :2]),
        sizes=np.sqrt(areas),
        descriptors=np.ascontiguousarray(descriptors, dtype=np.uint8).reshape(-1, 128),
    )
