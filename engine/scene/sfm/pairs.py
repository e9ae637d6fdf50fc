"""Which pairs of photos are matched, and their matches, verified by epipolar geometry, in the database."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config import PhotosConfig
from ...progress import Progress, part
from ..pycolmap_import import colmap_library
from .features import Features, image_ids, photo_ids
from .job import Job
from .matching import LEAST_EXCESS, MatchArray, match, match_along_lines

Pair = tuple[int, int]
"""Positions of two photos in name order, the smaller first."""

LARGEST = 2048
"""Features per photo that are compared first: the largest are found again, and they suffice to place the photo."""
LEAST_INLIERS = 10
"""Matches on one epipolar geometry below which a pair shows nothing in common."""
SURE_INLIERS = 30
"""Matches on one geometry that no chance gives, even if all lie in a plane."""
ERROR, TOLERANCE = 2.0, 3.0
"""Largest distances in pixels from the epipolar line: in RANSAC, and of the matches along the lines."""
_TRIALS = 1500
"""Trials of RANSAC: pairs without common content need all of them."""
_SIMILAR = 8
"""Photos of similar content that each photo is matched with, besides its neighbours."""
_FEW = 100
"""Photos of a capture up to which one that was not placed is matched with all others."""
_RETRIED = 40
"""Placed photos of the most similar content with which one that was not placed is matched again."""
_ROUNDS = 3
"""Rounds in which the neighbours of matched photos are matched, to close the loop."""
_BLOCK = 32
"""Pairs between two writes to the database: the work that a cancel loses, and a step of the progress."""


def choose_first_pairs(similarity: NDArray[np.float32] | None, count: int, config: PhotosConfig) -> list[Pair]:
    """Choose the pairs to match first.

    similarity: (count, count) of the photos' content. All pairs up to `exhaustive_up_to` photos; above that, each photo
    with the next `overlap` ones in name order and with those of the most similar content.
    """
    if count <= config.exhaustive_up_to or similarity is None:
        return list(itertools.combinations(range(count), 2))
    chosen = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + config.overlap, count))}
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) > config.overlap
    for i in range(count):
        ranked = np.argsort(np.where(apart[i], -similarity[i], np.inf), kind="stable")[:_SIMILAR]
        chosen |= {(min(i, int(j)), max(i, int(j))) for j in ranked if apart[i, j]}
    return sorted(chosen)


def choose_retry_pairs(missing: frozenset[int], similarity: NDArray[np.float32] | None, count: int) -> list[Pair]:
    """Choose the pairs to match after an attempt that did not place the `missing` photos: those with each of the
    others, and in captures that have `similarity` (count, count) only with the most similar placed ones. All pairs of
    330 photos, half of which were missing, took an hour."""
    if similarity is None:
        return [pair for pair in itertools.combinations(range(count), 2) if not missing.isdisjoint(pair)]
    placed = np.array([i for i in range(count) if i not in missing] or range(count), np.int64)
    chosen = set()
    for i in missing:
        nearest = placed[np.argsort(-similarity[i, placed], kind="stable")[:_RETRIED]]
        chosen |= {(min(i, int(j)), max(i, int(j))) for j in nearest if j != i}
    return sorted(chosen)


def choose_closing_pairs(
    verified: Collection[Pair], tried: Collection[Pair], count: int, config: PhotosConfig
) -> list[Pair]:
    """Choose pairs next to verified ones that are not neighbours: where the camera path returns, all photos there
    meet."""
    steps = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    near = {
        (i + a, j + b) for i, j in verified if j - i > config.overlap for a, b in steps if 0 <= i + a < j + b < count
    }
    return sorted(near - set(tried))


def plan_pairs(job: Job, features: Sequence[Features]) -> list[Pair]:
    """Plan the pairs to match first: see `choose_first_pairs`."""
    similarity = _similarity(job, features, job.config.exhaustive_up_to)
    return choose_first_pairs(similarity, len(features), job.config)


def plan_retry_pairs(job: Job, features: Sequence[Features], missing: Collection[int]) -> list[Pair]:
    """Plan the pairs to match for photos that were not placed: see `choose_retry_pairs`."""
    return choose_retry_pairs(frozenset(missing), _similarity(job, features, _FEW), len(features))


def _similarity(job: Job, features: Sequence[Features], few: int) -> NDArray[np.float32] | None:
    """How similar the photos' content is (see `similarities`); None for a capture of at most `few` photos."""
    from .retrieval import similarities

    return similarities(features, job.config.seed) if len(features) > few else None


def match_photos(job: Job, features: Sequence[Features], report: Progress) -> None:
    """Match the planned pairs, then those that close loops."""
    count = len(features)
    planned, tried, closing = plan_pairs(job, features), set[Pair](), part(report, 0.9, 1.0)
    for round_ in range(1 + _ROUNDS):
        share = part(report, 0.0, 0.9) if round_ == 0 else part(closing, (round_ - 1) / _ROUNDS, round_ / _ROUNDS)
        match_pairs(job, features, planned, share)
        tried |= set(planned)
        planned = choose_closing_pairs(read_verified_pairs(job), tried, count, job.config)
        if not planned:
            break


