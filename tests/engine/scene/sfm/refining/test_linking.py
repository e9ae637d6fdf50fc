"""Two models that share one photo are linked."""

from __future__ import annotations

import numpy as np
import pytest

from fruitlangs.engine.scene.alignment import align
from fruitlangs.engine.scene.sfm.refining.linking import link_models

from ..test_joining import split


@pytest.mark.parametrize("shared", [1, 3])
def test_a_photo_that_two_models_share_gives_place_direction_and_size_of_the_second(shared: int) -> None:
    whole, first, second = split(shared)
    both = link_models(first, second)
    assert set(both.reg_image_ids()) == set(whole.reg_image_ids())
    order = sorted(whole.images)
    found, true = (np.array([each.images[i].projection_center() for i in order]) for each in (both, whole))
    assert np.abs(align(found, true).apply(found) - true).max() < 1e-6
    assert both.num_points3D() == 0


def test_models_without_a_common_photo_or_with_few_common_points_are_not_linked() -> None:
    _, first, second = split(0)
    assert link_models(first, second) is None
    _, first, second = split(1)
    for number in sorted(second.points3D)[7:]:
        second.delete_point3D(number)
    assert link_models(first, second) is None
