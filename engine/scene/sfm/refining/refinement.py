"""Refines placed photos: points from matches along epipolar lines are followed, and cameras are adjusted to them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ....progress import Progress, part
from ...pycolmap_import import colmap_library
from ..features import Features, photo_ids
from ..job import Job
from ..pairs import LARGEST, planned_pairs
from ..placing import place_again
from ..views import Pictures, read_pictures
from .adjustment import LEAST_POINTS, adjust, most_seen
from .guided import Limits, make_database, matched, matched_all
from .parts import largest_part
from .resection import resected
from .tracks import longer_tracks

_WIDE: Sequence[Limits] = ((25.0, 20.0), (10.0, 8.0))
"""Limits of the matches of passes with the largest features only. They bring parts of a capture together that a weak
link placed."""
_CLOSE: Limits = (5.0, 4.0)
"""Limits of the matches that long tracks start from, until the last round."""
_ROUND, _LAST_ROUND = (4, 200), (3, 500)
"""Pixels around the predicted place of a point that are searched, and points per photo, those seen most often, that
adjust the cameras: until the last round, and in it. Fewer points take less time, more give more accurate cameras."""
_LARGEST_ERROR = 4.0
"""Largest distance in pixels of a point of a long track from its observations."""
_UNCERTAIN = 0.5
"""Observations of a photo, relative to the median of all photos, below which it may be misplaced."""
_SAME_PLACE = 0.05
"""Distance, relative to that of most photos from their middle, up to which a photo was placed again where it was."""
_ATTEMPTS, _LEAST_KEPT, _LEAST_GAIN = 3, 0.99, 1.005
"""Rounds that match again and follow the points; factor of the agreement that a round must keep, and below which no
other follows."""
_NEAR = 2.0
"""Distance from points that three photos see, in their median spacing, up to which a point of two photos is kept."""

_Tracked = Callable[[Any, Progress], Any]
"""A model → the model matched and followed again, with cameras adjusted to that."""


def refine(job: Job, features: Sequence[Features], model: Any, report: Progress) -> Any:
    """The model with cameras refined on longer tracks, and with the points of these; as it is with too few of them.

    Photos that are missing or that hardly any long track reaches are placed again, until that does not move them.
    """
    pictures = read_pictures(job)
    large = [each.largest(LARGEST) for each in features]
    make_database(job)

    def tracked(start: Any, share: Progress) -> Any:
        seeds = matched(job, features, large, start, _CLOSE, part(share, 0.0, 0.3))
        return largest_part(_with_long_tracks(job, seeds, pictures, _ROUND, part(share, 0.3, 1.0)))

    wide = model
    for number, limits in enumerate(_WIDE):
        wide = _passed(job, features, large, wide, limits, part(report, 0.1 * number, 0.1 * (number + 1)))
    both = [tracked(wide, part(report, 0.2, 0.3)), tracked(model, part(report, 0.3, 0.4))]
    best = max(both, key=_agreement)
    best, settled = _grown(job, features, best, tracked, part(report, 0.4, 0.5))
    for attempt in range(_ATTEMPTS):
        better = _improved(job, best, settled, tracked, part(report, 0.5 + 0.1 * attempt, 0.6 + 0.1 * attempt))
        if better is None:
            break
        gain = _agreement(better) / max(_agreement(best), 1)
        best = better
        if gain < _LEAST_GAIN:
            break
    seeds = on_surfaces(matched_all(job, features, best, part(report, 0.8, 0.9)))
    best = largest_part(_with_long_tracks(job, seeds, pictures, _LAST_ROUND, part(report, 0.9, 1.0)))
    return best if best.num_points3D() >= LEAST_POINTS else model


def _grown(
    job: Job, features: Sequence[Features], model: Any, tracked: _Tracked, report: Progress
) -> tuple[Any, set[int]]:
    """The model with the missing photos that its points determine, one after the other, and the ids of these photos."""
    before, count, missing = set(model.reg_image_ids()), len(job.photos), len(job.photos) - model.num_reg_images()
    pairs = planned_pairs(job, features) if missing else []
    while model.num_reg_images() < count:
        done = 1.0 - (count - model.num_reg_images()) / missing
        share = part(report, done, done)
        more = resected(job, features, pairs, matched_all(job, features, model, share))
        if more is None:
            break
        more = tracked(more, share)
        if more.num_reg_images() <= model.num_reg_images():
            break
        model = more
    return model, set(model.reg_image_ids()) - before


def _improved(job: Job, model: Any, settled: set[int], tracked: _Tracked, report: Progress) -> Any:
    """The model matched and followed again, after its unsure photos were placed again if that moves them; None if that
    loses tracks. settled: photos that are not placed again; unsure ones that do not move are added."""
    unsure = _unsure(job, model) - settled
    for number, start in enumerate(starts(job, model, settled, unsure)):
        if start is model:
            settled |= unsure
        better = tracked(start, part(report, number / 2, (number + 1) / 2))
        if _agreement(better) > _LEAST_KEPT * _agreement(model):
            return better
    return None


def _unsure(job: Job, model: Any) -> set[int]:
    """The photos that are missing, and those with few observations."""
    support = _support(model)
    usual = float(np.median(list(support.values()))) if support else 0.0
    return {image for image in photo_ids(job) if support.get(image, -1) < _UNCERTAIN * usual}


def starts(job: Job, model: Any, settled: Collection[int], unsure: Collection[int]) -> Iterator[Any]:
    """Models to go on from, all with the settled photos that are placed: those in which the unsure photos were placed
    again, with the others fixed or not; the model itself if that is not possible or changes nothing."""
    before = set(model.reg_image_ids())
    uncertain, placed = before & set(unsure), False
    if unsure:
        for fixed in (True, False):
            again = place_again(job, model, uncertain, fixed=fixed)
            if again is None or not before & set(settled) <= set(again.reg_image_ids()):
                continue
            if same_places(model, again, uncertain):
                break
            placed = True
            yield again
    if not placed:
        yield model


def same_places(before: Any, after: Any, images: Collection[int]) -> bool:
    """Whether a model has as many photos as an earlier one, and these images where they were."""
    if after.num_reg_images() != before.num_reg_images() or not all(after.images[i].has_pose for i in images):
        return False
    centers = np.array([image.projection_center() for image in before.images.values() if image.has_pose])
    usual = float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1)))
    moved = [after.images[i].projection_center() - before.images[i].projection_center() for i in sorted(images)]
    return all(float(np.linalg.norm(each)) < _SAME_PLACE * usual for each in moved)


def _support(model: Any) -> dict[int, int]:
    """Observations of points, by photo."""
    return {number: image.num_points3D for number, image in model.images.items() if image.has_pose}


def _agreement(model: Any) -> int:
    """Photos that see points of three or more photos, beyond two each."""
    return sum(max(point.track.length() - 2, 0) for point in model.points3D.values())


def _with_long_tracks(job: Job, model: Any, pictures: Pictures, limits: tuple[int, int], report: Progress) -> Any:
    """The model with its points followed through all photos, and with cameras adjusted to those that most photos see;
    as it is if hardly any can be followed. limits: as in `_ROUND`."""
    reach, enough = limits
    report(0.0, "following points")
    longer = longer_tracks(job, model, pictures, reach)
    if longer.num_points3D() < LEAST_POINTS:
        return model
    report(0.6, "refining cameras")
    kept = most_seen(longer, enough)
    adjust(kept, _LARGEST_ERROR)
    for number, camera in kept.cameras.items():
        longer.cameras[number].params = camera.params
    for number, image in kept.images.items():
        longer.frame(longer.images[number].frame_id).rig_from_world = image.cam_from_world()
    adjust(longer, _LARGEST_ERROR, points_only=True)
    return longer


def _passed(
    job: Job,
    features: Sequence[Features],
    chosen: Sequence[NDArray[np.int64]],
    model: Any,
    limits: Limits,
    report: Progress,
) -> Any:
    """The model with cameras adjusted to matches along its epipolar lines."""
    _, enough = _ROUND
    kept = most_seen(matched(job, features, chosen, model, limits, part(report, 0.0, 0.7)), enough)
    if kept.num_points3D() < LEAST_POINTS:
        return model
    report(0.7, "refining cameras")
    adjust(kept, limits[1])
    return kept


def on_surfaces(model: Any) -> Any:
    """A copy without the points that chance matched: those that only two photos see, far from points that more see."""
    kept = colmap_library().Reconstruction(model)
    sure = np.array([point.xyz for point in model.points3D.values() if point.track.length() > 2]).reshape(-1, 3)
    if len(sure) < LEAST_POINTS:
        return kept
    tree = cKDTree(sure)
    spacing = float(np.median(tree.query(sure, k=2)[0][:, 1]))
    for number, point in model.points3D.items():
        if point.track.length() == 2 and tree.query(point.xyz)[0] > _NEAR * spacing:
            kept.delete_point3D(number)
    return kept
