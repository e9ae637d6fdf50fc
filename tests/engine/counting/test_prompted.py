"""Prompts in a scene whose fruit the encoder takes for another kind."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import simulated_fruit as sim
import torch

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting import prompted
from fruitlangs.engine.counting.accounts.zero import Quality
from fruitlangs.engine.counting.fruit import FruitCount
from fruitlangs.engine.counting.prompted import Searched, count_prompts
from fruitlangs.engine.errors import CountingError
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.language.features.features import Features
from fruitlangs.engine.language.prompts.selection import select
from fruitlangs.engine.language.vocabulary import COLOURS, CONCEPTS
from fruitlangs.engine.scene.camera import Scene

CONFIG = CountConfig(sample_budget=4_000)
SEEN_AS_LEMON: Mapping[str, float] = {"lemon": 0.85, "plum": 0.05, "leaf": 0.1}
LEAF: Mapping[str, float] = {"leaf": 0.98, "plum": 0.02}


@pytest.fixture(scope="module")
def tree() -> sim.Simulation:
    return sim.simulate(sim.Setting(fruit=8, clump=1, sheets=0, floaters=0, views=8), seed=5)


@pytest.fixture(scope="module")
def encoder() -> EmbeddedEncoder:
    return EmbeddedEncoder.open()


def vector(shares: Mapping[str, float], color: str) -> torch.Tensor:
    values = torch.zeros(len(CONCEPTS) + len(COLOURS))
    for word, share in shares.items():
        values[CONCEPTS.index(word)] = share / 2.0
    values[len(CONCEPTS) + COLOURS.index(color)] = 0.5
    return values.sqrt()


def scene_of(tree: sim.Simulation, encoder: EmbeddedEncoder, *fruit: Mapping[str, float], **more: Any) -> Searched:
    """The tree whose fruit look like each of `fruit` in turn."""
    means = tree.gaussians.means.double().numpy()
    owners = np.linalg.norm(means[:, None] - tree.truth.centers, axis=2).argmin(axis=1)
    looks = [vector(each, "yellow") for each in fruit]
    rows = [
        looks[owner % len(looks)] if likely >= 0.5 else vector(LEAF, "green")
        for owner, likely in zip(owners.tolist(), tree.probability, strict=True)
    ]
    ones = torch.ones(len(rows), 1)
    features = Features(torch.stack(rows)[:, None], 50.0 * ones, ones, encoder.identity)
    up = np.array([0.0, 0.0, 1.0])
    scene = Scene(tree.cameras, [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), up)
    plain = Searched(scene, tree.gaussians, features, None, encoder, CONFIG)
    return dataclasses.replace(plain, **more)


def counted(searched: Searched, *prompts: str, negatives: tuple[str, ...] = ()) -> FruitCount:
    means = searched.gaussians.means
    probability = select(searched.features, searched.encoder, prompts, negatives, searched.config, means)
    return count_prompts(searched, prompts, negatives, probability)


def test_fruit_that_look_like_another_kind_give_a_loud_0(tree: sim.Simulation, encoder: EmbeddedEncoder) -> None:
    searched = scene_of(tree, encoder, SEEN_AS_LEMON)
    every = counted(searched, "fruit")
    found = counted(searched, "plum")
    assert every.count >= 6
    assert every.interval is not None
    assert (found.count, found.other_fruit) == (0, every.count)
    assert found.interval == (0, every.interval[1])
    assert f"{every.count} fruit of other kinds were found, most of which look like lemon" in found.notices[-1]


def test_fruit_of_the_prompt_and_of_any_kind_are_counted_once(
    tree: sim.Simulation, encoder: EmbeddedEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    count_fruit = prompted.count_fruit
    monkeypatch.setattr(prompted, "count_fruit", lambda *args, **more: calls.append(1) or count_fruit(*args, **more))
    searched = scene_of(tree, encoder, SEEN_AS_LEMON)
    for prompt in ("lemon", "fruit"):
        found = counted(searched, prompt)
        assert (found.count >= 6, found.other_fruit, list(found.notices)) == (True, 0, [])
    assert len(calls) == 2
    counted(searched, "plum")
    assert len(calls) == 4


def test_a_scene_without_fruit_is_a_quiet_0(tree: sim.Simulation, encoder: EmbeddedEncoder) -> None:
    found = counted(scene_of(tree, encoder, LEAF), "plum")
    assert (found.count, found.other_fruit, list(found.notices)) == (0, 0, [])


def test_a_surrounding_is_not_compared_with_fruit(tree: sim.Simulation, encoder: EmbeddedEncoder) -> None:
    searched = scene_of(tree, encoder, SEEN_AS_LEMON)
    for prompts in (("bucket",), ("plum", "bucket")):
        found = counted(searched, *prompts)
        assert (found.count, found.other_fruit, list(found.notices)) == (0, 0, [])


def test_excluded_fruit_are_not_reported(tree: sim.Simulation, encoder: EmbeddedEncoder) -> None:
    found = counted(scene_of(tree, encoder, SEEN_AS_LEMON), "plum", negatives=("lemon",))
    assert (found.count, found.other_fruit) == (0, 0)


def test_a_colour_is_a_choice_of_the_user(tree: sim.Simulation, encoder: EmbeddedEncoder) -> None:
    yellow = dataclasses.replace(tree.gaussians, sh=torch.tensor([1.1, 0.6, -1.3]).expand(len(tree.gaussians), 1, 3))
    searched = scene_of(tree, encoder, SEEN_AS_LEMON, gaussians=yellow)
    lemons = counted(searched, "lemon").count
    blue = counted(searched, "blue lemon")
    assert (blue.count, blue.other_fruit, blue.other_colors) == (0, 0, lemons)
    assert blue.interval == (0, 0)
    assert blue.notices[-1] == f"no blue lemon was counted, but {lemons} fruit of other colours were found"
    assert counted(searched, "yellow plum").other_fruit == lemons
    assert "count with the prompt yellow fruit" in counted(searched, "yellow plum").notices[-1]
    assert counted(searched, "blue plum").other_fruit == 0
    assert "fruit of other colours" in counted(searched, "blue plum").notices[-1]


def test_a_0_whose_other_fruit_cannot_be_counted_stays_a_0_that_says_so(
    tree: sim.Simulation, encoder: EmbeddedEncoder
) -> None:
    flat = dataclasses.replace(tree.gaussians, opacity_logits=torch.full_like(tree.gaussians.opacity_logits, -8.0))
    blurred = Quality(15.0, 0.45)
    searched = scene_of(tree, encoder, SEEN_AS_LEMON, gaussians=flat, quality=blurred)
    found = counted(searched, "plum")
    assert found.count == 0
    assert found.notices[-1].startswith("fruit of other kinds could not be counted: The 0 for fruit is not a count")
    with pytest.raises(CountingError, match="The 0 for lemon is not a count"):
        counted(searched, "lemon")


def test_a_row_without_the_fruit_needs_no_fruit_of_other_kinds_on_each_tree(
    tree: sim.Simulation, encoder: EmbeddedEncoder
) -> None:
    row = dataclasses.replace(CONFIG, trees=30)
    found = counted(scene_of(tree, encoder, SEEN_AS_LEMON, config=row), "plum")
    assert (found.count, found.other_fruit >= 6) == (0, True)
