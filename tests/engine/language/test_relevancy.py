"""Probabilities of prompts, from features whose answers are known."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fruitlangs.engine.errors import EncoderError, VocabularyError
from fruitlangs.engine.language.encoders.embedded import Calibration, EmbeddedEncoder
from fruitlangs.engine.language.encoders.network import Network
from fruitlangs.engine.language.features.features import Features
from fruitlangs.engine.language.prompts.prior import kind_shares, weigh_for_scene
from fruitlangs.engine.language.prompts.relevancy import (
    MIN_WEIGHT,
    answer,
    answers_by_level,
    any_of,
    exclusive_sets,
    relevancy,
    understand,
)
from fruitlangs.engine.language.vocabulary import COLOURS, CONCEPTS, FRUIT_COLOURS, FRUITS


@pytest.fixture(scope="module")
def encoder() -> EmbeddedEncoder:
    network = Network(len(CONCEPTS), widths=(2, 2, 2, 2), depths=(0, 0, 0, 0))
    return EmbeddedEncoder(network.fuse(), Calibration(), "test")


def _feature(colour: str, **concepts: float) -> Tensor:
    """A unit feature with these concept probabilities, the rest spread over the other concepts."""
    shares = torch.full((len(CONCEPTS),), (1.0 - sum(concepts.values())) / (len(CONCEPTS) - len(concepts)))
    for word, share in concepts.items():
        shares[CONCEPTS.index(word)] = share
    colours = torch.full((len(COLOURS),), 0.05 / (len(COLOURS) - 1))
    colours[COLOURS.index(colour)] = 0.95
    return torch.cat([shares, colours]).mul(0.5).sqrt()


def _features(*vectors: Tensor, weight: float = 0.5) -> Features:
    return one_level(torch.stack(vectors), torch.full((len(vectors),), weight), "test")


def one_level(vectors: Tensor, weights: Tensor, encoder_id: str) -> Features:
    return Features(vectors[:, None], weights[:, None], torch.ones(len(vectors), 1), encoder_id)


def test_probability_is_that_of_the_feature(encoder: EmbeddedEncoder):
    features = _features(_feature("red", apple=0.8), _feature("green", leaf=0.9, apple=0.05))
    assert torch.allclose(relevancy(features, encoder, ["apple"]), torch.tensor([0.8, 0.05]), atol=2e-3)


def test_fruit_is_the_sum_over_the_fruit_words(encoder: EmbeddedEncoder):
    features = _features(_feature("red", apple=0.5, peach=0.4, leaf=0.1))
    assert float(relevancy(features, encoder, ["fruit"])) == pytest.approx(0.9, abs=2e-3)


def test_a_colour_and_an_object_must_both_hold(encoder: EmbeddedEncoder):
    features = _features(_feature("red", apple=0.9), _feature("green", apple=0.9), _feature("red", leaf=0.9))
    red, green, leaf = relevancy(features, encoder, ["red apple"]).tolist()
    other_fruit_colours = 0.05 * (len(FRUIT_COLOURS) - 1) / (len(COLOURS) - 1)
    assert red == pytest.approx(0.9 * 0.95 / (0.95 + other_fruit_colours), abs=2e-3)
    assert max(green, leaf) < 0.02


def test_any_of_several_prompts_is_enough(encoder: EmbeddedEncoder):
    features = _features(_feature("red", apple=0.9), _feature("green", pear=0.9), _feature("green", leaf=0.9))
    apple, pear, leaf = relevancy(features, encoder, ["apple", "pear"]).tolist()
    assert min(apple, pear) > 0.89
    assert leaf < 0.05


def test_a_negative_phrase_takes_its_share_away(encoder: EmbeddedEncoder):
    features = _features(_feature("red", apple=0.9), _feature("green", apple=0.9))
    red, green = relevancy(features, encoder, ["apple"], ["green apple"]).tolist()
    assert red > 0.85
    assert green < 0.2


def test_a_hardly_seen_gaussian_has_probability_zero(encoder: EmbeddedEncoder):
    features = _features(_feature("red", apple=0.9), weight=MIN_WEIGHT / 2.0)
    assert float(relevancy(features, encoder, ["apple"])) == 0.0


def test_an_unseen_gaussian_with_a_zero_feature_has_probability_zero(encoder: EmbeddedEncoder):
    features = one_level(torch.zeros(1, encoder.dimension), torch.zeros(1), "test")
    assert float(relevancy(features, encoder, ["apple"])) == 0.0


def test_the_length_of_a_block_does_not_matter(encoder: EmbeddedEncoder):
    blocks = torch.tensor([0.4] * len(CONCEPTS) + [1.0] * len(COLOURS))
    mixed = torch.nn.functional.normalize(_feature("red", apple=0.8) * blocks, dim=0)
    expected = relevancy(_features(_feature("red", apple=0.8)), encoder, ["red apple"])
    assert torch.allclose(relevancy(_features(mixed), encoder, ["red apple"]), expected, atol=2e-3)


@pytest.mark.parametrize(("prompt", "negative"), [("apple", "Apples"), ("red apple", "apple"), ("apple", "fruit")])
def test_a_prompt_that_a_negative_rules_out_is_refused(encoder: EmbeddedEncoder, prompt: str, negative: str):
    with pytest.raises(VocabularyError, match="is excluded by"):
        relevancy(_features(_feature("red", apple=0.9)), encoder, [prompt], [negative])


def test_an_unknown_negative_is_refused(encoder: EmbeddedEncoder):
    with pytest.raises(VocabularyError, match="tractor"):
        relevancy(_features(_feature("red", apple=0.9)), encoder, ["apple"], ["tractor"])


def test_no_prompt_is_refused(encoder: EmbeddedEncoder):
    with pytest.raises(VocabularyError, match="No prompt is given"):
        relevancy(_features(_feature("red", apple=0.9)), encoder, [])


def test_features_of_another_encoder_are_refused(encoder: EmbeddedEncoder):
    features = one_level(torch.zeros(1, encoder.dimension), torch.ones(1), "another")
    with pytest.raises(EncoderError, match="another"):
        relevancy(features, encoder, ["apple"])


def test_an_uncertain_fruit_is_of_the_kind_of_the_scene(encoder: EmbeddedEncoder):
    sure, doubtful = _feature("red", apple=0.8, peach=0.1), _feature("red", apple=0.4, peach=0.5)
    alone = relevancy(_features(doubtful), encoder, ["apple"])
    among = relevancy(_features(doubtful, *[sure] * 20, weight=1000.0), encoder, ["apple"])
    assert float(alone[0]) < 0.5 < 0.8 < float(among[0])


def test_a_certain_fruit_of_another_kind_stays_itself(encoder: EmbeddedEncoder):
    apple, pear = _feature("red", apple=0.9, pear=0.02), _feature("green", pear=0.9, apple=0.02)
    features = _features(*[apple] * 5, pear, weight=1000.0)
    assert float(relevancy(features, encoder, ["pear"])[-1]) > 0.8


def test_the_scene_does_not_change_how_much_a_gaussian_is_fruit(encoder: EmbeddedEncoder):
    vectors = torch.stack([_feature("red", apple=0.5, leaf=0.2), _feature("green", leaf=0.8, pear=0.1)])
    weighed = weigh_for_scene(vectors, torch.full((2,), 1e5), encoder.kinds(), torch.tensor([True] + [False] * 7))
    assert torch.allclose(weighed.norm(dim=1), torch.ones(2), atol=1e-5)
    before, after = (answer(each, encoder.questions("fruit")) for each in (vectors, weighed))
    assert torch.allclose(before, after, atol=1e-5)


def test_the_shares_of_kinds_are_those_of_the_fruit(encoder: EmbeddedEncoder):
    vectors = torch.stack([_feature("red", apple=0.9)] * 3 + [_feature("green", pear=0.9)])
    shares = kind_shares(vectors, torch.full((4,), 1e6), encoder.kinds(), torch.zeros(len(FRUITS), dtype=torch.bool))
    assert float(shares[CONCEPTS.index("apple")]) == pytest.approx(0.75, abs=0.03)
    assert float(shares[CONCEPTS.index("pear")]) == pytest.approx(0.25, abs=0.03)


def test_many_uncertain_fruit_do_not_rule_out_the_kind_that_is_asked_for(encoder: EmbeddedEncoder):
    doubtful = [_feature("red", peach=0.4, pear=0.45)] * 500
    features = _features(*doubtful, weight=1e4)
    assert float(relevancy(features, encoder, ["peach"]).min()) > 0.25  # nearly 0 if 500 alike were 500 proofs
    assert float(relevancy(features, encoder, ["lemon"]).max()) < 0.05


def test_the_kind_that_is_asked_for_must_be_seen(encoder: EmbeddedEncoder):
    features = _features(*[_feature("orange", orange=0.85, lemon=0.05)] * 50, weight=1e4)
    assert float(relevancy(features, encoder, ["lemon"]).max()) < 0.1
    assert float(relevancy(features, encoder, ["orange"]).min()) > 0.8


def test_a_prior_applies_to_prompts_and_not_to_negatives(encoder: EmbeddedEncoder):
    features = _features(*[_feature("red", apple=0.5, peach=0.3)] * 50, weight=1e4)
    asked = any_of(features, encoder, ["peach"])[0]
    avoided = any_of(features, encoder, ["peach"], sought=False)[0]
    assert float(avoided) < 0.5 * float(asked)


SYNONYMS = {
    "apple": ("Apples", "pomme", "an apple", "apple fruit"),
    "peach": ("peaches", "Pfirsich"),
    "red apple": ("pomme rouge", "apple red"),
    "fruit": ("fruits",),
    "red": ("rot",),
    "leaf": ("leaves", "Blatt"),
    "ripe plum": ("ripe plums",),
    "citrus": ("citrus fruit",),
}
PHRASES = st.lists(st.sampled_from(sorted(SYNONYMS)), min_size=1, max_size=5)
SEEN = [
    _feature("red", apple=0.5, peach=0.3),
    _feature("green", leaf=0.6, apple=0.3),
    _feature("red", plum=0.4, lemon=0.2),
    _feature("orange", orange=0.4, lemon=0.4),
    _feature("brown", soil=0.9),
]


@given(prompts=PHRASES, negatives=st.lists(st.sampled_from(["soil", "grass", "green"]), max_size=2), data=st.data())
def test_a_synonym_a_repetition_or_another_order_changes_no_probability(
    encoder: EmbeddedEncoder, prompts: list[str], negatives: list[str], data: st.DataObject
):
    features = _features(*SEEN, weight=100.0)
    plain = relevancy(features, encoder, prompts, negatives)
    again = [data.draw(st.sampled_from([word, *SYNONYMS[word]])) for word in prompts]
    mixed = data.draw(st.permutations([*prompts, *again]))
    twice = data.draw(st.permutations([*negatives, *negatives]))
    assert torch.equal(relevancy(features, encoder, mixed, twice), plain)


@given(prompts=PHRASES, other=st.sampled_from(sorted(SYNONYMS)))
def test_another_negative_never_adds_and_no_probability_leaves_its_range(
    encoder: EmbeddedEncoder, prompts: list[str], other: str
):
    features = _features(*SEEN, weight=100.0)
    found = relevancy(features, encoder, prompts)
    assert bool(((found >= 0.0) & (found <= 1.0)).all())
    if not any(encoder.excludes(prompt, other) for prompt in prompts):
        assert bool((relevancy(features, encoder, prompts, [other]) <= found).all())


@pytest.mark.parametrize(
    ("narrow", "wide"), [("apple", "fruit"), ("red apple", "apple"), ("lemon", "citrus"), ("ripe plum", "plum")]
)
def test_a_word_within_another_takes_the_greater_probability(encoder: EmbeddedEncoder, narrow: str, wide: str):
    features = _features(*SEEN, weight=100.0)
    assert torch.equal(relevancy(features, encoder, [narrow, wide]), relevancy(features, encoder, [wide]))
    assert torch.equal(
        any_of(features, encoder, [narrow, wide], sought=False), any_of(features, encoder, [wide], sought=False)
    )


def test_kinds_that_exclude_each_other_add_up_to_all_fruit_at_most(encoder: EmbeddedEncoder):
    features = _features(_feature("red", apple=0.4, peach=0.4), weight=100.0)
    alone = understand(encoder, ["apple", "peach"])
    each = answers_by_level(features, alone)[0, :, 0]
    both = float(relevancy(features, encoder, ["apple", "peach"]))
    assert both == pytest.approx(float(each.sum()), abs=1e-6)
    assert each.max() < 0.5 < both
    everything = relevancy(features, encoder, [*FRUITS, "red fruit"])
    assert float(everything) == pytest.approx(float(relevancy(features, encoder, ["fruit"])), abs=1e-5)


def test_words_that_overlap_count_once(encoder: EmbeddedEncoder):
    features = _features(_feature("red", apple=0.5), weight=100.0)
    red, apple = (float(relevancy(features, encoder, [word])) for word in ("red", "apple"))
    assert float(relevancy(features, encoder, ["red", "apple"])) == max(red, apple)
    assert exclusive_sets(["apple", "peach", "red", "green leaf"], encoder) == [(0, 1, 3), (2, 3)]
