"""Colour words are shares measured from pixels."""

from __future__ import annotations

import pytest
import torch
from matplotlib.colors import XKCD_COLORS, to_rgb

from fruitlangs.engine.config import EmbedConfig
from fruitlangs.engine.language.colours import _LIGHTNESS, _PROTOTYPES, _SPREAD, cielab, colour_words, fruit_colours
from fruitlangs.engine.language.encoders.open_encoder import open_encoder
from fruitlangs.engine.language.prompts.relevancy import answer
from fruitlangs.engine.language.vocabulary import COLOURS, CONCEPTS, FRUIT_COLOURS


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


def test_shares_are_those_of_the_distances_to_the_nearest_example_of_each_word():
    image = torch.rand(40, 30, 3, generator=torch.Generator().manual_seed(4))
    weight = torch.tensor([_LIGHTNESS, 1.0, 1.0])
    examples = [cielab(torch.tensor(_PROTOTYPES[word]).reshape(-1, 3) / 255.0) * weight for word in COLOURS]
    apart = [(cielab(image)[..., None, :] * weight - own).square().sum(-1).amin(-1) for own in examples]
    expected = torch.softmax(-0.5 * torch.stack(apart, dim=-1) / _SPREAD**2, dim=-1)
    torch.testing.assert_close(colour_words(image), expected, atol=1e-4, rtol=0.0)


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


@pytest.mark.parametrize(
    ("word", "rgb"),
    [("red", (172, 46, 38)), ("orange", (217, 122, 28)), ("yellow", (222, 188, 50)), ("yellow", (179, 181, 47)),
     ("green", (115, 150, 52)), ("blue", (60, 70, 130)), ("purple", (85, 45, 100)), ("pink", (230, 120, 170))],
)  # fmt: skip
@pytest.mark.parametrize("light", [1.0, 0.3, 0.1])
def test_fruit_has_the_same_colour_in_sun_and_in_shade(word: str, rgb: tuple[int, int, int], light: float):
    linear = (torch.tensor(rgb) / 255.0) ** 2.2 * light
    assert FRUIT_COLOURS[int(fruit_colours(linear ** (1.0 / 2.2)).argmax())] == word


def test_the_cheek_of_an_apple_is_red_and_its_greenish_yellow_side_green():
    cheek, side = torch.tensor([[200, 110, 60], [198, 184, 90]]) / 255.0
    words = [
        FRUIT_COLOURS[int(fruit_colours(each, kinds).argmax())] for each in (cheek, side) for kinds in (["apple"], [])
    ]
    assert words == ["red", "orange", "green", "yellow"]


def test_gloss_and_deep_shade_say_little_about_the_colour_of_fruit():
    red, gloss, shade = fruit_colours(torch.tensor([[172, 46, 38], [240, 240, 235], [14, 15, 10]]) / 255.0)
    assert red.sum() > 4.0 * gloss.sum()
    assert red.sum() > 4.0 * shade.sum()
    assert min(gloss.min(), shade.min()) >= 0.0 < min(gloss.sum(), shade.sum())


def test_the_hues_of_fruit_agree_with_what_people_call_colours():
    named = [name for name in XKCD_COLORS if name.removeprefix("xkcd:").split()[-1] in ("red", "yellow", "green")]
    said = fruit_colours(torch.tensor([to_rgb(XKCD_COLORS[name]) for name in named])).argmax(dim=-1)
    agree = [name.endswith(FRUIT_COLOURS[word]) for name, word in zip(named, said.tolist(), strict=True)]
    assert len(agree) > 200
    assert sum(agree) / len(agree) > 0.85
