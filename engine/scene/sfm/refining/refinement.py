"""Refines placed photos: points from matches along epipolar lines are followed, and cameras are adjusted to them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence, Set
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ....progress import Progress, part
from ...pycolmap_import import colmap_library
from ..features import Features, photo_ids
from ..job import Job
from ..joining import align_models
from ..pairs import LARGEST, Pair, plan_pairs
from ..placing import register_again
from ..views import Pictures, deregister_photos, read_pictures
from .adjustment import LEAST_POINTS, adjust, keep_most_seen
from .guided import Limits, has_pose, make_database, match_all_guided, match_guided
from .linking import link_models
from .parts import keep_consistent, keep_largest_part
from .resection import resect
from .tracks import lengthen_tracks

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
"""Distance, relative to that of most photos from their middle, up to which a photo is at the same place."""
_ATTEMPTS, _LEAST_KEPT, _LEAST_GAIN = 3, 0.99, 1.005
"""Rounds that match again and follow the points; factor of the agreement that a round must keep, and below which no
other follows."""
_NEAR = 2.0
"""Distance from points that three photos see, in their median spacing, up to which a point of two photos is kept."""
_LEAST_MORE, _ENOUGH_SHARED = 4, 2
"""Missing photos that another model must have to be linked; photos of both models with which it need not grow more."""


def refine(job: Job, features: Sequence[Features], models: Sequence[Any], report: Progress) -> Any:
    """The first model with cameras refined on longer tracks, and with the points of these; as it is with too few.

    Missing photos are placed on its points, and with other models that these reach. Photos that hardly any long track
    reaches are placed again, until that does not move them.
    """
    rounds = _Rounds(job, features)
    start = keep_consistent(job, rounds.straighten(models[0], part(report, 0.0, 0.4)))
    best = rounds.complete(start, models[1:], part(report, 0.4, 0.5))
    settled = set(best.reg_image_ids()) - set(start.reg_image_ids())
    for attempt in range(_ATTEMPTS):
        share = part(report, 0.5 + 0.1 * attempt, 0.6 + 0.1 * attempt)
        better = rounds.improve(best, settled, part(share, 0.0, 0.5))
        if better is None:
            break
        start = keep_consistent(job, better)  # a round may sharpen a bent model until it contradicts itself
        if start.num_reg_images() < better.num_reg_images():
            best = rounds.complete(start, models[1:], part(share, 0.5, 1.0))
            settled |= set(best.reg_image_ids()) - set(start.reg_image_ids())
            continue
        gain = _agreement(better) / max(_agreement(best), 1)
        best = better
        if gain < _LEAST_GAIN:
            break
    best = rounds.finish(best, part(report, 0.8, 1.0))
    return best if best.num_points3D() >= LEAST_POINTS else models[0]


class _Rounds:
    """Rounds in which a model is matched again, its points are followed, and its cameras are adjusted to them."""

    def __init__(self, job: Job, features: Sequence[Features]) -> None:
        self.job, self.features = job, features
        self.large = [each.largest(LARGEST) for each in features]
        self.pictures = read_pictures(job)
        self.photos = photo_ids(job)
        make_database(job)

    @cached_property
    def pairs(self) -> Sequence[Pair]:
        """The pairs of photos that may show the same."""
        return plan_pairs(self.job, self.features)

    def track(self, model: Any, report: Progress) -> Any:
        """Return the largest part of the model after one round."""
        seeds = match_guided(self.job, self.features, self.large, model, _CLOSE, part(report, 0.0, 0.3))
        return self._follow_points(seeds, _ROUND, part(report, 0.3, 1.0))

    def _follow_points(self, seeds: Any, limits: tuple[int, int], report: Progress) -> Any:
        """Return the largest part of a model with its points followed and its cameras adjusted. limits: as in
        `_ROUND`."""
        return keep_largest_part(self.job, _extend_tracks(self.job, seeds, self.pictures, limits, report))

    def straighten(self, model: Any, report: Progress) -> Any:
        """Return the better of two models: after passes that bring its parts together and a round, or after a round
        only."""
        wide = model
        for number, limits in enumerate(_WIDE):
            wide = self._adjust_once(wide, limits, part(report, 0.25 * number, 0.25 * (number + 1)))
        straight = self.track(wide, part(report, 0.5, 0.75))
        if has_same_places(model, wide, model.reg_image_ids()):
            return straight
        return max(straight, self.track(model, part(report, 0.75, 1.0)), key=_agreement)

    def _adjust_once(self, model: Any, limits: Limits, report: Progress) -> Any:
        """Return the model with cameras adjusted to matches along its epipolar lines."""
        _, enough = _ROUND
        seeds = match_guided(self.job, self.features, self.large, model, limits, part(report, 0.0, 0.7))
        kept = keep_most_seen(seeds, enough)
        if kept.num_points3D() < LEAST_POINTS:
            return model
        report(0.7, "refining cameras")
        adjust(kept, limits[1])
        return kept

    def complete(self, model: Any, others: Sequence[Any], report: Progress) -> Any:
        """Return the model with the missing photos that its points determine, and with those of other models that it
        then shares a photo with."""
        before = set(model.reg_image_ids())
        model = self._add_others(model, others, part(report, 0.0, 0.9))
        # Photos that were placed on few points get a better place on the points that came later.
        unsure = (_find_unsure(self.job, model) & set(model.reg_image_ids())) - before
        if not unsure:
            return model
        again = self._grow(deregister_photos(model, unsure), part(report, 0.9, 1.0))
        return max(model, again, key=_agreement)

    def _add_others(self, model: Any, others: Sequence[Any], report: Progress) -> Any:
        """Return the model, grown, with the photos of the other models that are linked by a photo, in any order: one
        that was linked may bring a photo that another one shares."""
        waiting, done = [(other, False) for other in others], 0.0
        while True:
            step = (0.9 - done) / 2  # how many rounds follow is not known
            elsewhere = {image for other, _ in waiting for image in other.reg_image_ids()} - set(model.reg_image_ids())
            model = grown = self._grow(model, part(report, done, done + 0.2 * step), elsewhere)
            linking, unlinked = part(report, done + 0.2 * step, done + step), []
            for number, (other, ready) in enumerate(waiting):
                if len(set(other.reg_image_ids()) - set(model.reg_image_ids())) < _LEAST_MORE:
                    continue
                share = part(linking, number / len(waiting), (number + 1) / len(waiting))
                if not ready:
                    other = keep_consistent(self.job, self.straighten(other, part(share, 0.0, 0.3)))
                    other = self._grow(other, part(share, 0.3, 0.5), set(model.reg_image_ids()))
                both = self._combine(model, other, part(share, 0.5, 1.0))
                if both is None:
                    unlinked.append((other, True))
                else:
                    model = both
            if model is grown:
                break
            waiting, done = unlinked, done + step
        if elsewhere & set(model.reg_image_ids()):  # the last growth ended early
            model = self._grow(model, part(report, 0.9, 1.0))
        return model

    def _combine(self, model: Any, other: Any, report: Progress) -> Any:
        """Return the model with the photos of the other one; None if no photo links them, or if they do not hold
        together."""
        own = match_all_guided(self.job, self.features, model, part(report, 0.0, 0.1))
        both = link_models(own, match_all_guided(self.job, self.features, other, part(report, 0.1, 0.2)))
        if both is None:
            return None
        both = self.straighten(both, part(report, 0.2, 1.0))
        return both if both.num_reg_images() > model.num_reg_images() else None

    def _grow(self, model: Any, report: Progress, reached: Set[int] = frozenset()) -> Any:
        """Return the model with the missing photos that its points determine, round after round until there are none,
        or until it has `_ENOUGH_SHARED` of the photos `reached`."""
        placed, missing = model.num_reg_images(), len(self.photos) - model.num_reg_images()
        while model.num_reg_images() < len(self.photos):
            if len(reached & set(model.reg_image_ids())) >= _ENOUGH_SHARED:
                break
            done = (model.num_reg_images() - placed) / missing
            share = part(report, done, done)
            absent = {position for position, image in enumerate(self.photos) if not has_pose(model, image)}
            near = {position for pair in self.pairs if not absent.isdisjoint(pair) for position in pair}
            points = match_all_guided(self.job, self.features, model, share, near)
            more = resect(self.job, self.features, self.pairs, points)
            if more is None:
                break
            more = self.track(more, share)
            if more.num_reg_images() <= model.num_reg_images():
                break
            model = more
        return model

    def improve(self, model: Any, settled: set[int], report: Progress) -> Any:
        """Return the model after another round, with its unsure photos placed again if that moves them; None if that
        loses tracks. settled: photos that are not placed again; unsure ones that do not move are added."""
        unsure = _find_unsure(self.job, model) - settled
        for number, start in enumerate(choose_starts(self.job, model, settled, unsure)):
            if start is model:
                settled |= unsure
            better = self.track(start, part(report, number / 2, (number + 1) / 2))
            if _agreement(better) > _LEAST_KEPT * _agreement(model):
                return better
        return None

    def finish(self, model: Any, report: Progress) -> Any:
        """Return the largest part of the model after the last round, on all features."""
        seeds = keep_on_surfaces(match_all_guided(self.job, self.features, model, part(report, 0.0, 0.5)))
        return self._follow_points(seeds, _LAST_ROUND, part(report, 0.5, 1.0))


def _find_unsure(job: Job, model: Any) -> set[int]:
    """Find the photos that are missing, and those with few observations."""
    support = _support(model)
    usual = float(np.median(list(support.values()))) if support else 0.0
    return {image for image in photo_ids(job) if support.get(image, -1) < _UNCERTAIN * usual}


def choose_starts(job: Job, model: Any, settled: Collection[int], unsure: Collection[int]) -> Iterator[Any]:
    """Choose models to go on from, all with the settled photos that are placed: those in which the unsure photos were
    placed again, with the others fixed or not; the model itself if that is not possible or changes nothing."""
    before = set(model.reg_image_ids())
    uncertain, placed = before & set(unsure), False
    if unsure:
        for fixed in (True, False):
            again = register_again(job, model, uncertain, fixed=fixed)
            if again is None or not before & set(settled) <= set(again.reg_image_ids()):
                continue
            if has_same_places(model, again, uncertain):
                break
            placed = True
            yield again
    if not placed:
        yield model


def has_same_places(before: Any, after: Any, images: Collection[int]) -> bool:
    """Whether a model has as many photos as an earlier one, and these images at the same places among the others."""
    if after.num_reg_images() != before.num_reg_images() or not all(after.images[i].has_pose for i in images):
        return False
    common = sorted(set(before.reg_image_ids()) & set(after.reg_image_ids()))
    found = align_models(after, before, common)
    if found is None:
        return False
    _, moved, usual = found
    return bool((moved[np.isin(common, list(images))] < _SAME_PLACE * usual).all())


def _support(model: Any) -> dict[int, int]:
    """Observations of points, by photo."""
    return {number: image.num_points3D for number, image in model.images.items() if image.has_pose}


def _agreement(model: Any) -> int:
    """Photos that see points of three or more photos, beyond two each."""
    return sum(max(point.track.length() - 2, 0) for point in model.points3D.values())


def _extend_tracks(job: Job, model: Any, pictures: Pictures, limits: tuple[int, int], report: Progress) -> Any:
    """Return the model with its points followed through all photos, and with cameras adjusted to those that most photos
    see; as it is if hardly any can be followed. limits: as in `_ROUND`."""
    reach, enough = limits
    report(0.0, "following points")
    longer = lengthen_tracks(job, model, pictures, reach)
    if longer.num_points3D() < LEAST_POINTS:
        return model
    report(0.6, "refining cameras")
    kept = keep_most_seen(longer, enough)
    adjust(kept, _LARGEST_ERROR)
    for number, camera in kept.cameras.items():
        longer.cameras[number].params = camera.params
    for number, image in kept.images.items():
        longer.frame(longer.images[number].frame_id).rig_from_world = image.cam_from_world()
    adjust(longer, _LARGEST_ERROR, points_only=True)
    return longer


def keep_on_surfaces(model: Any) -> Any:
    """Return a copy without the points that chance matched: those that only two photos see, far from points that more
    see."""
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
