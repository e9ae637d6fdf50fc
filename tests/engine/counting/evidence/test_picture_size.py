"""Sizes from rendered views, and widths in pixels."""

from __future__ import annotations

import numpy as np
import pytest
import simulated_fruit as sim
from numpy.typing import NDArray

from fruitlangs.engine.counting.evidence.picture_size import LEAST_SHARE, size_from_pictures
from fruitlangs.engine.counting.evidence.pixel_width import pixel_widths
from fruitlangs.engine.counting.evidence.visibility import Picture
from fruitlangs.engine.splatting.kernels.surface import NOTHING

CAMERA = sim.look_at(np.array([0.0, -6.0, 0.0]), np.zeros(3))  # focal length 300, 360×270 pixels
DEPTH = 6.0


def picture(discs: list[tuple[float, float, float]], sheet: float = 0.0) -> Picture:
    """A view of discs (column, row, radius in pixels) and of a sheet over this share of the picture, at DEPTH."""
    row, column = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    shown = row < sheet * CAMERA.height
    for x, y, radius in discs:
        shown |= np.hypot(column - x, row - y) < radius
    depth = np.where(shown, np.float32(DEPTH), NOTHING).astype(np.float32)
    return Picture(CAMERA, depth, shown.astype(np.float32))


def everywhere(positions: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.ones(len(positions), bool)


SIX = [(60.0 * index + 30.0, 200.0, 10.0) for index in range(6)]


def test_the_width_of_discs_is_their_diameter_at_their_depth() -> None:
    size = size_from_pictures([picture(SIX)], 0.5, everywhere)
    assert size is not None
    assert size.diameter == pytest.approx(20.0 * DEPTH / 300.0, rel=0.08)


def test_the_width_of_discs_is_the_same_in_pixels_that_are_not_square() -> None:
    square = picture(SIX)
    flat = Picture(CAMERA.resize(CAMERA.width, 3 * CAMERA.height), square.depth.repeat(3, 0), square.fruit.repeat(3, 0))
    size, other = (size_from_pictures([each], 0.5, everywhere) for each in (square, flat))
    assert size is not None
    assert other is not None
    assert other.diameter == pytest.approx(size.diameter, rel=0.04)


def test_clumps_and_half_hidden_fruit_do_not_change_the_width() -> None:
    clump = [(100.0 + 14.0 * index, 60.0, 10.0) for index in range(6)]
    views = [picture([*SIX, *clump]), picture([*SIX, (340.0, 40.0, 4.0)])]
    size = size_from_pictures(views, 0.5, everywhere)
    assert size is not None
    assert size.diameter == pytest.approx(20.0 * DEPTH / 300.0, rel=0.08)


def test_a_sheet_with_a_few_round_specks_has_no_size() -> None:
    assert size_from_pictures([picture(SIX, sheet=0.6)], 0.5, everywhere) is None
    assert 6 * np.pi * 10.0**2 < LEAST_SHARE * 0.6 * CAMERA.width * CAMERA.height


def test_regions_outside_the_counted_part_have_no_width() -> None:
    large = [(70.0 * index + 40.0, 60.0, 30.0) for index in range(5)]
    below = size_from_pictures([picture([*SIX, *large])], 0.5, lambda positions: positions[:, 2] < 0.0)
    assert below is not None
    assert below.diameter == pytest.approx(20.0 * DEPTH / 300.0, rel=0.08)


def test_four_regions_are_too_few_for_a_size() -> None:
    assert size_from_pictures([picture(SIX[:4])], 0.5, everywhere) is None
    assert size_from_pictures([picture([])], 0.5, everywhere) is None


def test_the_width_in_pixels_is_diameter_times_focal_length_over_depth() -> None:
    full, half = CAMERA.scale(2.0), picture([])
    widths = pixel_widths(np.zeros((1, 3)), np.array([0.4]), [full], [half])
    np.testing.assert_allclose(widths, [0.4 * 600.0 / DEPTH])


def test_views_in_which_a_leaf_hides_the_fruit_do_not_count_for_its_width() -> None:
    near, far = (sim.look_at(np.array([0.0, -distance, 0.0]), np.zeros(3)) for distance in (3.0, 6.0))
    nothing = np.full((270, 360), NOTHING, np.float32)
    leaf = np.full((270, 360), np.float32(1.0))
    open_far = [Picture(near, leaf, nothing * 0), Picture(far, nothing, nothing * 0)]
    hidden = [Picture(near, leaf, nothing * 0), Picture(far, leaf, nothing * 0)]
    size = np.array([0.4])
    np.testing.assert_allclose(pixel_widths(np.zeros((1, 3)), size, [near, far], open_far), [20.0])
    np.testing.assert_allclose(pixel_widths(np.zeros((1, 3)), size, [near, far], hidden), [30.0])


def test_a_fruit_outside_every_view_has_no_width() -> None:
    widths = pixel_widths(np.array([[0.0, -9.0, 0.0], [50.0, 0.0, 0.0]]), np.full(2, 0.4), [CAMERA], [picture([])])
    assert np.isnan(widths).all()
