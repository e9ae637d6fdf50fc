"""Colour words are shares measured from pixels."""

from __future__ import annotations

import pytest
import torch

from fruitlangs.engine.config import EmbedConfig
from fruitlangs.engine.language.colours import colour_words
from fruitlangs.engine.language.encoders.open_encoder import open_encoder
from fruitlangs.engine.language.prompts.relevancy import answer
from fruitlangs.engine.language.vocabulary import COLOURS, CONCEPTS


@pytest.mark.parametrize(
    ("word", "rgb"),
    [("red", (170, 25, 35)), ("green", (110, 150, 50)), ("green", (52, 95, 30)), ("yellow", (225, 195, 60)),
     ("orange", (230, 125, 30)), ("purple", (75, 40, 95)), ("blue", (90, 130, 210)), ("brown", (100, 70, 45)),
     ("white", (245, 244, 240)), ("grey", (120, 122, 121)), ("black", (15, 16, 14)), ("pink", (240, 160, 180)),
     ("red", (120, 20, 25))],
)  # fmt: skip
def test_a_typical_colour_gets_its_own_word(word: str, rgb: tuple[int, int, int]):
    shares = colour_words(torch.tensor(rgb) / 255.0)
    assert COLOURS[int(shares.argmax())] == word


def test_shares_sum_to_one_and_keep_the_picture_shape():
    shares = colour_words(torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0)))
    assert shares.shape == (4, 5, len(COLOURS))
    assert torch.allclose(shares.sum(-1), torch.ones(4, 5), atol=1e-5)


@pytest.mark.parametrize(
    ("prompt", "rgb", "is_so"),
    [("red apple", (71, 23, 7), True), ("red apple", (102, 33, 18), True), ("red apple", (51, 73, 13), False),
     ("green apple", (51, 73, 13), True), ("green apple", (75, 98, 41), True), ("green apple", (71, 23, 7), False),
     ("brown apple", (100, 70, 45), True), ("red", (71, 23, 7), False)],
)  # fmt: skip
def test_fruit_in_shade_keeps_the_colour_that_people_give_it(prompt: str, rgb: tuple[int, int, int], is_so: bool):
    colours = colour_words(torch.tensor(rgb) / 255.0)
    features = torch.cat([torch.zeros(len(CONCEPTS)), colours]).mul(0.5).sqrt()
    assert (float(answer(features, open_encoder(EmbedConfig()).questions(prompt)[-1:])) > 0.5) == is_so
