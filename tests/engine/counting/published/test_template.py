"""The roads by templates: balls alone, touching, seen from one side, other shapes; what the audit says; laws."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import simulated_fruit as sim
import trimesh
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.counting.evidence.cluster import Clusters
from fruitlangs.engine.counting.evidence.surface_points import SurfacePoints, spread_out
from fruitlangs.engine.counting.geometry.random_streams import even_turns
from fruitlangs.engine.counting.published.fruitnerf import MERGED, cluster_as_fruitnerf
from fruitlangs.engine.counting.published.registration import register
from fruitlangs.engine.counting.published.template import split_by_template
from fruitlangs.engine.counting.published.template_shape import Template, ball
from fruitlangs.engine.errors import Cancelled, FormatError

METHODS = [split_by_template, cluster_as_fruitnerf]
EVERY_METHOD = pytest.mark.parametrize("method", METHODS, ids=["template", "fruitnerf"])
ONCE = settings(max_examples=4, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
APART = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 3.0]])


def surface(body: np.ndarray, center: np.ndarray, *, seen: float = -1.0) -> SurfacePoints:
    """Points of a body's surface (M, 3) about its centre, those that face upwards by `seen` or more."""
    normals = body / np.linalg.norm(body, axis=1, keepdims=True)
    kept = normals[:, 2] >= seen
    noise = np.random.default_rng(len(body)).normal(0.0, 0.01, (int(kept.sum()), 3))
    positions, count = body[kept] + center + noise, int(kept.sum())
    own = normals[kept]
    return SurfacePoints(positions, own, np.arange(count), np.ones(count), own, even_turns(count))


def balls(centers: np.ndarray, *, seen: float = -1.0, each: int = 400) -> SurfacePoints:
    return joined(*(surface(0.5 * unit(each, seed), center, seen=seen) for seed, center in enumerate(centers)))


def unit(count: int, seed: int) -> np.ndarray:
    drawn = np.random.default_rng(seed).normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def joined(*parts: SurfacePoints) -> SurfacePoints:
    return SurfacePoints(
        *(np.concatenate([getattr(part, each.name) for part in parts]) for each in dataclasses.fields(SurfacePoints))
    )


def off(clusters: Clusters, centers: np.ndarray) -> float:
    """Largest distance of a true centre from the nearest found one."""
    return float(np.linalg.norm(centers[:, None] - clusters.spheres.centers, axis=2).min(axis=1).max())


@EVERY_METHOD
def test_balls_apart_are_one_fruit_each_at_their_centres(method) -> None:
    found = method(balls(APART), 1.0)
    assert len(found.spheres) == 4
    assert off(found, APART) < 0.05


@EVERY_METHOD
@pytest.mark.parametrize("count", [2, 3, 5])
def test_balls_in_a_chain_are_split(method, count: int) -> None:
    chain = np.concatenate([np.outer(np.arange(count), [1.0, 0.0, 0.0]), APART[2:] + [0.0, 3.0, 3.0]])
    found = method(balls(chain), 1.0)
    assert len(found.spheres) == count + 2
    assert off(found, chain) < 0.25


def test_the_papers_method_splits_more_than_six_and_fruitnerf_does_not() -> None:
    row = np.outer(np.arange(9), [1.0, 0.0, 0.0])
    assert len(split_by_template(balls(row), 1.0, ball()).spheres) == 9
    assert len(cluster_as_fruitnerf(balls(row), 1.0).spheres) == 6


def test_half_a_ball_is_one_fruit_with_its_own_centre() -> None:
    found = split_by_template(balls(APART, seen=0.0), 1.0)
    assert len(found.spheres) == 4
    assert off(found, APART) < 0.12


def test_a_cap_is_a_small_fruit_to_the_paper_and_nothing_to_fruitnerf() -> None:
    points = joined(balls(APART[1:]), balls(APART[:1], seen=0.4))
    paper, rival = split_by_template(points, 1.0), cluster_as_fruitnerf(points, 1.0)
    assert [index in paper.small for index in np.argsort(paper.spheres.centers.sum(axis=1))] == [True] + 3 * [False]
    assert len(rival.spheres) == 3
    assert any("(0.3 is asked)" in reason for reason in rival.refusals.values())


@EVERY_METHOD
def test_a_leaf_is_no_fruit(method) -> None:
    leaf = np.random.default_rng(0).uniform(-1.0, 1.0, (400, 3)) * [0.7, 0.35, 0.01] + [6.0, 6.0, 6.0]
    up = np.tile([0.0, 0.0, 1.0], (400, 1))
    found = method(
        joined(balls(APART), SurfacePoints(leaf, up, np.arange(400), np.ones(400), up, even_turns(400))), 1.0
    )
    assert len(found.spheres) == 4


def test_fruitnerf_merges_small_pieces_of_one_fruit() -> None:
    upper, others = balls(APART[:1], seen=0.34), balls(APART[1:])
    turned = {name: -getattr(upper, name) for name in ("positions", "normals", "directions")}
    lower = dataclasses.replace(upper, **turned)
    far = dataclasses.replace(lower, positions=lower.positions - [0.0, 0.0, MERGED])
    assert len(cluster_as_fruitnerf(joined(upper, lower, others), 1.0).spheres) == 4
    assert len(cluster_as_fruitnerf(joined(upper, far, others), 1.0).spheres) == 3


