from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fruitlangs.engine.errors import SceneError
from fruitlangs.engine.scene.alignment import Similarity, align

TRUE = Similarity(2.5, Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), np.array([3.0, -1.0, 0.5]))


def ring(count: int = 20) -> np.ndarray:
    """(count, 3) centres on a ring with two heights."""
    angle = np.arange(count) * 2 * np.pi / count
    return np.column_stack([np.cos(angle), np.sin(angle), 0.2 * (np.arange(count) % 2)])


def assert_same(found: Similarity, expected: Similarity, tolerance: float = 1e-9) -> None:
    assert found.scale == pytest.approx(expected.scale, rel=tolerance)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=tolerance)
    np.testing.assert_allclose(found.translation, expected.translation, atol=10 * tolerance)


@pytest.mark.parametrize("count", [3, 4, 20])
def test_a_similarity_is_found_again(count: int) -> None:
    assert_same(align(ring(count), TRUE.apply(ring(count))), TRUE)


def test_lengths_are_scaled_and_points_carried_over() -> None:
    assert TRUE.apply_to_lengths(np.array([0.0, 2.0])).tolist() == [0.0, 5.0]
    np.testing.assert_allclose(TRUE.apply(np.zeros(3)), TRUE.translation)
    moved = TRUE.apply(ring())
    np.testing.assert_allclose(np.linalg.norm(moved[0] - moved[7]), 2.5 * np.linalg.norm(ring()[0] - ring()[7]))


@pytest.mark.parametrize("count", [12, 40])
def test_views_that_are_quite_wrong_do_not_move_the_frame(count: int) -> None:
    target = TRUE.apply(ring(count))
    target[: count // 3] += np.random.default_rng(1).normal(0.0, 4.0, (count // 3, 3))
    assert_same(align(ring(count), target), TRUE, 1e-6)


def test_noise_is_averaged_over_all_views() -> None:
    noise = np.random.default_rng(2).normal(0.0, 0.01, (60, 3))
    found = align(ring(60), TRUE.apply(ring(60)) + noise)
    off = np.linalg.norm(found.apply(ring(60)) - TRUE.apply(ring(60)), axis=1)
    assert off.max() < 0.01


def test_a_mirrored_model_is_not_taken_for_a_turned_one() -> None:
    found = align(ring(), ring() * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_equal_input_gives_equal_output() -> None:
    target = TRUE.apply(ring(40)) + np.random.default_rng(3).normal(0.0, 0.05, (40, 3))
    assert align(ring(40), target).rotation.tobytes() == align(ring(40), target).rotation.tobytes()


@pytest.mark.parametrize(
    ("source", "said"),
    [
        (ring()[:2], "2 views .* At least 3"),
        (np.column_stack([np.arange(5.0), np.arange(5.0), np.arange(5.0)]), "on one line"),
        (np.zeros((5, 3)), "on one line"),
        (np.full((5, 3), np.nan), "not finite"),
        (np.zeros((5, 2)), "cannot be aligned"),
    ],
)
def test_views_that_fix_no_frame_are_an_error_that_says_why(source: np.ndarray, said: str) -> None:
    with pytest.raises(SceneError, match=said):
        align(source, source)
