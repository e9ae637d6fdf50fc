"""Fruit are counted in single photos, and a table compares that with our counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from measurements import RESULT
from splats import ring_camera

from fruitlangs.benchmarks.evidence.records import record_of
from fruitlangs.benchmarks.evidence.tables import TABLES
from fruitlangs.benchmarks.ladder.ladder import StageResult
from fruitlangs.benchmarks.ladder.stages import TRUE_POSES
from fruitlangs.benchmarks.two_photos import TWO_PHOTOS, fruit_seen, opposite
from fruitlangs.engine.language.prompts.photo_probability import PhotoMap

RADIUS = 10.0


def shown(*centers: tuple[float, float], hidden_left_of: int = 0) -> PhotoMap:
    """A photo of 60x100 pixels with fruit, (x, y) of each; columns left of `hidden_left_of` show leaves."""
    y, x = np.mgrid[:60, :100].astype(np.float32)
    probability, offsets = np.zeros((60, 100), np.float32), np.zeros((60, 100, 2), np.float32)
    for center in centers:
        off = np.stack([x - center[0], y - center[1]], axis=2) / RADIUS
        inside = (np.linalg.norm(off, axis=2) < 1.0) & (x >= hidden_left_of)
        probability[inside], offsets[inside] = 0.9, off[inside]
    return PhotoMap(probability, offsets)


def test_touching_fruit_are_counted_one_by_one() -> None:
    assert fruit_seen(shown((20.0, 30.0), (36.0, 30.0), (70.0, 20.0))) == 3


def test_a_fruit_whose_middle_is_hidden_is_counted() -> None:
    assert fruit_seen(shown((20.0, 30.0), hidden_left_of=26)) == 1


def test_a_photo_of_leaves_shows_no_fruit() -> None:
    assert fruit_seen(shown()) == 0


def test_the_opposite_photo_is_from_the_other_side_of_the_tree() -> None:
    assert opposite([ring_camera(2.0 * np.pi * number / 8) for number in range(8)]) == 4


def test_two_photos_and_our_counts_get_their_factors_from_the_other_trees() -> None:
    assert RESULT.near is not None
    records = []
    for seed, seen, total in ((101, 50, 110), (102, 100, 200), (103, 150, 330)):
        scene = f"apple-small-{seed}"
        ours = replace(RESULT, scene=scene, seed=seed, near=replace(RESULT.near, total=total))
        theirs = StageResult(species="apple", seed=seed, scene=scene, stage=TRUE_POSES, counted=seen)
        records += [record_of(ours, "voting"), record_of(theirs, TWO_PHOTOS)]
    errors = [50 * 530 / 250 / 110 - 1, 100 * 440 / 200 / 200 - 1, 150 * 310 / 150 / 330 - 1]
    mean, worst = np.mean(np.abs(errors)), np.max(np.abs(errors))
    line = next(line for line in TABLES[TWO_PHOTOS](records).splitlines() if line.startswith("| 3 apple"))
    assert f"| the others | {100 * mean:.0f} %, {100 * worst:.0f} % |" in line


def test_a_single_tree_has_no_other_to_get_a_factor_from() -> None:
    theirs = StageResult(species="apple", seed=102, scene="apple-small-102", stage=TRUE_POSES, counted=60)
    records = [record_of(RESULT, "voting"), record_of(theirs, TWO_PHOTOS)]
    assert "apple" not in TABLES[TWO_PHOTOS](records)
