"""The embedded encoder: words, dense features, its weights on disk, and what the shipped weights see."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors import safe_open
from taught_words import word_of

from fruitlangs.engine.config import EmbedConfig
from fruitlangs.engine.errors import EncoderError, VocabularyError
from fruitlangs.engine.language.encoders.embedded import WEIGHTS, Calibration, EmbeddedEncoder, save_weights
from fruitlangs.engine.language.encoders.network import Network, normalise
from fruitlangs.engine.language.encoders.open_encoder import open_encoder
from fruitlangs.engine.language.encoders.seen import resize
from fruitlangs.engine.language.prompts.relevancy import answer, scene_answers, understand
from fruitlangs.engine.language.vocabulary import CONCEPTS, FRUIT_COLOURS, FRUITS, parse

EXAMPLE = Path(__file__).resolve().parents[4] / "examples" / "orchard_tree"
WIDTHS, DEPTHS = (4, 6, 8, 10), (1, 1, 1, 1)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    network = Network(len(CONCEPTS), widths=WIDTHS, depths=DEPTHS)
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_weights(
        path,
        network,
        Calibration(temperature=0.8, bias=0.5, kind_temperature=1.2),
        widths=WIDTHS,
        depths=DEPTHS,
        seeds=[1000],
    )
    return path


@pytest.fixture(scope="module")
def tiny(weights: Path) -> EmbeddedEncoder:
    return EmbeddedEncoder.open(weights)


def _noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_text_vectors_are_unit_and_a_phrase_lies_between_its_words(tiny: EmbeddedEncoder):
    red, apple, both, fruit = tiny.encode_text(["red", "apple", "red apple", "fruit"])
    for vector in (red, apple, both, fruit):
        assert float(vector.norm()) == pytest.approx(1.0, abs=1e-6)
    assert float(red @ apple) == 0.0
    assert float(both @ red) == pytest.approx(float(both @ apple)) == pytest.approx(0.5**0.5, abs=1e-6)


def test_an_unknown_word_is_a_vocabulary_error(tiny: EmbeddedEncoder):
    with pytest.raises(VocabularyError, match="banana"):
        tiny.encode_text(["apple", "banana"])


@pytest.mark.parametrize("size", [(37, 23), (64, 48), (5, 90)])
def test_dense_features_of_a_small_picture_are_unit_and_of_its_size(tiny: EmbeddedEncoder, size: tuple[int, int]):
    features = tiny.encode_dense(_noise(*size))
    assert features.shape == (*size, tiny.dimension)
    assert torch.allclose(features.norm(dim=-1), torch.ones(size), atol=1e-4)


def test_the_same_picture_gives_the_same_features(tiny: EmbeddedEncoder):
    image = _noise(40, 40)
    assert torch.equal(tiny.encode_dense(image), tiny.encode_dense(image.copy()))


def test_a_question_about_an_object_is_the_networks_probability_when_uncalibrated(weights: Path, tiny: EmbeddedEncoder):
    plain = EmbeddedEncoder(tiny.network, Calibration(), "plain")
    image = _noise(32, 32)
    pixels = torch.from_numpy(image).permute(2, 0, 1).float() / 255.0
    expected = plain.concept_logits(pixels).softmax(0)[CONCEPTS.index("pear")]
    assert torch.allclose(answer(plain.encode_dense(image), plain.questions("pear")), expected, atol=1e-4)


def test_logits_are_the_mean_of_those_at_each_scale(tiny: EmbeddedEncoder):
    pixels = torch.rand(3, 40, 60, generator=torch.Generator().manual_seed(2))
    large, small, both = (tiny.concept_logits(pixels, scales) for scales in ((2.0,), (1.0,), (2.0, 1.0)))
    assert small.shape[1:] == (20, 30)
    torch.testing.assert_close(both, (large + resize(small, 40, 60)) / 2.0, atol=1e-4, rtol=0.0)


def test_a_picture_is_seen_at_the_scales_for_fruit_of_unknown_width_unless_others_are_given(tiny: EmbeddedEncoder):
    image = _noise(30, 1200)
    assert tiny.encode_dense(image).shape[:2] == (12, 480)
    assert torch.equal(tiny.encode_dense(image), tiny.encode_dense(image, tiny.scales_of(30, 1200)))
    assert tiny.encode_dense(image, tiny.scales_of(30, 1200, 44.0)).shape[:2] == (15, 600)


def test_answers_about_disjoint_words_sum_to_one(tiny: EmbeddedEncoder):
    plain = EmbeddedEncoder(tiny.network, Calibration(), "plain")
    features = plain.encode_dense(_noise(16, 16))
    total = sum(answer(features, plain.questions(word)) for word in CONCEPTS)
    assert torch.allclose(total, torch.ones(16, 16), atol=1e-4)


def test_folding_the_normalisation_leaves_the_logits_alone():
    torch.manual_seed(1)
    network = Network(len(CONCEPTS), widths=WIDTHS, depths=DEPTHS)
    image = torch.rand(2, 3, 64, 64)
    for _ in range(3):
        network(normalise(image))
    with torch.no_grad():
        before = network.eval()(normalise(image))
        assert torch.allclose(network.fuse()(normalise(image)), before, atol=1e-4)


def test_missing_weights_are_an_encoder_error(tmp_path: Path):
    with pytest.raises(EncoderError, match=r"none\.safetensors are missing"):
        EmbeddedEncoder.open(tmp_path / "none.safetensors")


@pytest.mark.parametrize("kept", [0, 4, 200, 5000])
def test_damaged_weights_are_an_encoder_error(weights: Path, tmp_path: Path, kept: int):
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(weights.read_bytes()[:kept])
    with pytest.raises(EncoderError, match=r"broken\.safetensors cannot be read"):
        EmbeddedEncoder.open(broken)


def test_weights_for_another_shape_of_network_are_an_encoder_error(tmp_path: Path):
    network = Network(len(CONCEPTS), widths=WIDTHS, depths=DEPTHS)
    path = tmp_path / "other.safetensors"
    save_weights(path, network, Calibration(), widths=(4, 6, 8, 12), depths=DEPTHS)
    with pytest.raises(EncoderError, match="cannot be read"):
        EmbeddedEncoder.open(path)


def test_other_weights_have_another_identity(weights: Path, tiny: EmbeddedEncoder, tmp_path: Path):
    torch.manual_seed(5)
    path = tmp_path / "other.safetensors"
    save_weights(
        path, Network(len(CONCEPTS), widths=WIDTHS, depths=DEPTHS), Calibration(), widths=WIDTHS, depths=DEPTHS
    )
    assert EmbeddedEncoder.open(path).identity != tiny.identity
    assert EmbeddedEncoder.open(weights).identity == tiny.identity


def test_the_shipped_weights_are_small_and_open():
    assert WEIGHTS.stat().st_size <= 4 * 2**20
    assert open_encoder(EmbedConfig()).identity.startswith("embedded-")


def test_the_shipped_weights_saw_neither_the_sample_nor_the_test_scenes():
    with safe_open(WEIGHTS, framework="pt") as file:
        header = json.loads(file.metadata()["fruitlangs"])
    seeds = set(header["seeds"])
    assert seeds == set(json.loads(WEIGHTS.with_suffix(".json").read_text(encoding="utf-8"))["seeds"])
    assert seeds
    assert min(seeds) >= 1000
    samples = EXAMPLE.parent.glob("*/orchard.json")
    kept_out = {json.loads(path.read_text(encoding="utf-8"))["config"]["seed"] for path in samples} | {1, 2, 3, 4}
    assert not seeds & kept_out


def test_the_shipped_weights_find_the_fruit_of_the_sample_and_call_it_apple_before_anything_else():
    photo = sorted((EXAMPLE / "images").glob("*"))[0]
    image = np.asarray(Image.open(photo).convert("RGB"))
    truth = np.asarray(Image.open(EXAMPLE / "instances" / f"{photo.stem}.png")) > 0
    encoder = open_encoder(EmbedConfig())
    features = encoder.encode_dense(image).flatten(0, 1)
    weights = torch.full((len(features),), 10.0)
    words = ["fruit", *FRUITS]
    answers = torch.cat([scene_answers(features, weights, understand(encoder, [word])) for word in words])
    found = answers.numpy().reshape(-1, *truth.shape) >= 0.5
    assert (found[0] & truth).sum() / (found[0] | truth).sum() > 0.6
    named = {word: int((each & truth).sum()) for word, each in zip(words[1:], found[1:], strict=True)}
    assert max(named, key=lambda word: named[word]) == "apple"


@pytest.mark.parametrize(
    ("prompts", "negatives", "sought", "asked", "left"),
    [
        (["red apple"], [], "apple", {"red"}, []),
        (["red apple", "green apples"], ["leaf"], "apple", {"red", "green"}, ["leaf"]),
        (["apple"], ["green apple"], "apple", set(FRUIT_COLOURS) - {"green"}, []),
        (["unripe plum"], [], "plum", {"green"}, []),
        (["ripe"], [], "fruit", set(FRUIT_COLOURS) - {"green"}, []),
        (["fruit"], ["green apple", "green"], "fruit", set(FRUIT_COLOURS) - {"green"}, ["green apple"]),
        (["brown pear"], [], "pear", {"brown"}, []),
        (["orange"], ["green orange"], "orange", set(FRUIT_COLOURS) - {"green"}, []),
    ],
)
def test_a_colour_chooses_among_the_fruit_of_a_kind(
    tiny: EmbeddedEncoder, prompts: list[str], negatives: list[str], sought: str, asked: set[str], left: list[str]
):
    split = tiny.split_colours(prompts, negatives)
    assert split is not None
    assert list(split.prompts) == [sought]
    assert set(split.kinds) == set(parse(sought).concepts)
    assert {word for word, wanted in zip(split.words, split.asked, strict=True) if wanted} == asked
    assert list(split.negatives) == left


@pytest.mark.parametrize(
    ("prompts", "negatives"),
    [
        (["apple"], ["leaf"]),
        (["red"], []),
        (["red apple", "pear"], []),
        (["green leaf"], []),
        (["fruit"], ["red pear"]),
    ],
)
def test_colours_that_do_not_split_one_kind_of_fruit_stay_in_the_prompt(
    tiny: EmbeddedEncoder, prompts: list[str], negatives: list[str]
):
    assert tiny.split_colours(prompts, negatives) is None


@pytest.mark.parametrize(
    ("prompt", "general"),
    [
        ("plums", "fruit"),
        ("red plum", "red fruit"),
        ("prune verte", "green fruit"),
        ("unripe plum", "unripe fruit"),
        ("orange orange", "orange fruit"),
        ("citrus", "fruit"),
        ("fruit", None),
        ("red fruit", None),
        ("red", None),
        ("leaf", None),
    ],
)
def test_a_prompt_for_a_kind_has_one_for_any_kind_in_the_same_colours(
    tiny: EmbeddedEncoder, prompt: str, general: str | None
):
    assert tiny.of_any_kind(prompt) == general
    assert general is None or set(parse(general).concepts) == set(FRUITS)


def test_a_taught_fruit_has_a_prompt_for_any_kind(tiny: EmbeddedEncoder):
    taught = tiny.with_words({"fig": word_of("fig", 1.0)})
    assert taught.of_any_kind("green fig") == "green fruit"


def test_the_words_of_kinds_are_in_the_order_of_their_vectors(tiny: EmbeddedEncoder):
    torch.testing.assert_close(tiny.encode_text(tiny.kind_words) @ tiny.kinds().T, torch.eye(len(FRUITS)))
