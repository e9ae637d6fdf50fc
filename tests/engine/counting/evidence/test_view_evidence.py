"""What pictures tell of a sphere: how much of it they show, and how freely they look."""

from __future__ import annotations

import numpy as np
import pytest
import simulated_fruit as sim

from fruitlangs.engine.counting.evidence import visibility
from fruitlangs.engine.counting.evidence.visibility import (
    RIM,
    SPOTS,
    Picture,
    ViewEvidence,
    find_visibility,
    gather_view_evidence,
)
from fruitlangs.engine.scene.camera import Camera
from fruitlangs.engine.splatting.kernels.surface import NOTHING

SIZE, FOCAL, FAR, RADIUS = 100, 200.0, 10.0, 1.0
CAMERA = Camera(np.array([[FOCAL, 0.0, SIZE / 2], [0.0, FOCAL, SIZE / 2], [0.0, 0.0, 1.0]]), np.eye(4)[:3], SIZE, SIZE)
SURFACE = FAR - 0.4
"""A flat one, which the round one differs from by less than is asked."""
RIGHT = np.arange(SIZE)[None].repeat(SIZE, axis=0) >= SIZE // 2


def picture(depth: float | np.ndarray, fruit: float | np.ndarray = 1.0) -> Picture:
    """A view along z in which every pixel, or each, has this depth and probability."""
    whole = np.zeros((SIZE, SIZE), np.float32)
    return Picture(CAMERA, (whole + depth).astype(np.float32), (whole + fruit).astype(np.float32))


def view_evidence(*pictures: Picture) -> ViewEvidence:
    """At a sphere straight ahead."""
    return gather_view_evidence(pictures, np.array([[0.0, 0.0, FAR]]), np.array([RADIUS]), 0.5)


def test_a_sphere_that_nothing_hides_is_seen_whole_by_every_view():
    seen = view_evidence(picture(SURFACE), picture(SURFACE))
    assert (seen.visible_fractions[0], seen.solidity[0], seen.views[0]) == (1.0, 1.0, 2)
    assert seen.free[0] == pytest.approx(2 * SPOTS * RIM**2, abs=2)


def test_half_a_sphere_behind_a_leaf_has_half_the_free_spots_and_is_as_solid():
    seen = view_evidence(picture(np.where(RIGHT, 3.0, SURFACE), np.where(RIGHT, 0.0, 1.0)))
    assert seen.visible_fractions[0] == pytest.approx(0.5, abs=0.05)
    assert seen.free[0] == pytest.approx(0.5 * SPOTS * RIM**2, abs=2)
    assert seen.solidity[0] == 1.0


def test_a_sphere_that_a_view_looks_through_is_not_solid_however_freely_it_is_looked_at():
    seen = view_evidence(picture(np.where(RIGHT, float(NOTHING), SURFACE)))
    assert seen.solidity[0] == pytest.approx(0.5, abs=0.05)
    assert seen.free[0] == pytest.approx(SPOTS * RIM**2, abs=2)


def test_without_a_free_spot_in_any_view_nothing_counts_against_a_sphere():
    seen = view_evidence(picture(3.0, 0.0))
    assert (seen.free[0], seen.solidity[0], seen.probabilities[0]) == (0.0, 1.0, 1.0)
    assert seen.visible_fractions[0] == 0.0


def test_many_views_are_drawn_smaller_and_show_as_many_gaussians(monkeypatch: pytest.MonkeyPatch):
    tree = sim.simulate(sim.Setting(fruit=8, views=8), seed=3)
    whole = find_visibility(tree.gaussians, tree.cameras)
    pixels = sum(camera.width * camera.height for camera in tree.cameras)
    monkeypatch.setattr(visibility, "MOST_PIXELS", pixels // 9)
    monkeypatch.setattr(visibility, "LEAST_VIEW", 1)
    small = find_visibility(tree.gaussians, tree.cameras)
    seen = whole.views > 0
    assert (small.views[seen] == 0).mean() < 0.02
    assert small.views[seen].mean() == pytest.approx(whole.views[seen].mean(), rel=0.1)
    assert small.weights.sum() == pytest.approx(whole.weights.sum(), rel=0.25)  # widened more; 9 times less if unscaled


@pytest.mark.parametrize("axis", [0, 1])
def test_a_sphere_that_the_border_of_a_view_cuts_has_the_free_spots_inside(axis: int):
    disc = visibility.spiral(SPOTS)
    inner = (disc**2).sum(axis=1) < RIM**2
    places = np.linspace(-4.0, 4.0, 81)
    centers = np.zeros((len(places), 3))
    centers[:, axis], centers[:, 2] = places, FAR
    pixels = FOCAL * (places[:, None] + RADIUS * disc[:, axis]) / FAR + SIZE / 2
    inside = ((pixels >= 0.0) & (pixels < SIZE) & inner).sum(axis=1)
    free = gather_view_evidence([picture(SURFACE)], centers, np.full(len(places), RADIUS), 0.5).free
    assert np.abs(free - inside).max() <= 1
    assert (free > 0).sum() > (np.abs(places) < SIZE / 2 / FOCAL * FAR).sum()
