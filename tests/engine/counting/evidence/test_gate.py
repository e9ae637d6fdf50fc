"""What the gate weighs, says and refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fruitlangs.engine.counting.evidence.candidates import Candidates, SurfaceIndex
from fruitlangs.engine.counting.evidence.gate import (
    STORED,
    WEIGHED,
    Features,
    Gate,
    curvatures,
    features_of,
    load_gate,
)
from fruitlangs.engine.counting.evidence.size import FruitSize
from fruitlangs.engine.counting.evidence.surface_points import SurfacePoints
from fruitlangs.engine.counting.evidence.visibility import ViewEvidence
from fruitlangs.engine.counting.geometry.cells import Cells
from fruitlangs.engine.counting.geometry.random_streams import even_turns
from fruitlangs.engine.counting.geometry.sphere import Spheres, unit_directions
from fruitlangs.engine.errors import FormatError

WHOLE = {
    "coverage": 0.6, "solidity": 1.0, "thinness": 0.3, "residual": 0.05, "agreement": 0.75, "share": 1.0, "free": 1.0,
    "off": 0.0, "mean": 1.0, "looked": 400.0, "shell": 1.0, "curvature": 1.0,
}  # fmt: skip
UP = np.array([0.0, 0.0, 1.0])


def candidates(probability: float = 1.0, **changes: float) -> tuple[Candidates, SurfaceIndex]:
    """Three candidates of 50 points each: a whole fruit, one that is changed, and another whole fruit.

    The normals of one whose curvature is 0 all point up, as a leaf's do.
    """
    values = [WHOLE, WHOLE | changes, WHOLE]
    column = {name: np.array([each[name] for each in values]) for name in WHOLE}
    spheres = Spheres(
        centers=np.zeros((3, 3)),
        radii=0.5 * np.exp(0.1 * np.sqrt(column["off"])),
        radius_sds=np.full(3, 0.02),
        support=np.full(3, 50.0),
        shell=column["shell"],
        coverage=column["coverage"],
        thinness=column["thinness"],
        residual=column["residual"],
        agreement=column["agreement"],
    )
    view_evidence = ViewEvidence(np.ones(3), column["looked"], column["solidity"], np.ones(3), np.full(3, 9))
    owners = np.repeat([0, 1, 2], 50)
    outwards = np.tile(unit_directions(50), (3, 1))
    normals = UP + column["curvature"][owners, None] * (outwards - UP)
    positions = spheres.radii[owners, None] * outwards
    probabilities = np.where(owners == 1, probability, 1.0)
    points = SurfacePoints(positions, normals, np.arange(150), probabilities, outwards, even_turns(150))
    found = Candidates(spheres, view_evidence, column["share"], column["free"], owners)
    return found, SurfaceIndex(points, Cells.of(positions, 1.0), normals)


def weighed(threshold: float = 0.5, probability: float = 1.0, **changes: float) -> tuple[np.ndarray, Features]:
    found, surface = candidates(probability, **changes)
    features = features_of(found, surface, FruitSize(1.0, 0.1), threshold)
    return load_gate().probabilities(features), features


def test_a_whole_fruit_is_almost_certain():
    assert weighed()[0].min() > 0.95


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"coverage": 0.06}, "covered on 6% of its surface only"),
        ({"solidity": 0.1}, "seen through (10% as opaque as other fruit)"),
        ({"thinness": 0.04}, "flat (0.04 radii thick)"),
        ({"residual": 0.2}, "uneven (0.20 radii off a sphere)"),
        ({"agreement": 0.2}, "not round (its points face outwards by 0.20 of 1)"),
        ({"curvature": 0.2}, "hardly curved (its points' normals turn 20% as fast as on other fruit)"),
        ({"free": 0.5}, "on points of better fruit (50% are its own)"),
    ],
)
def test_what_counts_against_a_fruit_lowers_its_probability_and_is_named(changes: dict[str, float], told: str):
    probabilities, features = weighed(**changes)
    assert probabilities[1] < probabilities[0]
    assert load_gate().reason(features, 1).startswith(told)


def test_the_classifier_knows_how_much_evidence_supports_a_fruit():
    _, features = weighed(looked=19.0, shell=0.7)
    assert features["looked"] == pytest.approx(np.log([401.0, 20.0, 401.0]))
    assert features["shell"] == pytest.approx([1.0, 0.7, 1.0])
    assert features["spread"] == pytest.approx([0.1, 0.1, 0.1])


def test_the_normals_of_a_sphere_turn_once_on_each_radius_and_those_of_a_leaf_do_not():
    found, surface = candidates(curvature=0.0)
    assert curvatures(found, surface) == pytest.approx([1.0, 0.0, 1.0])


def test_a_piece_of_a_sphere_is_as_curved_as_the_whole():
    found, surface = candidates()
    cap = surface.points.positions[:, 2] > 0.8 * found.spheres.radii[0]
    piece = replace(found, owners=np.where(cap | (found.owners != 1), found.owners, -1))
    assert 3 <= (piece.owners == 1).sum() < 10
    assert curvatures(piece, surface) == pytest.approx([1.0, 1.0, 1.0])


def test_points_of_which_each_is_there_twice_are_as_curved():
    found, surface = candidates(curvature=0.4)
    twice = np.tile(np.arange(150), 2)
    doubled = SurfaceIndex(surface.points.select(twice), surface.cells, surface.normals[twice])
    assert curvatures(replace(found, owners=found.owners[twice]), doubled) == pytest.approx(curvatures(found, surface))


def test_one_point_gives_no_curvature():
    found, surface = candidates()
    alone = found.owners.copy()
    alone[51:100] = -1
    assert curvatures(replace(found, owners=alone), surface)[1] == 1.0


def test_a_faint_candidate_is_refused_whatever_its_form():
    probabilities, features = weighed(probability=0.2)
    assert probabilities[1] == 0.0
    assert load_gate().reason(features, 1) == "its most probable points come no nearer than 40% to the threshold"


def test_a_lower_threshold_takes_fainter_points_as_seriously():
    assert weighed(threshold=0.5, probability=0.6)[0][1] == pytest.approx(weighed(0.25, probability=0.3)[0][1])


def test_what_is_stored_is_the_gate_that_was_fitted(tmp_path: Path):
    rng, n = np.random.default_rng(0), len(WEIGHED)
    fitted = Gate(
        np.full(n, -2.0),
        np.full(n, 2.0),
        rng.normal(size=n),
        np.ones(n),
        rng.normal(size=n),
        np.triu(rng.normal(size=(n, n))),
        0.3,
    )
    (tmp_path / "gate.json").write_text(json.dumps(fitted.document()))
    values = rng.normal(size=(50, n))
    np.testing.assert_allclose(Gate.read(tmp_path / "gate.json").score(values), fitted.score(values), atol=1e-2)


def test_a_feature_farther_out_than_any_weighs_no_more_than_the_farthest():
    gate, values = load_gate(), np.repeat(load_gate().center[None], 3, axis=0)
    values[:, 3] = [gate.low[3], gate.low[3] - 0.01, gate.low[3] - 10.0]
    scores = gate.score(values)
    assert scores[1:] == pytest.approx(scores[0])


def test_a_sphere_more_even_than_any_of_the_fit_is_certainly_a_fruit():
    assert weighed(residual=0.004)[0][1] > 0.95


def test_what_is_stored_weighs_all_features_and_was_fitted_on_seeds_for_training():
    document = json.loads(STORED.read_text(encoding="utf-8"))
    assert document["features"] == list(WEIGHED)
    assert np.array(document["quadratic"]).shape == (len(WEIGHED), len(WEIGHED))
    assert not np.tril(document["quadratic"], -1).any()
    assert min(int(scene.split()[1]) for scene in document["fitted on"]) >= 1000


def test_a_gate_fitted_to_other_features_is_refused(tmp_path: Path) -> None:
    document = json.loads(STORED.read_text(encoding="utf-8"))
    document["features"][:2] = reversed(document["features"][:2])
    (tmp_path / "gate.json").write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(FormatError, match=r"fitted to other features.*fit_gate\.py"):
        Gate.read(tmp_path / "gate.json")
