"""Matching points of two photos, found quickly on small copies."""

from __future__ import annotations

import threading
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene.pycolmap_import import colmap_library

MOST_FEATURES = 1200
"""Features per photo; the largest are kept, which are found again from farther away."""
FEW_PIXELS = 120_000
"""Copies with at most this many pixels are enlarged before features are searched."""
RATIO = 0.85
"""Largest angle to the best match over the angle to the second best (Lowe 2004)."""
LEAST_MATCHES = 15
"""Fewest points on one epipolar geometry. In 255 pairs without common content, at most 11 were found by chance."""
ERROR_SHARE = 1.0 / 256.0
"""Largest distance of a match from its epipolar line, in longer sides of the copy."""
_TRIALS = 30, 1000
"""Least and most trials of RANSAC."""
_MOST_VERIFIED = 200
"""Most matches that are verified: enough to decide, and quick."""
_SCALE = 512.0
"""Descriptors are stored as bytes in units of 1 / 512, as COLMAP does."""
_local = threading.local()


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """Points of a photo: (N, 2) pixels of the copy, and (N, 128) bytes of SIFT descriptors."""

    points: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    longer_side: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """Common content of two photos: (M,) indices of matching points in the one and the other."""

    first: NDArray[np.intp]
    second: NDArray[np.intp]

    @property
    def matches(self) -> int:
        return len(self.first)


def find_features(grey: NDArray[np.uint8]) -> Features:
    """SIFT features of a small grey copy (H, W)."""
    enlarged = grey.size <= FEW_PIXELS
    points, descriptors = _extractor(enlarged).extract(np.ascontiguousarray(grey))
    return Features(
        points=points[:, :2].astype(np.float32),
        descriptors=np.clip(np.rint(_SCALE * descriptors), 0, 255).astype(np.uint8).reshape(-1, 128),
        longer_side=max(grey.shape),
    )


def _extractor(enlarged: bool) -> Any:
    """SIFT for this thread."""
    name = f"sift_{enlarged}"
    if not hasattr(_local, name):
        pycolmap = colmap_library()
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.num_threads = 1
        options.sift.max_num_features = MOST_FEATURES
        options.sift.peak_threshold = 0.002
        options.sift.edge_threshold = 15.0
        options.sift.upright = True
        options.sift.first_octave = -1 if enlarged else 0
        level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, pycolmap.logging.WARNING.value
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            setattr(_local, name, pycolmap.Sift(options, pycolmap.Device.cpu))
        pycolmap.logging.minloglevel = level
    return getattr(_local, name)


def find_link(one: Features, other: Features) -> Link | None:
    """The common content of two photos: mutual nearest neighbours that pass the ratio test and agree with one epipolar
    geometry (RANSAC, seeded); None with fewer than `LEAST_MATCHES`."""
    first, second = (each[:_MOST_VERIFIED] for each in _mutual(one, other))
    if len(first) < LEAST_MATCHES:
        return None
    pycolmap = colmap_library()
    options = pycolmap.RANSACOptions()
    options.max_error = ERROR_SHARE * max(one.longer_side, other.longer_side)
    options.min_num_trials, options.max_num_trials = _TRIALS
    options.random_seed = 0
    found = pycolmap.estimate_fundamental_matrix(
        one.points[first].astype(np.float64), other.points[second].astype(np.float64), options
    )
    if found is None or found["num_inliers"] < LEAST_MATCHES:
        return None
    agree = np.asarray(found["inlier_mask"], dtype=bool)
    return Link(first=first[agree], second=second[agree])


def _mutual(one: Features, other: Features) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of points that are each other's nearest, and clearly nearer than the second nearest."""
    nothing = np.zeros(0, np.intp)
    if len(one.points) < LEAST_MATCHES or len(other.points) < LEAST_MATCHES:
        return nothing, nothing
    cosines = _unit(one.descriptors) @ _unit(other.descriptors).T
    rows = np.arange(len(cosines))
    best, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
    nearest = cosines[rows, best].copy()
    cosines[rows, best] = -1.0
    second = cosines.max(axis=1)
    clear = np.arccos(np.clip(nearest, -1.0, 1.0)) < RATIO * np.arccos(np.clip(second, -1.0, 1.0))
    kept = (back[best] == rows) & clear
    return rows[kept], best[kept]


def _unit(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    values = descriptors.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)