def test_a_long_fruit_is_one_with_its_template_and_two_with_a_ball() -> None:
    body = 0.5 * unit(500, 0) * [0.75, 0.75, 2.2]
    shape = Template.of(0.5 * unit(300, 1) * [0.75, 0.75, 2.2])
    points = joined(*(surface(Rotation.random(random_state=i).apply(body), c) for i, c in enumerate(APART)))
    assert len(split_by_template(points, 1.0, shape).spheres) == 4
    assert len(split_by_template(points, 1.0, ball()).spheres) > 4


def test_a_template_is_laid_onto_half_of_its_own_turned_points() -> None:
    shape = Template.of(ball().points * [1.0, 0.8, 1.4])
    turn = Rotation.from_rotvec([0.2, -0.1, 0.15]).as_matrix()
    half = shape.points[shape.points[:, 2] > 0.0] @ turn.T + [3.0, 2.0, 1.0]
    fit = register(half, shape, half.mean(axis=0))
    assert np.linalg.norm(half.mean(axis=0) - [3.0, 2.0, 1.0]) > 0.3
    assert np.linalg.norm(fit.center - [3.0, 2.0, 1.0]) < 0.12
    assert fit.off < 0.12 < 0.5 < fit.bare
    assert fit.hausdorff == fit.bare


@EVERY_METHOD
def test_the_audit_names_volume_distance_and_gamma_of_every_kept_cluster(method) -> None:
    found = method(balls(np.concatenate([APART, [[1.0, 0.0, 0.0]]])), 1.0)
    told = [
        re.fullmatch(r"a (single fruit|compound): its alpha shape has (\d\.\d\d) template volumes, .*"
                     r" (\d\.\d\d) diameters, γ = (\d)", reason)
        for reason in found.findings.values()
    ]  # fmt: skip
    assert sorted(match[4] for match in told if match) == ["1", "1", "1", "2"]
    assert sum(int(match[4]) for match in told if match) == len(found.spheres)
    assert all(0.8 < float(match[2]) / int(match[4]) < 1.3 for match in told if match)


@EVERY_METHOD
@ONCE
@given(seed=st.integers(0, 1000), scale=st.floats(0.01, 100.0))
def test_moving_turning_and_scaling_leaves_the_count_alone(method, seed: int, scale: float) -> None:
    centers = np.concatenate([APART, [[1.0, 0.0, 0.0]]])
    points, turn = balls(centers), Rotation.random(random_state=seed)
    moved = dataclasses.replace(
        points,
        positions=scale * (turn.apply(points.positions) + [4.0, 5.0, 6.0]),
        normals=turn.apply(points.normals),
        directions=turn.apply(points.directions),
    )
    found = method(moved, scale)
    assert len(found.spheres) == len(centers)
    assert off(found, scale * (turn.apply(centers) + [4.0, 5.0, 6.0])) < 0.25 * scale


@EVERY_METHOD
def test_a_few_scattered_points_are_no_fruit_and_no_failure(method) -> None:
    spots, up = np.random.default_rng(0).uniform(-9.0, 9.0, (7, 3)), np.tile([0.0, 0.0, 1.0], (7, 1))
    found = method(SurfacePoints(spots, up, np.arange(7), np.ones(7), up, even_turns(7)), 1.0)
    assert len(found.spheres) == 0
    assert found.refusal(0) == "too thin to be part of any cluster"


@EVERY_METHOD
def test_it_can_be_cancelled(method) -> None:
    def stop(fraction: float, message: str) -> None:
        if fraction > 0.4:
            raise Cancelled

    with pytest.raises(Cancelled):
        method(balls(APART), 1.0, progress=stop)


def test_points_are_shared_out_by_volume_also_where_gaussians_outnumber_them() -> None:
    shares = np.where(np.arange(1000) < 500, 1.0, 3.0)
    counts = spread_out(shares, 200)
    assert (counts.sum(), counts[:500].sum()) == (200, 50)
    np.testing.assert_array_equal(spread_out(np.array([0.0, 1.0, 0.0, 3.0]), 8), [0, 2, 0, 6])
    assert len(spread_out(np.zeros(0), 8)) == 0


@pytest.fixture(scope="module")
def tree() -> sim.Simulation:
    return sim.simulate(sim.Setting(fruit=10, clump=3, sheets=1, floaters=8, leaves=0, views=12), seed=2)


@pytest.mark.parametrize("method", ["template", "fruitnerf"])
def test_a_counted_tree_gives_kinds_and_reasons(tree: sim.Simulation, method) -> None:
    config = CountConfig(method=method, sample_budget=4000)
    counted = count_fruit(
        tree.gaussians, tree.probability, tree.cameras, config, label="apple", visibility=tree.visibility
    )
    assert 8 <= counted.count <= 11
    kept = [entry for entry in counted.audit if entry.fruit_ids]
    assert all(f"γ = {len(entry.fruit_ids)}" in entry.reason for entry in kept)
    compound = {id for entry in kept if entry.verdict == "split" for id in entry.fruit_ids}
    assert compound
    assert {fruit.id for fruit in counted.fruits if fruit.kind == "compound-part"} == compound


def test_a_template_file_is_used_and_a_bad_one_is_an_error(tree: sim.Simulation, tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=3).export(tmp_path / "apple.stl")
    (tmp_path / "bad.ply").write_text("no shape")

    def counted(name: str) -> int:
        config = CountConfig(method="template", template=str(tmp_path / name), sample_budget=4000, diameter=1.0)
        return count_fruit(
            tree.gaussians, tree.probability, tree.cameras, config, label="apple", visibility=tree.visibility
        ).count

    assert 8 <= counted("apple.stl") <= 11
    with pytest.raises(FormatError, match=r"bad\.ply"):
        counted("bad.ply")