def read_verified_pairs(job: Job) -> list[Pair]:
    """Read the pairs in the database that show something in common."""
    positions = {image: position for position, image in enumerate(photo_ids(job))}
    found = [(positions[a], positions[b]) for a, b in read_verified_images(job)]
    return sorted((min(pair), max(pair)) for pair in found)


def read_verified_images(job: Job) -> list[tuple[int, int]]:
    """Read the same as ids of photos in the database."""
    with job.open_database() as database:
        pairs, inliers = database.read_two_view_geometry_num_inliers()
    found = [pair for pair, number in zip(pairs, inliers, strict=True) if number]
    return [colmap_library().pair_id_to_image_pair(pair) for pair in found]


def match_pairs(job: Job, features: Sequence[Features], pairs: Iterable[Pair], report: Progress) -> None:
    """Match and verify the pairs that are not in the database yet; a pair's result does not depend on the others."""
    with job.open_database() as database:
        images = image_ids(database, job)
        cameras = [database.read_camera(database.read_image(image).camera_id) for image in images]
        large = [each.largest(LARGEST) for each in features]
        chosen = [each.select(index) for each, index in zip(features, large, strict=True)]
        todo = [pair for pair in pairs if not database.exists_two_view_geometry(images[pair[0]], images[pair[1]])]
        with ThreadPoolExecutor(job.threads) as pool:
            for start in range(0, len(todo), _BLOCK):
                report(start / len(todo), f"matching photos: pair {start + 1} of {len(todo)}")
                block = todo[start : start + _BLOCK]
                found = _match_block(job, chosen, cameras, block, pool)
                with colmap_library().DatabaseTransaction(database):
                    for (i, j), geometry in zip(block, found, strict=True):
                        numbered = _renumber(geometry, large[i], large[j])
                        database.write_two_view_geometry(images[i], images[j], numbered)


def _match_block(
    job: Job, features: Sequence[Features], cameras: Sequence[Any], pairs: Sequence[Pair], pool: ThreadPoolExecutor
) -> list[Any]:
    """The two-view geometry of each pair with its inliers; without inliers if there is nothing in common."""
    options = _verification(job)
    nothing = colmap_library().TwoViewGeometry()

    def verify(pair: Pair, matches: MatchArray | None) -> Any:
        if matches is None or len(matches) < LEAST_INLIERS:
            return nothing
        i, j = pair
        return colmap_library().estimate_two_view_geometry(
            cameras[i], features[i].positions.astype(np.float64), cameras[j], features[j].positions.astype(np.float64),
            matches, options,
        )  # fmt: skip

    first = list(pool.map(verify, pairs, [match(features[i], features[j]) for i, j in pairs]))
    along = [
        _match_along(geometry, features[i], features[j], neighbours=j - i <= job.config.overlap)
        for (i, j), geometry in zip(pairs, first, strict=True)
    ]
    second = list(pool.map(verify, pairs, along))
    return [_choose_better(before, after, nothing) for before, after in zip(first, second, strict=True)]


def _verification(job: Job) -> Any:
    options = colmap_library().TwoViewGeometryOptions()
    options.min_num_inliers = LEAST_INLIERS
    options.ransac.random_seed = job.config.seed
    options.ransac.max_error = ERROR
    options.ransac.max_num_trials = _TRIALS
    return options


def _match_along(geometry: Any, one: Features, other: Features, *, neighbours: bool) -> MatchArray | None:
    """Return the matches along the lines of the geometry, if they show common content. neighbours: whether the photos
    are neighbours in name order, which are likely to have some; RANSAC finds lines for a few matches of others by
    chance."""
    if len(geometry.inlier_matches) < LEAST_INLIERS or geometry.F is None or not np.any(geometry.F):
        return None
    least = LEAST_EXCESS if neighbours else LEAST_INLIERS
    return match_along_lines(np.asarray(geometry.F), one, other, TOLERANCE, least=least)


def _choose_better(before: Any, after: Any, nothing: Any) -> Any:
    """Choose the geometry of the matches along the lines, if it has more; else the first, if chance cannot explain
    it."""
    if len(after.inlier_matches) >= max(len(before.inlier_matches), LEAST_INLIERS):
        return after
    return before if len(before.inlier_matches) >= SURE_INLIERS else nothing


def _renumber(geometry: Any, one: NDArray[np.int64], other: NDArray[np.int64]) -> Any:
    """Put the numbers of all features in place of those of the largest."""
    inliers = np.asarray(geometry.inlier_matches).reshape(-1, 2)
    geometry.inlier_matches = np.stack([one[inliers[:, 0]], other[inliers[:, 1]]], axis=1).astype(np.uint32)
    return geometry
