"""The crop encoder on real classes with random weights: what it gives, not what it knows."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from checkpoints import DIMENSION, write_clip, write_siglip

from fruitlangs.engine.config import EmbedConfig
from fruitlangs.engine.errors import VocabularyError
from fruitlangs.engine.language.encoders import clip as clip_module
from fruitlangs.engine.language.encoders.clip import ClipEncoder
from fruitlangs.engine.language.encoders.open_encoder import open_encoder
from fruitlangs.engine.language.features.features import Features
from fruitlangs.engine.language.prompts import relevancy as relevancy_module
from fruitlangs.engine.language.prompts.relevancy import check_prompts, relevancy


@pytest.fixture(scope="module", params=["clip", "siglip"])
def encoder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ClipEncoder:
    write = {"clip": write_clip, "siglip": write_siglip}[request.param]
    return ClipEncoder.open(str(write(tmp_path_factory.mktemp("checkpoints") / request.param)))


@pytest.fixture(scope="module")
def crops() -> list[np.ndarray]:
    generator = np.random.default_rng(0)
    return [generator.integers(0, 256, (side, side, 3)).astype(np.uint8) for side in (1, 9, 40, 448)]


def test_words_and_crops_are_unit_vectors_of_one_space(encoder, crops):
    words, pictures = encoder.encode_text(["apple", "pear"]), encoder.encode_crops(crops)
    assert words.shape == (2, encoder.dimension)
    assert pictures.shape == (4, encoder.dimension)
    for vectors in (words, pictures):
        assert vectors.dtype == torch.float32
        assert torch.allclose(vectors.norm(dim=1), torch.ones(len(vectors)))
    assert not torch.allclose(words[0], words[1])
    assert not torch.allclose(pictures[1], pictures[2])


def test_the_same_crops_give_the_same_bits(encoder, crops):
    assert torch.equal(encoder.encode_crops(crops), encoder.encode_crops(crops))


def test_crops_in_batches_are_as_crops_alone(encoder, crops, monkeypatch):
    at_once = encoder.encode_crops(crops)
    monkeypatch.setattr(clip_module, "BATCH", 3)
    assert torch.allclose(encoder.encode_crops(crops), at_once, atol=1e-5)


def test_no_crops_are_no_vectors(encoder):
    assert encoder.encode_crops([]).shape == (0, encoder.dimension)


def test_capitals_blanks_and_articles_do_not_matter_and_typos_are_words(encoder):
    plain, loud, wrong = encoder.encode_text(["green apple", "  a Green\tAPPLE ", "gren aple"])
    assert torch.equal(plain, loud)
    assert not torch.allclose(plain, wrong)


def test_a_text_does_not_depend_on_those_next_to_it(encoder):
    alone, beside = encoder.encode_text(["fig"]), encoder.encode_text(["fig", "persimmon"])
    assert torch.allclose(alone[0], beside[0], atol=1e-6)


@pytest.mark.parametrize("prompt", ["", "  ", "the"])
def test_a_prompt_without_a_word_is_an_error(encoder, prompt):
    with pytest.raises(VocabularyError, match="holds no word"):
        encoder.encode_text([prompt])


def test_a_prompt_longer_than_the_model_reads_is_an_error_and_one_just_short_enough_is_not(encoder):
    room = encoder.checkpoint.model.config.text_config.max_position_embeddings
    fits = max(
        n for n in range(1, room) if len(encoder.checkpoint.words(f"a photo of a {'z' * n}")["input_ids"]) <= room
    )
    encoder.encode_text(["z" * fits])
    with pytest.raises(VocabularyError, match=f"tokens long and the encoder reads {room}"):
        encoder.encode_text(["z" * (fits + 1)])


def test_a_prompt_is_put_against_the_negatives_but_not_against_itself(encoder):
    (question,) = encoder.questions("apple")
    assert question.score == "cosine"
    assert question.negatives.shape == (len(clip_module.NEGATIVES), encoder.dimension)
    for itself in ("Leaf", "leaves", "the leaf"):
        (question,) = encoder.questions(itself)
        assert len(question.negatives) == len(clip_module.NEGATIVES) - 1
        assert not torch.isclose(question.negatives, encoder.encode_text(["leaf"]), atol=1e-5).all(1).any()


def test_a_gaussian_that_looks_like_the_prompt_is_likelier_than_one_that_looks_like_a_negative(encoder):
    vectors = encoder.encode_text(["apple", "leaf"])
    features = Features(vectors[:, None], torch.ones(2, 1), torch.ones(2, 1), encoder.identity)
    apple, leaf = relevancy(features, encoder, ["apple"])
    assert apple > 0.5 > leaf


def test_a_prompt_that_is_also_a_negative_is_an_error(encoder):
    with pytest.raises(VocabularyError, match="excluded by the negative 'APPLE'"):
        check_prompts(encoder, ["apple"], ["APPLE"])


def test_the_settings_open_it(tmp_path):
    folder = write_clip(tmp_path / "tiny")
    opened = open_encoder(EmbedConfig(encoder="clip", clip=str(folder)))
    assert isinstance(opened, ClipEncoder)
    assert opened.dimension == DIMENSION


def test_words_are_read_once_however_many_gaussians_they_are_asked_of(encoder, monkeypatch):
    def texts_read(count: int) -> int:
        read: list[object] = []
        whole = ClipEncoder.encode_text
        vectors = torch.nn.functional.normalize(torch.ones(count, 2, encoder.dimension), dim=-1)
        features = Features(vectors, torch.ones(count, 2), torch.ones(count, 2), encoder.identity)
        with monkeypatch.context() as patched:
            patched.setattr(relevancy_module, "ROWS", 4)
            patched.setattr(ClipEncoder, "encode_text", lambda self, words: read.append(words) or whole(self, words))
            relevancy(features, encoder, ["apple"])
        return len(read)

    assert texts_read(12) == texts_read(1)


def test_a_word_is_read_once_and_alike_next_to_other_words(encoder, monkeypatch):
    model, read = encoder.checkpoint.model, []
    whole = model.get_text_features
    monkeypatch.setattr(model, "get_text_features", lambda tokens: read.append(tokens) or whole(tokens))
    alone = encoder.encode_text(["quince"])
    assert len(read) == 1
    assert torch.equal(encoder.encode_text(["medlar", "quince"])[1], alone[0])
    assert len(read) == 2
