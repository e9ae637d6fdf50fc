"""Every way to a count of 0: an answer with an interval, or an error that names the cause."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
import simulated_fruit as sim
import torch

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting import count, sizing
from fruitlangs.engine.counting.accounts.zero import Matching, Quality, count_apart, count_groups
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.counting.evidence.size import FruitSize
from fruitlangs.engine.counting.evidence.visibility import draw
from fruitlangs.engine.counting.fruit import FruitCount
from fruitlangs.engine.counting.published import fruitnerf, template
from fruitlangs.engine.errors import CountingError
from fruitlangs.engine.language.prompts.photo_probability import PhotoMap
from fruitlangs.engine.report.words import count_text, explain_nothing_found

CONFIG = CountConfig(sample_budget=4_000)
POOR, BLURRED, GOOD = Quality(15.0, 0.35), Quality(17.7, 0.55), Quality(21.0, 0.65)


@pytest.fixture(scope="module")
def tree() -> sim.Simulation:
    return sim.simulate(sim.Setting(fruit=8, clump=3, sheets=0, floaters=8, views=8), seed=5)


@pytest.fixture(scope="module")
def sheets() -> sim.Simulation:
    """Leaf sheets that match the prompt; the only fruit does not."""
    leaves = sim.simulate(sim.Setting(fruit=1, sheets=5, floaters=0, leaves=0, views=8), seed=3)
    on_fruit = np.linalg.norm(leaves.gaussians.means.numpy() - leaves.truth.centers[0], axis=1) < 0.7
    return dataclasses.replace(leaves, probability=np.where(on_fruit, 0.1, leaves.probability))


def counted(tree: sim.Simulation, config: CountConfig = CONFIG, **more: Any) -> FruitCount:
    return count_fruit(
        tree.gaussians, tree.probability, tree.cameras, config, label="apple", visibility=tree.visibility, **more
    )


def matching(tree: sim.Simulation) -> int:
    return int((tree.probability >= 0.5).sum())


def transparent(tree: sim.Simulation) -> sim.Simulation:
    opacities = torch.full_like(tree.gaussians.opacity_logits, -8.0)
    return dataclasses.replace(tree, gaussians=dataclasses.replace(tree.gaussians, opacity_logits=opacities))


def hidden(tree: sim.Simulation) -> sim.Simulation:
    unseen = dataclasses.replace(tree.visibility, weights=np.zeros_like(tree.visibility.weights))
    return dataclasses.replace(tree, visibility=unseen)


def sideless(tree: sim.Simulation) -> sim.Simulation:
    """Gaussians that the cameras see equally from opposite sides."""
    seen = dataclasses.replace(tree.visibility, directions=np.zeros_like(tree.visibility.directions))
    return dataclasses.replace(tree, visibility=seen)


def unlike(tree: sim.Simulation) -> sim.Simulation:
    return dataclasses.replace(tree, probability=np.full(len(tree.gaussians), 0.31))


def photos_of(tree: sim.Simulation, probability: np.ndarray) -> list[PhotoMap]:
    """What photos show of Gaussians with these probabilities."""
    pictures = draw(tree.gaussians, np.asarray(probability, np.float64), tree.cameras)
    return [PhotoMap(picture.fruit, np.zeros((*picture.fruit.shape, 2), np.float32)) for picture in pictures]


def test_a_word_that_nothing_matches_is_0_without_an_interval(tree: sim.Simulation) -> None:
    result = counted(unlike(tree), quality=BLURRED)
    assert (result.count, result.interval, result.total_interval, result.notices) == (0, None, None, ())


def test_a_word_that_nothing_matches_in_a_poor_reconstruction_is_an_error(tree: sim.Simulation) -> None:
    said = r"The 0 for apple is not a count: held-out photos .* \(PSNR 15.0 dB, SSIM 0.35\), and no Gaussian reaches"
    with pytest.raises(CountingError, match=said):
        counted(unlike(tree), quality=POOR)


def test_a_word_that_neither_gaussians_nor_photos_match_is_a_certain_0(tree: sim.Simulation) -> None:
    result = counted(unlike(tree), photos=photos_of(tree, np.zeros(len(tree.gaussians))))
    assert (result.count, result.interval, result.total_interval, result.notices) == (0, (0, 0), (0, 0), ())


def test_gaussians_that_match_where_photos_show_nothing_are_a_certain_0(tree: sim.Simulation) -> None:
    nothing_shown = photos_of(tree, np.zeros(len(tree.gaussians)))
    for made in (transparent, sideless):
        result = counted(made(tree), quality=GOOD, photos=nothing_shown)
        assert (result.interval, result.total_interval, list(result.notices)) == ((0, 0), (0, 0), [])


def test_photos_that_show_what_no_gaussian_matches_give_an_interval_and_say_what(tree: sim.Simulation) -> None:
    shown = photos_of(tree, tree.probability)
    result = counted(unlike(tree), photos=shown)
    assert result.count == 0
    assert result.interval == result.total_interval
    assert result.interval is not None
    assert 5 <= result.interval[1] <= 16  # 8 fruit in clumps of 3, and 8 single Gaussians
    assert re.match(
        rf"no fruit was counted, but photos show {result.interval[1]} places that match apple "
        r"\(probability about 0\.\d\d, about \d+ pixels wide\)",
        result.notices[-1],
    )
    two = [PhotoMap(each.probability * (view < 2), each.offsets) for view, each in enumerate(shown)]
    assert counted(unlike(tree), photos=two).interval == (0, 0)


def test_what_photos_show_outside_the_region_is_not_in_the_interval_of_a_0(tree: sim.Simulation) -> None:
    shown = photos_of(tree, tree.probability)
    center = tree.truth.centers[0]
    box = tuple(float(value) for value in (*(center - 0.7), *(center + 0.7)))
    result = counted(unlike(tree), dataclasses.replace(CONFIG, box=box), photos=shown)
    assert result.interval is not None
    assert 1 <= result.interval[1] <= 2


def test_candidates_that_photos_do_not_show_are_not_in_the_interval_of_a_0(sheets: sim.Simulation) -> None:
    config = dataclasses.replace(CONFIG, diameter=1.0)
    nothing_shown = photos_of(sheets, np.zeros(len(sheets.gaussians)))
    result = counted(sheets, config, quality=GOOD, photos=nothing_shown)
    assert (result.count, result.interval, result.total_interval) == (0, (0, 0), (0, 0))


def test_photos_narrow_the_interval_from_candidates_and_never_widen_it(tree: sim.Simulation) -> None:
    everywhere, shown = np.ones(len(tree.gaussians), bool), photos_of(tree, tree.probability)
    matching = Matching.of(
        tree.gaussians, tree.probability, everywhere, tree.cameras, "apple", GOOD, shown, CONFIG.threshold
    )
    places = matching.count_shown(1.0)
    assert 5 <= places <= 16
    none = FruitCount(fruits=[], audit=[], max_probability=0.9, mean_diameter=None)
    candidates = dataclasses.replace(none, interval=(0, 241), likely=50.0, total=60.0, total_interval=(0, 300))
    narrowed = matching.add_bounds(candidates, 1.0, searched=True)
    assert (narrowed.interval, narrowed.likely, narrowed.total) == ((0, places), places, places)
    assert narrowed.total_interval == (0, places)
    few = dataclasses.replace(none, interval=(0, 2), likely=0.5, total=0.7, total_interval=(0, 3))
    assert matching.add_bounds(few, 1.0, searched=True).interval == (0, 2)
    assert matching.add_bounds(few, 1.0, searched=True).total_interval == (0, 3)
    assert matching.add_bounds(few, 1.0).interval == (0, places)


def test_fruit_on_surfaces_that_photos_refuse_are_in_the_intervals_of_a_0_and_in_its_notice(
    tree: sim.Simulation,
) -> None:
    everywhere, hidden = np.ones(len(tree.gaussians), bool), photos_of(tree, np.zeros(len(tree.gaussians)))
    matching = Matching.of(
        tree.gaussians, tree.probability, everywhere, tree.cameras, "apple", GOOD, hidden, CONFIG.threshold
    )
    none = FruitCount(fruits=[], audit=[], max_probability=0.9, mean_diameter=None)
    refused = matching.add_bounds(none, 1.0, refused=9)
    assert (refused.interval, refused.total_interval) == ((0, 9), (0, 9))
    assert "look like apple in 9 places, but photos show none" in refused.notices[-1]
    assert matching.add_bounds(none, 1.0).interval == (0, 0)


@pytest.mark.parametrize(("made", "reason"), [(transparent, "are transparent"), (sideless, "faces the cameras")])
def test_gaussians_that_match_without_a_fruit_give_an_interval_up_to_what_may_be_there(
    tree: sim.Simulation, made: Any, reason: str
) -> None:
    result = counted(made(tree), quality=GOOD)
    assert result.count == 0
    assert reason in result.audit[0].reason
    assert result.interval is not None
    assert result.interval == result.total_interval
    assert result.interval[0] == 0
    assert 5 <= result.interval[1] <= 25  # 8 fruit in clumps of 3, and 8 single Gaussians that match
    assert result.notices[-1].startswith(f"no fruit was counted, but {matching(tree)} Gaussians match apple: up to")
    assert f"90 % interval 0–{result.interval[1]}" in count_text(result)
    assert reason in explain_nothing_found(result, 0.5, None)


def test_fruit_that_no_view_shows_may_be_hidden_fruit_only(tree: sim.Simulation) -> None:
    result = counted(hidden(tree))
    assert result.total_interval is not None
    assert (result.count, result.interval) == (0, (0, 0))
    assert result.total_interval[1] >= 5
    assert "hidden fruit may be there" in result.notices[-1]
    assert "no view shows any" in result.audit[0].reason


@pytest.mark.parametrize("made", [transparent, hidden, sideless])
def test_a_blurred_reconstruction_of_what_matches_is_an_error(tree: sim.Simulation, made: Any) -> None:
    with pytest.raises(CountingError, match=r"reproduced poorly \(PSNR 17.7 dB, SSIM 0.55\)"):
        counted(made(tree), quality=BLURRED)


def test_without_a_round_surface_the_size_comes_from_the_pictures(
    tree: sim.Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = counted(tree)
    monkeypatch.setattr(sizing, "estimate_diameter", lambda *args, **kwargs: None)
    result = counted(tree)
    assert abs(result.count - usual.count) <= 1
    assert result.mean_diameter == pytest.approx(usual.mean_diameter, rel=0.1)
    assert "estimated from the widths of its regions" in result.notices[0]


def test_what_is_not_round_in_sharp_gaussians_is_no_fruit(
    tree: sim.Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sizing, "estimate_diameter", lambda *args, **kwargs: None)
    assert counted(tree, quality=BLURRED).count > 0
    result = counted(tree, quality=GOOD)
    assert (result.count, result.fruits) == (0, [])
    assert result.interval is not None
    assert result.interval[1] > 0
    assert "lie on anything round" in result.audit[0].reason


@pytest.mark.parametrize("method", ["template", "fruitnerf"])
def test_the_published_methods_use_a_size_from_the_pictures_too(
    tree: sim.Simulation, monkeypatch: pytest.MonkeyPatch, method: Any
) -> None:
    monkeypatch.setattr(sizing, "estimate_diameter", lambda *args, **kwargs: None)
    result = counted(tree, dataclasses.replace(CONFIG, method=method))
    assert result.count > 0
    assert "estimated from the widths of its regions" in result.notices[0]


def test_gaussians_larger_than_the_fruit_are_an_error(tree: sim.Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(count, "fruit_size", lambda *args: FruitSize(1e-6, 0.2))
    with pytest.raises(CountingError, match=r"larger than the expected fruit\. The reconstruction is too blurred"):
        counted(tree)


def test_a_given_diameter_below_the_gaussians_is_an_error_that_names_it(tree: sim.Simulation) -> None:
    with pytest.raises(CountingError, match=r"larger than the expected fruit\. --count.diameter 1e-06 is too small"):
        counted(tree, dataclasses.replace(CONFIG, diameter=1e-6))


def test_a_0_for_a_given_diameter_that_is_not_the_scenes_is_an_error(tree: sim.Simulation) -> None:
    with pytest.raises(CountingError, match=r"not a count: fruit of diameter 6 scene units .* --count.diameter says"):
        counted(tree, dataclasses.replace(CONFIG, diameter=6.0))


def test_sheets_that_match_are_0_with_an_interval(sheets: sim.Simulation) -> None:
    result = counted(sheets, dataclasses.replace(CONFIG, diameter=1.0), quality=GOOD)
    assert result.interval is not None
    assert (result.count, result.interval[0]) == (0, 0)
    assert any("likely a fruit" in entry.reason for entry in result.audit)


def test_sheets_that_match_in_a_blurred_reconstruction_are_an_error(sheets: sim.Simulation) -> None:
    with pytest.raises(CountingError, match=r"reproduced poorly .* no candidate .* has the shape of a fruit"):
        counted(sheets, dataclasses.replace(CONFIG, diameter=1.0), quality=BLURRED)


def test_a_0_of_fruit_a_few_pixels_wide_is_an_error(sheets: sim.Simulation) -> None:
    small = dataclasses.replace(sheets, cameras=[camera.scale(0.1) for camera in sheets.cameras])
    with pytest.raises(CountingError, match=r"a fruit is only about \d pixels wide.*Read the photos larger"):
        counted(small, dataclasses.replace(CONFIG, diameter=1.0), quality=GOOD)


@pytest.mark.parametrize("method", ["template", "fruitnerf"])
def test_a_0_of_a_published_method_has_an_interval(
    tree: sim.Simulation, monkeypatch: pytest.MonkeyPatch, method: Any
) -> None:
    monkeypatch.setattr(template, "SMALLEST_VOLUME", 1e6)  # of a cluster that is kept
    monkeypatch.setattr(fruitnerf, "LEAST_VOLUME", 1e6)
    result = counted(tree, dataclasses.replace(CONFIG, method=method), quality=GOOD)
    assert result.interval is not None
    assert (result.count, result.interval[0]) == (0, 0)
    assert 8 <= result.interval[1] <= 25


def test_quality_without_held_out_photos_is_no_cause() -> None:
    assert not Quality.of({"psnr": None, "ssim": None}).blurred
    assert Quality.of({"psnr": 25.0, "ssim": 0.39}).poor
    assert not Quality(18.4, 0.51).blurred  # a scene of the ladder that is counted


def test_a_reconstruction_is_judged_by_its_photos_at_one_size() -> None:
    training = {"psnr": 16.0, "ssim": 0.39, "reduced_psnr": 19.0, "reduced_ssim": 0.61}
    assert Quality.of(training) == Quality(19.0, 0.61)
    assert Quality.of(training | {"reduced_psnr": None, "reduced_ssim": None}) == Quality(None, None)


def test_a_count_in_a_blurred_reconstruction_says_so(tree: sim.Simulation) -> None:
    assert "PSNR 17.7 dB, SSIM 0.55" in counted(tree, quality=BLURRED).notices[0]
    assert list(counted(tree, quality=GOOD).notices) == []


def test_places_a_diameter_apart_are_counted_once() -> None:
    balls = np.array([[0.0, 0.0, 0.0], [1.1, 0.0, 0.0], [9.0, 0.0, 0.0]])
    around = np.random.default_rng(0).normal(size=(600, 3))
    around *= 0.45 / np.linalg.norm(around, axis=1, keepdims=True)
    positions = balls[np.arange(600) % 3] + around
    assert 3 <= count_apart(positions, 1.0) <= 5
    assert count_groups(positions, 0.4) == 2  # the first two touch
    assert count_groups(positions[:0], 0.4) == 0
