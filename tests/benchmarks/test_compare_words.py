"""Words are taught by clicks that a rule chooses, and measured where they are used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import ball_scene
import compare_words
import numpy as np
import pytest

from fruitlangs.benchmarks.teaching import (
    ACCEPTED,
    BUILT_IN,
    Correction,
    Tree,
    choose_name,
    correct,
    corrections_table,
    read_words_csv,
    try_words,
    words_csv,
    words_table,
)
from fruitlangs.engine.errors import ConfigError, FormatError
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.fitting.encoder.pictures import Box, Picture, box_labels
from fruitlangs.fitting.taught_photos import TaughtScore, score_taught


@pytest.fixture(scope="module")
def tree(balls: Path, counted_balls: Any) -> Tree:
    return Tree.of(balls, counted_balls)


def ball_at(tree: Tree, click: Any) -> int:
    """Number of the ball that a click is on; 0 for none."""
    view = [photo.name for photo in tree.result.scene.images].index(click.photo)
    return int(tree.instances[view][int(click.y), int(click.x)])


@pytest.mark.parametrize("number", [1, 3, 5])
def test_each_positive_click_is_on_another_fruit(tree: Tree, number: int):
    shown = [ball_at(tree, click) for click in tree.choose_positive_clicks(number)]
    assert len(set(shown)) == number
    assert min(shown) > 0


def test_there_are_no_more_positive_clicks_than_fruit(tree: Tree):
    assert len(tree.choose_positive_clicks(40)) == len(ball_scene.BALLS)


def test_negative_clicks_are_where_no_photo_shows_fruit_and_on_places_of_their_own(tree: Tree):
    word, seconds = tree.teach("own apple", 3, 0)
    marks = tree.choose_negative_marks(word, 3)
    assert len(marks) == 3
    assert seconds > 0.0
    rows = np.concatenate([mark.rows for mark in marks])
    assert len(np.unique(rows)) == len(rows)
    for mark in marks:
        assert not mark.positive
        assert tree._shown[mark.rows].mean() < ACCEPTED


def test_a_taught_word_is_counted_with_and_what_is_known_is_not_done_again(tree: Tree, tmp_path: Path):
    trials = list(try_words([tree], [(3, 1)], tmp_path / "words"))
    built_in, taught = trials
    assert (built_in.taught, built_in.positive, built_in.metrics.matched) == (BUILT_IN, 0, 5)
    assert (taught.taught, taught.positive, taught.negative) == (tree.folder.name, 3, 1)
    assert taught.metrics.matched >= 4
    file = tmp_path / "words.csv"
    file.write_text(words_csv(trials), encoding="utf-8")
    known = read_words_csv(file)
    assert known == trials
    wrong = replace(taught, metrics=replace(taught.metrics, f1=0.25))
    again = list(try_words([tree], [(3, 1)], tmp_path / "none", [built_in, wrong]))
    assert again == [built_in, wrong]
    assert not (tmp_path / "none").exists()
    assert "3 + 1, same" in words_table(again)
    assert "0.250 (0.25)" in words_table(again)


def test_where_nothing_is_false_there_is_nothing_to_correct(tree: Tree, tmp_path: Path):
    assert correct(tree, tmp_path) == []


def test_the_table_of_corrections_says_what_each_changed():
    changed = Correction(scene="balls", fruit=7, gone=True, false=2, false_after=1, true=5, true_after=4)
    assert "balls | 7 | gone | 2, 1 | 5, 4" in corrections_table([changed])


def test_a_new_word_does_not_refine_a_built_in_one():
    assert (choose_name("apple"), choose_name("fig")) == ("own apple", "fig")


@pytest.mark.parametrize(("text", "clicks"), [("3", (3, 0)), ("5+5", (5, 5))])
def test_clicks_are_read(text: str, clicks: tuple[int, int]):
    assert compare_words.read_clicks(text) == clicks


@pytest.mark.parametrize("text", ["0", "+5", "x", "5+y", "", "-1"])
def test_clicks_that_are_no_numbers_are_an_error(text: str):
    with pytest.raises(ConfigError, match="positive clicks"):
        compare_words.read_clicks(text)


def test_a_damaged_table_is_an_error(tmp_path: Path):
    (tmp_path / "words.csv").write_text("species,scene\nfig,fig-1\n", encoding="utf-8")
    with pytest.raises(FormatError, match="damaged"):
        read_words_csv(tmp_path / "words.csv")


def test_without_scenes_and_photos_there_is_nothing_to_do(tmp_path: Path):
    with pytest.raises(ConfigError, match="Nothing is given"):
        compare_words.main(compare_words.Options(out=tmp_path))


def test_a_word_is_taught_and_measured_in_photos_larger_than_what_is_seen():
    """Two red balls on green: their pixels rank above the others."""
    rng, height, width = np.random.default_rng(0), 120, 1200
    boxes = [Box("apple", left, 40, left + 60, 100) for left in (200, 800)]
    down, right = np.mgrid[:height, :width] + 0.5
    pictures = []
    for _ in range(2):
        pixels = np.array([60.0, 105.0, 45.0]) * rng.uniform(0.5, 1.3, (height, width, 1))
        for box in boxes:
            away = np.hypot(right - box.left - 30, down - box.top - 30) / 30.0
            light = 0.4 + 0.6 * np.sqrt(np.clip(1.0 - away**2, 0.0, 1.0))
            pixels = np.where(away[..., None] < 1.0, np.array([205.0, 45.0, 40.0]) * light[..., None], pixels)
        labels = box_labels(boxes, (height, width))
        pictures.append(Picture(np.clip(pixels, 0, 255).astype(np.uint8), labels, "apple", boxes))
    score = score_taught(EmbeddedEncoder.open(), pictures[:1], pictures[1:])["apple"]
    assert (score.photos, score.boxes) == (1, 2)
    assert score.taught > 0.95


def test_the_table_of_photos_names_what_was_taught_on():
    score = TaughtScore(photos=10, boxes=91, taught=0.5, built_in=0.75)
    assert "apple | 91 boxes in 10 photos | 0.500 | 0.750" in compare_words.photos_table({"apple": score})
