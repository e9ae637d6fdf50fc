"""Intervals of a count: what widens them, what they hold, and that they stand wherever a count does."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import simulated_fruit as sim
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.accounts.interval import (
    ALONE,
    COVARIATES,
    STORED,
    TRAINED,
    WITH_PHOTOS,
    Evidence,
    Ratio,
    estimate,
    load_ratios,
)
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.counting.fruit import AuditEntry, FruitCount
from fruitlangs.engine.counting.regions.crown import hull_share
from fruitlangs.engine.report.audit import audit_text
from fruitlangs.engine.report.words import count_text, location_text

CERTAIN = Evidence(100.0, 0.0, np.zeros(len(COVARIATES)))


def width(evidence: Evidence) -> float:
    """Of the interval of all fruit."""
    low, high = load_ratios(photos=False)[1].interval(evidence)
    return high - low


def test_what_is_stored_was_fitted_on_seeds_for_training_to_every_number():
    document = json.loads(STORED.read_text(encoding="utf-8"))
    assert list(document) == [ALONE, WITH_PHOTOS]
    for part in document.values():
        assert {len(part[name]["weights"]) for name in ("visible", "total")} == {len(COVARIATES)}
        assert min(int(re.findall(r"\d+", scene)[-1]) for scene in part["fitted on"]) >= 1000


def test_a_ratio_is_read_as_it_was_written():
    ratio = Ratio(0.1, np.array([0.2, 0.0, 0.3]), 0.05, np.array([0.1, 0.0, 0.2]), np.array([1.2, 1.5]))
    again = Ratio.read(json.loads(json.dumps(ratio.document())))
    assert again.interval(CERTAIN) == ratio.interval(CERTAIN)


@pytest.mark.parametrize(
    "uncertain",
    [
        replace(CERTAIN, variance=100.0),
        *(replace(CERTAIN, covariates=np.eye(len(COVARIATES))[place]) for place in range(3)),
    ],
)
def test_uncertain_candidates_and_hidden_places_widen_the_interval(uncertain: Evidence):
    assert width(uncertain) > 1.1 * width(CERTAIN)


@pytest.mark.parametrize("count", [10, 50, 500])
def test_the_hull_of_fruit_that_hang_evenly_in_a_ball_holds_the_share_that_is_reckoned_with(count: int):
    rng = np.random.default_rng(count)
    directions = rng.normal(size=(40, count, 3))
    places = directions / np.linalg.norm(directions, axis=2, keepdims=True) * np.cbrt(rng.random((40, count, 1)))
    shares = [ConvexHull(each).volume / (4.0 / 3.0 * np.pi) for each in places]
    assert hull_share(count) == pytest.approx(np.mean(shares), abs=0.05)
    assert hull_share(3) == 0.0


def test_trained_scenes_have_a_stretch_of_their_own_and_half_as_faint_ones_half_of_each():
    ratio = Ratio(0.0, np.zeros(len(COVARIATES)), 0.1, np.zeros(len(COVARIATES)), np.array([1.0, 2.0]))
    faint = np.array(COVARIATES) == "faint"
    parts = (0.0, 0.5 * TRAINED, TRAINED, 3.0 * TRAINED)
    assert [ratio.deviation(replace(CERTAIN, covariates=part * faint)) for part in parts] == pytest.approx(
        [0.1, 0.15, 0.2, 0.2]
    )


@given(st.floats(0.5, 3000.0), st.floats(0.0, 1.0), st.integers(0, 4000))
def test_the_count_lies_within_its_interval_and_no_more_are_visible_than_there_are(expected: float, x: float, n: int):
    sure = estimate(Evidence(expected, x * expected, np.full(len(COVARIATES), x)), n)
    (low, high), (least, most) = sure.visible, sure.total_interval
    assert 0 <= low <= n <= high <= most
    assert low <= least <= most
    assert sure.total >= n


def test_the_interval_of_visible_fruit_starts_below_a_count_with_candidates_that_may_be_false():
    certain = estimate(Evidence(120.0, 0.0, np.zeros(len(COVARIATES))), 100)
    uncertain = estimate(Evidence(100.0, 20.0, np.array([0.2, TRAINED, 0.0])), 110)
    assert certain.visible[0] == 100 < certain.total_interval[0]
    assert uncertain.visible[0] < 110


def test_the_interval_of_all_fruit_is_never_narrower_than_that_of_the_visible_ones():
    faint = Evidence(1000.0, 50.0, np.array([0.05, TRAINED, 0.0]))
    sure = estimate(faint, 1000)
    assert np.divide(*sure.total_interval) <= np.divide(*sure.visible) + 0.002


def test_the_interval_of_a_few_fruit_is_at_least_half_a_fruit_wide():
    low, high = load_ratios(photos=False)[0].interval(replace(CERTAIN, expected=3.0))
    assert low <= 3.0 <= high


@pytest.fixture(scope="module")
def tree() -> sim.Simulation:
    return sim.simulate(sim.Setting(fruit=12, clump=3, sheets=0, floaters=8, views=8), seed=5)


def counted(tree: sim.Simulation, config: CountConfig) -> FruitCount:
    return count_fruit(
        tree.gaussians, tree.probability, tree.cameras, config, label="apple", visibility=tree.visibility
    )


def test_a_count_has_intervals(tree: sim.Simulation):
    result = counted(tree, CountConfig())
    assert result.interval is not None
    assert result.total_interval is not None
    assert result.interval[0] <= result.count <= result.interval[1]
    assert result.interval[1] - result.interval[0] < 0.5 * result.count
    assert f"{result.count} visible fruit" in count_text(result)


def test_of_a_region_only_its_own_fruit_are_expected(tree: sim.Simulation):
    whole = counted(tree, CountConfig())
    assert whole.interval is not None
    middle = float(np.median(whole.centers[:, 2]))
    low, high = whole.centers.min(axis=0) - 1.0, whole.centers.max(axis=0) + 1.0
    part = counted(tree, CountConfig(box=(low[0], low[1], middle + 0.01, high[0], high[1], high[2])))
    assert part.interval is not None
    assert part.interval[1] < whole.interval[0]


def test_every_tree_of_a_row_has_intervals(tree: sim.Simulation):
    whole, row = counted(tree, CountConfig()), counted(tree, CountConfig(trees=2))
    assert row.interval == whole.interval
    assert sum(each.count for each in row.trees) == row.count
    for each in row.trees:
        assert each.interval is not None
        assert each.total is not None
        assert each.total_interval is not None
        assert each.interval[0] <= each.count <= each.interval[1] < row.count
        assert each.total_interval[0] <= each.total <= each.total_interval[1]
        assert (
            f"{each.count} on tree {each.number} (90 % interval {each.interval[0]}–{each.interval[1]}"
            in location_text(row)[-1]
        )
    assert sum(each.total or 0.0 for each in row.trees) == pytest.approx(whole.total, rel=0.2)


def test_a_published_method_gives_no_interval(tree: sim.Simulation):
    result = counted(tree, CountConfig(method="template"))
    assert (result.interval, result.total, result.total_interval) == (None, None, None)
    assert count_text(result) == f"{result.count} visible fruit"


def test_the_audit_for_people_lists_every_cluster_under_its_verdict():
    entries = [
        AuditEntry(0, "split", "2 touching spheres", (0.0, 0.5, 1.0), 400, (1, 2), 0.08),
        AuditEntry(1, "merged", "80% of its points belong to fruit 2", (1.0, 0.5, 1.0), 30, (2,)),
        AuditEntry(2, "dropped", "flat", (1.0, 0.5, 2.0), 90),
        AuditEntry(3, "dropped", "4 clusters of fewer than 20 points each", (0.0, 0.0, 0.0), 33),
    ]
    text = audit_text(FruitCount([], entries, 1.0, None), prompt="apple", metres_per_unit=None).splitlines()
    assert text[0] == "apple: 0 visible fruit"
    assert "     2 clusters dropped: no fruit" in text
    start = text.index("Dropped (no fruit)")
    assert text[start + 1 :] == [
        "  90 points at 1.000 0.500 2.000: flat", "  33 points: 4 clusters of fewer than 20 points each",
    ]  # fmt: skip
    told = "  400 points at 0.000 0.500 1.000, fruit 1, 2: 2 touching spheres; mean diameter 0.08 scene units"
    assert told in text


def test_the_audit_gives_lengths_in_millimetres_where_the_scale_is_known_and_says_so_at_its_head():
    entry = AuditEntry(0, "kept", "one sphere", (0.0, 0.5, 1.0), 400, (1,), 0.08)
    text = audit_text(FruitCount([], [entry], 1.0, None), prompt="apple", metres_per_unit=0.5).splitlines()
    assert text[1] == "Places are x y z in the frame of the scene, in scene units; diameters are in mm."
    assert text[-1] == "  400 points at 0.000 0.500 1.000, fruit 1: one sphere; diameter 40 mm"
