"""The strips of the page: outlines of the fruit in a view."""

from __future__ import annotations

import numpy as np
from fruit_examples import fruit
from simulated_fruit import look_at

from fruitlangs.engine.report.meshes import id_color
from fruitlangs.engine.report.pictures import _draw_ids


def test_a_long_fruit_has_a_long_outline_and_one_behind_a_surface_has_none():
    camera = look_at(np.array([0.1, -0.5, -1.0]), np.array([0.1, 0.5, -1.0]), focal=1000.0)
    depth = np.full((camera.height, camera.width), 2.0, np.float32)
    depth[:, : camera.width // 2] = 0.5
    black = np.zeros((camera.height, camera.width, 3), np.uint8)
    drawn = _draw_ids(black, depth, camera, [fruit(1, 0.0), fruit(2, 0.2)])
    assert not (drawn == id_color(1)).all(axis=2).any()
    rows, columns = np.nonzero((drawn == id_color(2)).all(axis=2))
    assert abs(np.ptp(rows) - 160.0) < 5.0  # .16 long, upright, at 1 unit
    assert abs(np.ptp(columns) - 80.0) < 5.0
