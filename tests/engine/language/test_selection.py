"""Which Gaussians are what was asked for: levels, the paper's two thresholds, smoothing."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.errors import ConfigError, EncoderError, VocabularyError
from fruitlangs.engine.language.encoders.encoder import Question
from fruitlangs.engine.language.features.features import Features, Perceptron
from fruitlangs.engine.language.prompts.levels import best_level
from fruitlangs.engine.language.prompts.relevancy import MIN_WEIGHT, relevancy
from fruitlangs.engine.language.prompts.selection import dual_threshold, select, smooth

WORDS = ("apple", "pear", "leaf", "trunk")


class Basis:
    """An encoder whose words are the axes."""

    identity = "basis"
    dimension = len(WORDS)

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        for prompt in prompts:
            if prompt not in WORDS:
                raise VocabularyError(f"unknown word '{prompt}'")
        return torch.eye(len(WORDS))[[WORDS.index(prompt) for prompt in prompts]]

    def questions(self, prompt: str) -> Sequence[Question]:
        others = [word for word in WORDS if word != prompt]
        return [Question(self.encode_text([prompt]), self.encode_text(others), "cosine", 0.05, 0.0)]

    def kinds(self) -> Tensor:
        return torch.zeros(0, len(WORDS))

    def meaning(self, prompt: str) -> str:
        return prompt

    def separates(self, one: str, other: str) -> bool:
        return one != other

    def excludes(self, prompt: str, negative: str) -> bool:
        return prompt == negative


ENCODER = Basis()


def features(*levels: Sequence[Sequence[float]], weight: float = 100.0) -> Features:
    """Each level's vectors, one a Gaussian, made unit."""
    vectors = torch.nn.functional.normalize(torch.tensor(levels).transpose(0, 1), dim=-1)
    ones = torch.ones(vectors.shape[:2])
    return Features(vectors, ones * weight, ones, "basis")


def dual(given: Features, prompts: list[str], negatives: list[str], tau_pos: float, tau_neg: float) -> list[bool]:
    return dual_threshold(given, ENCODER, prompts, negatives, tau_pos=tau_pos, tau_neg=tau_neg).tolist()


def test_both_thresholds_of_the_paper_must_hold():
    given = features([[0.9, 0.0, 0.1, 0.0], [0.7, 0.0, 0.7, 0.0], [0.2, 0.0, 0.1, 0.9]])
    assert dual(given, ["apple"], ["leaf"], 0.6, 0.5) == [True, False, False]
    assert dual(given, ["apple"], ["leaf"], 0.6, 0.8) == [True, True, False]
    assert dual(given, ["apple"], [], 0.6, 0.0) == [True, True, False]


def test_thresholds_are_strict_as_the_paper_prints_them():
    given = features([[1.0, 0.0, 0.0, 0.0]])
    assert dual(given, ["apple"], ["leaf"], 1.0, 0.5) == [False]
    assert dual(given, ["apple"], ["leaf"], 0.5, 0.0) == [False]
    assert dual(given, ["apple"], ["leaf"], 0.5, 0.1) == [True]


def test_the_largest_cosine_of_several_prompts_counts():
    given = features([[0.9, 0.1, 0.0, 0.0], [0.1, 0.9, 0.0, 0.0], [0.0, 0.1, 0.9, 0.0]])
    assert dual(given, ["apple", "pear"], ["trunk", "leaf"], 0.8, 0.5) == [True, True, False]


def test_a_gaussian_that_hardly_any_pixel_drew_is_never_selected():
    given = features([[1.0, 0.0, 0.0, 0.0]], weight=MIN_WEIGHT / 2)
    assert dual(given, ["apple"], [], 0.5, 0.5) == [False]


def test_a_prompt_that_is_also_a_negative_is_refused():
    given = features([[1.0, 0.0, 0.0, 0.0]])
    with pytest.raises(VocabularyError, match="is excluded by"):
        dual(given, ["apple"], ["apple"], 0.5, 0.5)
    with pytest.raises(VocabularyError, match="is excluded by"):
        relevancy(given, ENCODER, ["apple"], ["apple"])


def test_features_of_another_encoder_are_refused_by_the_thresholds_too():
    given = features([[1.0, 0.0, 0.0, 0.0]])
    other = Features(given.vectors, given.weights, given.agreement, "another")
    with pytest.raises(EncoderError, match="another"):
        dual(other, ["apple"], [], 0.5, 0.5)


def test_the_settings_choose_how_is_selected():
    given, means = features([[0.9, 0.0, 0.3, 0.0], [0.2, 0.0, 0.9, 0.0]]), torch.rand(2, 3)
    chosen = select(given, ENCODER, ["apple"], ["trunk"], CountConfig(select="dual", tau_pos=0.1, tau_neg=0.5), means)
    assert chosen.tolist() == [1.0, 1.0]
    calibrated = select(given, ENCODER, ["apple"], ["trunk"], CountConfig(), means)
    assert float(calibrated[0]) > 0.9 > 0.1 > float(calibrated[1])


def test_a_threshold_beyond_any_cosine_is_refused():
    with pytest.raises(ConfigError, match="tau-pos"):
        CountConfig(tau_pos=1.5)


def test_each_word_uses_the_level_with_the_highest_confidence():
    apple_seen = [[1.0, 0.0, 0.2, 0.0], [0.0, 0.0, 0.7, 0.7]]
    leaf_seen = [[0.6, 0.0, 0.6, 0.5], [0.0, 0.0, 1.0, 0.0]]
    given = features(leaf_seen, apple_seen)
    assert float(relevancy(given, ENCODER, ["apple"])[0]) > 0.99
    assert float(relevancy(given, ENCODER, ["leaf"])[1]) > 0.99


def test_one_bright_speck_does_not_choose_the_level():
    """A level where a Gaussian of a fraction of a pixel is sure is not better than one where a whole fruit is."""
    fruit, weights = torch.tensor([0.3] * 50 + [0.0] * 50), torch.full((2, 100), 100.0)
    speck = fruit.clone()
    speck[:50], speck[99] = 0.1, 1.0
    weights[1, 99] = 0.4
    assert best_level(torch.stack([fruit, speck]), weights) == 0
    assert best_level(torch.stack([speck, fruit]), weights.flip(0)) == 1


def test_codes_are_asked_through_their_decoder():
    codes = torch.tensor([[[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]])
    apple_leaf = torch.zeros(4, 3)
    apple_leaf[0, 0] = apple_leaf[2, 1] = 1.0
    decoder = Perceptron((apple_leaf,), (torch.zeros(4),))
    given = Features(codes, torch.full((2, 1), 100.0), torch.ones(2, 1), "basis", (decoder,))
    apple, leaf = relevancy(given, ENCODER, ["apple"]).tolist()
    assert apple > 0.99 > 0.01 > leaf


def test_smoothing_takes_in_the_nearest_by_what_they_drew():
    means = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [5.0, 0, 0], [5.1, 0, 0], [0.05, 0, 0]])
    probability, weights = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.7]), torch.tensor([3.0, 1.0, 2.0, 2.0, 0.0])
    found = smooth(probability, weights, means, 1)
    assert torch.allclose(found, torch.tensor([0.75, 0.75, 0.0, 0.0, 0.7]))


def test_smoothing_over_more_neighbours_than_there_are_takes_them_all():
    found = smooth(torch.tensor([1.0, 0.0]), torch.ones(2), torch.rand(2, 3), 50)
    assert torch.allclose(found, torch.tensor([0.5, 0.5]))
