"""Who owns which points."""

from __future__ import annotations

import numpy as np

from fruitlangs.engine.counting.evidence.claims import claim, members
from fruitlangs.engine.counting.geometry.cells import Cells
from fruitlangs.engine.counting.geometry.sphere import unit_directions


def test_every_owner_gets_its_points_and_those_without_any_an_empty_list():
    own = members(np.array([2, -1, 0, 2, -1, 0, 0]), 4)
    assert [each.tolist() for each in own] == [[2, 5, 6], [], [0, 3], []]
    assert [each.tolist() for each in members(np.zeros(0, np.int64), 2)] == [[], []]


def test_what_one_sphere_takes_is_lost_to_the_next():
    outward = unit_directions(300)
    cells = Cells.of(0.5 * outward, 0.3)
    claims = claim(cells, outward[cells.index], np.zeros((2, 3)), np.array([0.5, 0.55]))
    owners = np.full(300, -1)
    whole, inside = claims.value(0, owners)
    assert (round(whole), inside) == (300, 0.0)
    claims.take(0, 7, owners)
    assert (owners == 7).all()
    assert claims.value(1, owners) == (0.0, 0.0)


def test_points_that_face_inwards_or_lie_well_inside_are_not_on_a_sphere():
    outward = unit_directions(100)
    cells = Cells.of(np.vstack([0.5 * outward, 0.2 * outward]), 0.3)
    normals = np.vstack([-outward, outward])[cells.index]
    claims = claim(cells, normals, np.zeros((1, 3)), np.array([0.5]))
    assert claims.value(0, np.full(200, -1)) == (0.0, 100.0)
