"""What is learnt from examples, and which Gaussians an example has."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from taught_words import feature_of, features_with, small_encoder, word_of

from fruitlangs.engine.errors import EncoderError, VocabularyError
from fruitlangs.engine.language.features.features import Features
from fruitlangs.engine.language.prompts.relevancy import relevancy
from fruitlangs.engine.language.taught.word import LARGEST_FILE, MOST_VECTORS, TaughtWord, read_word, save_word
from fruitlangs.engine.language.teaching.learning import Background, Examples, contradiction, learn
from fruitlangs.engine.language.teaching.lesson import MOST_ROWS, Lesson, Mark
from fruitlangs.engine.language.teaching.region import MOST, SAMPLE, Ground

FIGS, LEAVES, SOIL = np.array([2.0, 0.0, 0.0]), np.array([0.0, 2.0, 0.0]), np.array([0.0, 2.0, 2.0])
TAGS = np.array([2.0, 0.0, 1.2])
"""Middles of clusters of evidence: tags look nearly like figs."""


def cluster(middle: NDArray[np.float64], count: int, seed: int, spread: float = 0.2) -> NDArray[np.float64]:
    return middle + spread * np.random.default_rng(seed).normal(size=(count, 3))


def examples_of(*shown: tuple[NDArray[np.float64], bool]) -> Examples:
    """One example of each pair of evidence (n, F) and whether it shows the word."""
    sizes = [len(vectors) for vectors, _ in shown]
    return Examples(
        np.concatenate([vectors for vectors, _ in shown]),
        np.repeat([positive for _, positive in shown], sizes),
        np.zeros(sum(sizes)),
        np.repeat(np.arange(len(shown)), sizes),
    )


def background_of(*clusters: NDArray[np.float64]) -> Background:
    vectors = np.concatenate(clusters)
    return Background(vectors, np.zeros(len(vectors)), np.ones(len(vectors)))


def chances(learnt: tuple[torch.Tensor, float], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    weights, bias = learnt
    return 1.0 / (1.0 + np.exp(-(vectors @ weights.double().numpy() + bias)))


TREE = background_of(cluster(FIGS, 150, 1), cluster(LEAVES, 500, 2), cluster(SOIL, 350, 10))
CLICKED = cluster(FIGS, 30, 3)


def test_one_click_finds_the_fruit_in_the_background_that_was_not_clicked_on() -> None:
    found = chances(learn(examples_of((CLICKED, True)), TREE), TREE.vectors)
    assert found[:150].min() > 0.5 > found[150:].max()
    assert np.median(found[:150]) > 0.8
    assert np.median(found[150:]) < 0.1


def test_fruit_that_fills_a_third_of_the_scene_is_found_too() -> None:
    tree = background_of(cluster(FIGS, 350, 1), cluster(LEAVES, 400, 2), cluster(SOIL, 250, 10))
    found = chances(learn(examples_of((CLICKED, True)), tree), tree.vectors)
    assert np.median(found[:350]) > 0.5 > np.median(found[350:])


def test_equal_examples_give_equal_words_to_the_last_bit() -> None:
    (one, bias), (other, other_bias) = (learn(examples_of((CLICKED, True)), TREE) for _ in range(2))
    assert one.numpy().tobytes() == other.numpy().tobytes()
    assert bias == other_bias
    assert one.dtype == torch.float32


def test_a_word_does_not_depend_on_the_unit_of_its_evidence() -> None:
    unit = np.array([1.0, 100.0, 0.1])
    plain = chances(learn(examples_of((CLICKED, True)), TREE), TREE.vectors)
    tree = Background(TREE.vectors * unit + 7.0, TREE.prior, TREE.weights)
    assert np.abs(chances(learn(examples_of((CLICKED * unit + 7.0, True)), tree), tree.vectors) - plain).max() < 0.02


def test_one_negative_example_turns_down_what_looks_like_it() -> None:
    tags = cluster(TAGS, 40, 4)
    tree = background_of(cluster(FIGS, 150, 1), cluster(LEAVES, 850, 2), tags)
    before = chances(learn(examples_of((CLICKED, True)), tree), tags)
    learnt = learn(examples_of((CLICKED, True), (cluster(TAGS, 30, 5), False)), tree)
    assert np.median(before) > 0.5
    assert np.median(chances(learnt, tags)) < 0.3
    assert np.median(chances(learnt, tree.vectors[:150])) > 0.5


def test_a_large_example_counts_as_much_as_a_small_one() -> None:
    other = FIGS + [0.0, 0.0, 2.0]
    small, large = cluster(FIGS, 20, 6), cluster(other, 20, 7)
    tree = background_of(TREE.vectors, cluster(other, 150, 8))
    even, uneven = (
        chances(learn(examples_of((small, True), (np.tile(large, (times, 1)), True)), tree), tree.vectors)
        for times in (1, 50)
    )
    assert np.abs(even - uneven).max() < 1e-6


def test_the_answer_of_a_built_in_word_is_learnt_from_as_it_is() -> None:
    said = np.where(np.arange(1000) < 150, 4.0, -4.0)
    right = learn(replace(examples_of((CLICKED, True)), prior=np.full(30, 4.0)), replace(TREE, prior=said))
    without = learn(examples_of((CLICKED, True)), TREE)
    assert np.abs(right[0].numpy()).max() < 0.5 * np.abs(without[0].numpy()).max()


def test_one_negative_example_corrects_a_built_in_word_and_keeps_its_other_answers() -> None:
    tags = cluster(TAGS, 40, 4)
    vectors = np.concatenate([cluster(FIGS, 150, 1), cluster(LEAVES, 810, 2), tags])
    said = np.where((np.arange(1000) < 150) | (np.arange(1000) >= 960), 2.0, -4.0)
    tree = Background(vectors, said, np.ones(1000))
    weights, bias = learn(replace(examples_of((cluster(TAGS, 30, 5), False)), prior=np.full(30, 2.0)), tree)
    now = 1.0 / (1.0 + np.exp(-(vectors @ weights.double().numpy() + bias + said)))
    assert np.median(now[960:]) < 0.3
    assert np.median(now[:150]) > 0.8
    assert (now[:150] < 0.5).mean() <= 0.02
    assert now[150:960].max() < 0.1


@pytest.mark.parametrize("shown", [[], [(CLICKED, False)]])
def test_without_a_positive_example_no_word_is_learnt(shown: list[tuple[NDArray[np.float64], bool]]) -> None:
    examples = (
        examples_of(*shown) if shown else Examples(np.zeros((0, 3)), np.zeros(0, bool), np.zeros(0), np.zeros(0, int))
    )
    with pytest.raises(VocabularyError, match="positive example is missing"):
        learn(examples, TREE)


def test_a_positive_and_a_negative_example_of_the_same_place_contradict_each_other() -> None:
    other = cluster(LEAVES, 10, 9)
    assert contradiction(examples_of((other, False), (CLICKED, True), (CLICKED[::-1], False)), TREE) == (1, 2)
    assert contradiction(examples_of((other, False), (CLICKED, True), (CLICKED, True)), TREE) is None
    assert contradiction(examples_of((CLICKED, False), (CLICKED, False)), TREE) is None


def orchard(figs: int = 60, wall: int = 600, seed: int = 0) -> tuple[Ground, Features]:
    """Two balls of figs, 1 apart along x, before a wall of leaves, whose lower half is soil."""
    rng = np.random.default_rng(seed)
    balls = [rng.normal(size=(figs, 3)) * 0.02 + [x, 0.0, 0.0] for x in (0.0, 1.0)]
    lower = np.arange(wall) >= wall // 2
    y = rng.uniform(0.0, 0.5, wall) * np.where(lower, 1.0, -1.0)
    background = np.stack([rng.uniform(-0.5, 1.5, wall), y, np.full(wall, 0.2)], axis=1)
    means = torch.from_numpy(np.concatenate([*balls, background])).float()
    surroundings = np.where(lower[:, None], SOIL, LEAVES) + cluster(np.zeros(3), wall, seed + 2, 0.1)
    evidence = np.concatenate([cluster(FIGS, 2 * figs, seed + 1, 0.1), surroundings])
    vectors = torch.stack([feature_of("purple", plum=0.5)] * 2 * figs + [feature_of("green", leaf=0.9)] * wall)
    features = features_with(vectors, torch.from_numpy(evidence).float())
    return Ground.of(means, features), features


def taught(ground: Ground, features: Features, *marks: Mark, start: TaughtWord | None = None) -> TaughtWord:
    return Lesson("fig", ground, features, small_encoder(), start).word(marks)


def click(ground: Ground, *place: float, positive: bool = True, name: str = "IMG_1.jpg:5,6") -> Mark:
    return Mark(positive, name, ground.grow_region(np.array(place)), torch.full((64, 64, 3), 200, dtype=torch.uint8))


def test_a_click_on_one_fruit_teaches_a_prompt_that_finds_the_others() -> None:
    ground, features = orchard()
    word = taught(ground, features, click(ground, 0.0, 0.0, 0.0))
    found = relevancy(features, small_encoder(word), ["figs"])
    assert float(found[60:120].min()) > 0.5 > float(found[120:].max())
    assert word.examples[0].place == "IMG_1.jpg:5,6"
    assert word.examples[0].gaussians == len(word.vectors) == 60
    assert word.thumbnails.shape == (1, 64, 64, 3)


def test_equal_lessons_write_equal_files(tmp_path: Path) -> None:
    for name in ("one", "other"):
        ground, features = orchard(wall=SAMPLE + 500)
        save_word(tmp_path / name, taught(ground, features, click(ground, 0.0, 0.0, 0.0)))
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()


def test_a_lesson_without_a_positive_example_says_so() -> None:
    ground, features = orchard()
    for marks in ([], [click(ground, 0.0, 0.0, 0.2, positive=False)]):
        with pytest.raises(VocabularyError, match="positive example is missing"):
            taught(ground, features, *marks)


def test_a_contradiction_names_both_places() -> None:
    ground, features = orchard()
    one, other = click(ground, 0.0, 0.0, 0.0), click(ground, 0.0, 0.0, 0.0, positive=False, name="IMG_2.jpg:7,8")
    with pytest.raises(VocabularyError, match=r"IMG_1\.jpg:5,6 shows 'fig' and IMG_2\.jpg:7,8 does not"):
        taught(ground, features, one, other)


def test_of_a_large_example_an_even_selection_is_learnt_from() -> None:
    ground, features = orchard(figs=1000, wall=100)
    word = taught(ground, features, Mark(True, "IMG_1.png, area 1", np.arange(1000)))
    assert len(word.vectors) == MOST_ROWS
    assert word.examples[0].gaussians == 1000
    assert torch.equal(word.vectors[[0, -1]], torch.from_numpy(ground.evidence[[0, 999]]).half())


def test_a_lesson_goes_on_from_the_examples_of_another_scene() -> None:
    ground, features = orchard(seed=0)
    first = replace(taught(ground, features, click(ground, 0.0, 0.0, 0.0)), notes="gate", licence="CC0")
    other_ground, other_features = orchard(seed=20)
    negative = click(other_ground, 0.0, 0.0, 0.2, positive=False, name="B.jpg:1,2")
    word = taught(other_ground, other_features, negative, start=first)
    assert [each.place for each in word.examples] == ["IMG_1.jpg:5,6", "B.jpg:1,2"]
    assert torch.equal(word.vectors[:60], first.vectors)
    assert word.groups.tolist() == [0] * 60 + [1] * (len(word.vectors) - 60)
    assert word.positive[:60].all()
    assert not word.positive[60:].any()
    assert len(word.thumbnails) == 2
    assert (word.notes, word.licence) == ("gate", "CC0")
    found = relevancy(other_features, small_encoder(word), ["fig"])
    assert float(found[:120].min()) > 0.5 > float(found[120:].max())


def test_a_lesson_does_not_go_on_from_another_word_or_another_encoder() -> None:
    ground, features = orchard()
    with pytest.raises(VocabularyError, match="of the word 'kiwi', not of 'fig'"):
        taught(ground, features, start=word_of("kiwi", 1.0, 1.0, 1.0))
    with pytest.raises(EncoderError, match="with the encoder another"):
        taught(ground, features, start=word_of("fig", 1.0, 1.0, 1.0, encoder_id="another"))


def test_features_that_cannot_be_asked_are_not_taught_from() -> None:
    ground, features = orchard()
    with pytest.raises(EncoderError, match="earlier version"):
        taught(ground, replace(features, embedding=None))
    with pytest.raises(EncoderError, match="another"):
        taught(ground, replace(features, encoder_id="another"))
    with pytest.raises(VocabularyError, match="describes"):
        Lesson("red fig", ground, features, small_encoder())


def test_a_lesson_on_a_built_in_word_corrects_it() -> None:
    ground, features = orchard()
    encoder = small_encoder()
    word = Lesson("Pflaumen", ground, features, encoder).word([click(ground, 0.0, 0.0, 0.0)])
    before, after = (relevancy(features, encoder.with_words(own), ["plum"]) for own in ({}, {"plum": word}))
    assert word.name == "plum"
    assert torch.allclose(word.prior, torch.logit(before[:60]), atol=0.01)
    assert bool((after[:120] > before[:120]).all())
    assert bool((after[120:] < 0.1).all())


def test_ten_thousand_examples_take_seconds_and_a_file_keeps_no_more_than_it_may() -> None:
    ground, features = orchard(figs=400, wall=6000)
    rng = np.random.default_rng(3)
    marks = [Mark(True, f"a.jpg:{k},1", rng.integers(0, 800, 4)) for k in range(5000)]
    marks += [Mark(False, f"a.jpg:{k},2", rng.integers(800, 6800, 4)) for k in range(5000)]
    before = time.perf_counter()
    word = taught(ground, features, *marks)
    assert time.perf_counter() - before < 8.0
    assert len(word.vectors) == len(word.groups) == len(word.prior) == MOST_VECTORS < 40_000
    assert word.positive.sum() == MOST_VECTORS // 2
    found = relevancy(features, small_encoder(word), ["fig"])
    assert float(found[:800].median()) > 0.8
    assert float(found[800:].median()) < 0.1


def test_a_word_of_many_clicks_can_be_read_again(tmp_path: Path) -> None:
    ground, features = orchard()
    clicks = LARGEST_FILE // (64 * 64 * 3) + 1
    word = taught(ground, features, *[click(ground, 0.0, 0.0, 0.0)] * clicks)
    save_word(tmp_path / "fig.fruitword", word)
    assert read_word(tmp_path / "fig.fruitword").name == "fig"


def test_a_small_example_among_many_large_ones_is_learnt_from() -> None:
    ground, features = orchard()
    large = [Mark(False, "b.csv", np.arange(120, 520))] * 60
    assert taught(ground, features, *large, Mark(True, "fruit 7", np.array([3])), *large).positive.any()


def test_a_lesson_does_not_go_on_from_evidence_of_another_length() -> None:
    ground, features = orchard()
    with pytest.raises(EncoderError, match="Teach it again"):
        taught(ground, features, click(ground, 0.0, 0.0, 0.0), start=word_of("fig", 1.0, 1.0))


def test_only_gaussians_that_photos_show_are_taught_from() -> None:
    _, features = orchard()
    weights, means = features.weights.clone(), torch.rand(len(features), 3)
    weights[10], means[20] = 0.1, torch.nan
    ground = Ground.of(means, replace(features, weights=weights))
    assert sorted(set(range(len(features))) - set(ground.rows.tolist())) == [10, 20]
    assert len(ground.evidence) == len(ground.means) == len(ground.weights) == len(features) - 2


def test_a_click_shows_alike_gaussians_that_hang_together_and_no_others() -> None:
    ground, _ = orchard()
    near = ground.grow_region(np.array([0.0, 0.0, 0.0]))
    assert sorted(near.tolist()) == list(range(60))
    on_wall = ground.grow_region(np.array([0.5, 0.0, 0.2]))
    assert on_wall.min() >= 120
    assert len(on_wall) == MOST


def test_a_click_does_not_show_the_leaves_that_touch_a_fruit() -> None:
    means = torch.from_numpy(cluster(np.zeros(3), 120, 1)).float()
    means[40:80, 0] += 0.6
    means[80:, 0] += 9.0
    evidence = np.concatenate([cluster(each, 40, 2, 0.05) for each in (FIGS, LEAVES, SOIL)])
    ground = Ground.of(means, features_with(torch.stack([feature_of("red")] * 120), torch.from_numpy(evidence)))
    assert sorted(ground.grow_region(np.zeros(3)).tolist()) == list(range(40))
    assert sorted(ground.grow_region(np.array([0.6, 0.0, 0.0])).tolist()) == list(range(40, 80))


def test_alike_gaussians_of_a_fruit_further_off_are_not_shown() -> None:
    ground, _ = orchard(figs=20)
    assert sorted(ground.grow_region(np.array([1.0, 0.0, 0.0])).tolist()) == list(range(20, 40))


def test_a_click_shows_the_nearest_gaussians_first_and_no_more_than_it_may() -> None:
    ground, _ = orchard(figs=300)
    place = np.array([0.01, 0.0, 0.0])
    found = ground.grow_region(place)
    away = np.linalg.norm(ground.means[found] - place, axis=1)
    assert (np.diff(away) >= 0.0).all()
    assert len(found) == MOST


def test_a_scene_of_few_gaussians_is_shown_as_a_whole() -> None:
    means = torch.tensor([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    ground = Ground.of(means, features_with(torch.stack([feature_of("red")] * 2), torch.zeros(2, 3)))
    assert ground.grow_region(np.zeros(3)).tolist() == [0, 1]


def test_the_background_is_a_sample_of_the_scene_by_its_pixels() -> None:
    ground, features = orchard(figs=500, wall=9000)
    weights = features.weights.clone()
    weights[:1000] = 1e4
    background = Ground.of(torch.from_numpy(ground.means), replace(features, weights=weights)).sample_background(
        np.arange(10_000.0)
    )
    assert len(background.vectors) == SAMPLE
    assert (background.prior < 1000).sum() > 950
    assert np.array_equal(background.vectors, ground.evidence[background.prior.astype(int)])
