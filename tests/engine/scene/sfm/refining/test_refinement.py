"""Refined cameras: which photos are placed again, and which points are kept."""

from __future__ import annotations

import types
from typing import Any, cast

import numpy as np
import pytest

from fruitlangs.engine.progress import silent
from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm.job import Job
from fruitlangs.engine.scene.sfm.refining import refinement
from fruitlangs.engine.scene.sfm.refining.refinement import choose_starts, has_same_places, keep_on_surfaces


def with_points(places: np.ndarray, lengths: list[int]) -> Any:
    """A model with points at the places, seen by so many photos."""
    colmap_library().set_random_seed(0)
    options = colmap_library().SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 200
    model = colmap_library().synthesize_dataset(options)
    numbers = sorted(model.points3D)
    for number, place, length in zip(numbers, places, lengths, strict=False):
        model.point3D(number).xyz = place
        while model.point3D(number).track.length() > length:
            element = model.point3D(number).track.elements[0]
            model.delete_observation(element.image_id, element.point2D_idx)
    for number in numbers[len(places) :]:
        model.delete_point3D(number)
    return model


def test_points_of_two_photos_are_kept_near_points_of_three_only() -> None:
    surface = np.column_stack([*(axis.ravel() for axis in np.mgrid[0:10.0, 0:10.0]), np.zeros(100)])
    near, far = surface[:5] + [0.5, 0.5, 0.5], surface[:5] + [0.0, 0.0, 30.0]
    model = with_points(np.concatenate([surface, near, far]), [3] * 100 + [2] * 10)
    assert model.num_points3D() == 110
    kept = keep_on_surfaces(model)
    assert kept.num_points3D() == 105
    assert max(point.xyz[2] for point in kept.points3D.values()) < 1.0


def test_photos_are_at_the_same_places_if_none_is_missing_or_has_moved_far() -> None:
    before = with_points(np.zeros((1, 3)), [4])
    centers = np.array([image.projection_center() for image in before.images.values()])
    extent = float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1)))

    def moved(share: float) -> Any:
        after = colmap_library().Reconstruction(before)
        pose = after.images[2].cam_from_world()
        translation = pose.translation + [share * extent, 0.0, 0.0]
        frame = after.frame(after.images[2].frame_id)
        frame.rig_from_world = colmap_library().Rigid3d(pose.rotation, translation)
        return after

    assert has_same_places(before, moved(0.04), {2})
    assert not has_same_places(before, moved(0.06), {2})
    assert has_same_places(before, moved(0.06), {1})
    without = moved(0.0)
    without.deregister_frame(without.images[3].frame_id)
    assert not has_same_places(before, without, {2})


@pytest.mark.parametrize("kept", [True, False])
def test_placing_photos_again_never_loses_those_that_points_placed(kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model = with_points(np.zeros((1, 3)), [4])
    again = colmap_library().Reconstruction(model)
    again.deregister_frame(again.images[3 if kept else 2].frame_id)
    monkeypatch.setattr(refinement, "register_again", lambda *_, **__: again)
    found = list(choose_starts(cast(Job, None), model, settled={2, 9}, unsure={3, 5}))
    assert [each.num_reg_images() for each in found] == ([3, 3] if kept else [4])


def test_photos_that_placing_again_does_not_move_are_not_placed_again_in_later_rounds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, calls, settled = with_points(np.zeros((1, 3)), [4]), [], set[int]()
    monkeypatch.setattr(refinement, "_find_unsure", lambda *_: {3, 5})
    monkeypatch.setattr(refinement, "register_again", lambda *_, fixed: calls.append(fixed))
    rounds = cast(Any, types.SimpleNamespace(job=None, track=lambda start, _: start))
    for _ in range(3):
        assert refinement._Rounds.improve(rounds, model, settled, silent) is model
    assert calls == [True, False]
    assert settled == {3, 5}


class Photos:
    """What `refine` and `complete` ask of a model."""

    def __init__(self, *photos: int) -> None:
        self.photos = set(photos)

    def reg_image_ids(self) -> set[int]:
        return self.photos

    def num_reg_images(self) -> int:
        return len(self.photos)

    def num_points3D(self) -> int:
        return 1000 * len(self.photos)


@pytest.mark.parametrize(
    ("others", "placed"),
    [
        ([], 5),
        ([range(5, 11)], 10),
        ([range(10, 17), range(5, 11)], 16),  # the second brings the photo that the first shares
        ([range(11, 17), range(5, 11)], 10),
        ([range(5, 8)], 5),
    ],
)
def test_models_are_linked_in_any_order_and_each_is_straightened_once(
    others: list[range], placed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def both(model: Photos, other: Photos, _: Any) -> Photos | None:
        return Photos(*model.photos, *other.photos) if model.photos & other.photos else None

    straightened: list[Photos] = []
    rounds = types.SimpleNamespace(
        job=None,
        straighten=lambda model, _: straightened.append(model) or model,
        _grow=lambda model, *_: model,
        _combine=both,
    )
    monkeypatch.setattr(refinement, "_find_unsure", lambda *_: set())
    monkeypatch.setattr(refinement, "keep_consistent", lambda _, model: model)
    models = [Photos(*each) for each in others]
    rounds._add_others = lambda *arguments: refinement._Rounds._add_others(cast(Any, rounds), *arguments)
    model = refinement._Rounds.complete(cast(Any, rounds), Photos(*range(1, 6)), models, silent)
    assert model.num_reg_images() == placed
    assert straightened == [each for each in models if len(each.photos) > 3]


def test_a_model_that_contradicts_itself_after_a_round_is_cut_and_completed_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bent, sharp, right = Photos(*range(10)), Photos(*range(10)), Photos(*range(10))
    starts: list[set[int]] = []

    def completed(model: Photos, *_: Any) -> Photos:
        starts.append(model.photos)
        return bent if len(starts) == 1 else right

    rounds = types.SimpleNamespace(
        straighten=lambda model, _: model,
        complete=completed,
        improve=lambda model, *_: sharp if model is bent else model,
        finish=lambda model, _: model,
    )
    monkeypatch.setattr(refinement, "_Rounds", lambda *_: rounds)
    monkeypatch.setattr(refinement, "_agreement", lambda _: 1)
    monkeypatch.setattr(refinement, "keep_consistent", lambda _, model: Photos(*range(6)) if model is sharp else model)
    assert refinement.refine(cast(Job, None), [], [bent], silent) is right
    assert starts == [set(range(10)), set(range(6))]
