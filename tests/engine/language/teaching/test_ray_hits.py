from __future__ import annotations

import numpy as np
import pytest

from fruitlangs.engine.language.teaching.ray_hits import pick_point, pick_surface

X = np.array([1.0, 0.0, 0.0])


def discs(depths, opacity, thickness=1e-4):
    """Flat Gaussians across the x axis at these depths, turned there from their own z."""
    count = len(depths)
    means = np.zeros((count, 3), np.float32)
    means[:, 0] = depths
    scales = np.tile(np.array([0.1, 0.1, thickness], np.float32), (count, 1))
    quats = np.tile(np.array([np.sqrt(0.5), 0, np.sqrt(0.5), 0], np.float32), (count, 1))
    return means, scales, quats, np.full(count, opacity, np.float32)


def test_one_solid_disc_is_hit_where_it_is():
    np.testing.assert_allclose(pick_surface(np.zeros(3), X, *discs([2.0], 0.9)), [2.0, 0, 0], atol=1e-6)


def test_faint_discs_are_passed_until_half_of_the_light_is_stopped():
    # .8³ = .512, .8⁴ = .41: the fourth stops more than half.
    hit = pick_surface(np.zeros(3), X, *discs([5.0, 1.0, 3.0, 4.0, 2.0], 0.2))
    np.testing.assert_allclose(hit, [4.0, 0, 0], atol=1e-6)


def test_too_little_in_the_way_is_no_hit():
    assert pick_surface(np.zeros(3), X, *discs([1.0, 2.0], 0.2)) is None


def test_what_lies_behind_is_no_hit():
    assert pick_surface(np.zeros(3), X, *discs([-1.0], 0.99)) is None
    assert pick_surface(np.array([0.0, 0.5, 0.0]), X, *discs([1.0], 0.99)) is None


def test_a_slanted_ray_hits_a_disc_in_its_plane():
    direction = np.array([1.0, 0.02, 0.01])
    direction /= np.linalg.norm(direction)
    hit = pick_surface(np.zeros(3), direction, *discs([2.0], 0.99))
    assert hit[0] == pytest.approx(2.0, abs=1e-5)
    np.testing.assert_allclose(np.cross(hit, direction), 0.0, atol=1e-9)


def test_the_picked_depth_is_that_of_the_engines_picture(counted_balls):
    from fruitlangs.engine.counting.evidence.visibility import draw

    gaussians, probability = counted_balls.gaussians, counted_balls.probability.double().numpy()
    arrays = [value.numpy() for value in (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities)]
    errors = []
    for picture in draw(gaussians, probability, counted_balls.scene.cameras[:6]):
        camera = picture.camera
        for fruit in counted_balls.fruit_count.fruits:
            along = fruit.center - camera.center
            hit = pick_surface(camera.center, along / np.linalg.norm(along), *arrays)
            (u, v), depth = camera.project(hit)
            errors.append((depth - picture.depth[int(v), int(u)]) / fruit.diameter)
    assert np.median(np.abs(errors)) < 0.08


def test_the_first_sparse_point_near_the_ray_is_picked_and_far_ones_are_not():
    points = np.array([[5.0, 0.01, 0], [2.0, 0.03, 0], [3.0, 0.02, 0]])
    np.testing.assert_array_equal(pick_point(np.zeros(3), X, points, slope=0.01, reach=0.0), [3.0, 0.02, 0])
    np.testing.assert_array_equal(pick_point(np.zeros(3), X, points, slope=0.0, reach=0.05), [2.0, 0.03, 0])
    assert pick_point(np.zeros(3), X, points, slope=0.001, reach=0.0) is None
    assert pick_point(np.zeros(3), -X, points, slope=0.1, reach=0.1) is None
