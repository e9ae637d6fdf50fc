"""Fruit are counted in single photos, and a table compares that with our counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from measurements import RESULT
from splats import ring_camera

from fruitlangs.benchmarks.evidence.records import Record, record_of
from fruitlangs.benchmarks.evidence.tables import TABLES
from fruitlangs.benchmarks.ladder.ladder import StageResult
from fruitlangs.benchmarks.ladder.stages import TRUE_POSES
from fruitlangs.benchmarks.two_photos import TWO_PHOTOS, count_fruit_seen, find_opposite
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
    assert count_fruit_seen(shown((20.0, 30.0), (36.0, 30.0), (70.0, 20.0))) == 3


def test_a_fruit_whose_middle_is_hidden_is_counted() -> None:
    assert count_fruit_seen(shown((20.0, 30.0), hidden_left_of=26)) == 1


def test_a_photo_of_leaves_shows_no_fruit() -> None:
    assert count_fruit_seen(shown()) == 0


def test_the_opposite_photo_is_from_the_other_side_of_the_tree() -> None:
    assert find_opposite([ring_camera(2.0 * np.pi * number / 8) for number in range(8)]) == 4


def measured(species: str, seed: int, seen: int, ours: int, estimate: float | None, total: int) -> list[Record]:
    """A tree with this many fruit, counted in two photos and by us."""
    assert RESULT.near is not None
    scene, near = f"{species}-load-{seed}", replace(RESULT.near, predicted=ours, total=total)
    count = replace(RESULT, species=species, scene=scene, seed=seed, counted=ours, near=near, total_estimate=estimate)
    photos = StageResult(species=species, seed=seed, scene=scene, stage=TRUE_POSES, counted=seen)
    return [record_of(count, "voting"), record_of(photos, TWO_PHOTOS)]


APPLES = [
    *measured("apple", 301, 50, 90, 100.0, 110),
    *measured("apple", 302, 100, 180, 200.0, 200),
    *measured("apple", 303, 150, 200, 300.0, 330),
]


def mean_and_largest(errors: list[float]) -> str:
    return f"{100 * np.mean(np.abs(errors)):.0f} %, {100 * np.max(np.abs(errors)):.0f} %"


def line_of(start: str, records: list[Record], part: int = 0) -> str:
    """The line of one of the two tables."""
    return next(line for line in TABLES[TWO_PHOTOS](records).split("\n\n")[part].splitlines() if line.startswith(start))


def test_the_mean_of_the_other_trees_is_compared_with_counts_that_get_their_factors_from_these_trees() -> None:
    errors = {
        "mean of the others": [265 / 110 - 1, 220 / 200 - 1, 155 / 330 - 1],
        "two photos": [50 * 530 / 250 / 110 - 1, 100 * 440 / 200 / 200 - 1, 150 * 310 / 150 / 330 - 1],
        "our count": [90 * 530 / 380 / 110 - 1, 180 * 440 / 290 / 200 - 1, 200 * 310 / 270 / 330 - 1],
        "our estimate": [100 / 110 - 1, 0.0, 300 / 330 - 1],
    }
    cells = " | ".join(map(mean_and_largest, errors.values()))
    assert line_of("| 3 apple", APPLES) == f"| 3 apple | 110–330 | {cells} |"
    assert line_of("| **all 3**", APPLES) == f"| **all 3** |  | {cells} |"


def test_trees_that_all_bear_the_same_number_are_predicted_without_a_photo_and_have_no_r2() -> None:
    same = [record for seed in (301, 302, 303) for record in measured("plum", seed, seed - 290, 90, 100.0, 104)]
    assert line_of("| 3 plum", same).startswith("| 3 plum | 104–104 | 0 %, 0 % |")
    assert line_of("| 3 plum", same, part=1) == "| 3 plum |  |  |  |"


def test_r2_is_the_squared_correlation_with_the_true_number_between_trees_of_a_species() -> None:
    totals = [110, 200, 330]
    numbers = ([50, 100, 150], [90, 180, 200], [100, 200, 300])
    r2 = [np.corrcoef(each, totals)[0, 1] ** 2 for each in numbers]
    assert line_of("| 3 apple", APPLES, part=1) == f"| 3 apple | {' | '.join(f'{each:.3f}' for each in r2)} |"


def test_a_difference_between_species_is_not_part_of_r2() -> None:
    pears = [record for seed in (301, 302, 303) for record in measured("pear", seed, 500 + seed % 2, 500, 900.0, 1000)]
    together = line_of("| **all 6**", [*APPLES, *pears], part=1)
    alone = line_of("| **all 3**", APPLES, part=1)
    assert [float(cell) for cell in together.split("|")[2:5]] == pytest.approx(
        [float(cell) for cell in alone.split("|")[2:5]], abs=0.002
    )


def test_an_estimate_of_0_is_an_error_of_100_percent_and_a_tree_without_one_is_left_out() -> None:
    wrong = [*APPLES[:4], *measured("apple", 303, 150, 200, 0.0, 330)]
    assert line_of("| 3 apple", wrong).endswith("| 36 %, 100 % |")
    without = [*APPLES[:4], *measured("apple", 303, 150, 200, None, 330)]
    assert line_of("| 2 apple", without).startswith("| 2 apple | 110–200 |")


def test_a_single_tree_has_no_other_to_get_a_factor_from() -> None:
    assert "apple" not in TABLES[TWO_PHOTOS](APPLES[:2])
