"""Features on disk and how they are read back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.language.features.features import FORMAT, Features, Perceptron, load_features, save_features
from fruitlangs.engine.storage.files import write_tensors

FILE = "features.safetensors"


def _features(decoders: int = 0, levels: int = 3) -> Features:
    own = [Perceptron((torch.rand(4, 3), torch.rand(5, 4)), (torch.rand(4), torch.rand(5))) for _ in range(decoders)]
    agreement = torch.rand(7, levels).half().float()
    return Features(torch.rand(7, levels, 3), torch.rand(7, levels), agreement, "x-abc", tuple(own))


@pytest.mark.parametrize("decoders", [0, 1, 3])
def test_features_come_back_from_disk_as_they_were(tmp_path: Path, decoders: int):
    features = _features(decoders)
    save_features(tmp_path / FILE, features)
    loaded = load_features(tmp_path / FILE)
    for name in ("vectors", "weights", "agreement"):
        assert torch.equal(getattr(loaded, name), getattr(features, name))
    assert loaded.encoder_id == "x-abc"
    assert len(loaded.decoders) == decoders
    assert all(torch.equal(loaded.unit(level), features.unit(level)) for level in range(3))
    assert [path.name for path in tmp_path.iterdir()] == [FILE]


def test_the_embedding_of_features_comes_back_from_disk_as_it_was(tmp_path: Path):
    features = replace(_features(), embedding=torch.randn(7, 5).half())
    save_features(tmp_path / FILE, features)
    loaded = load_features(tmp_path / FILE)
    assert loaded.embedding is not None
    assert loaded.embedding.dtype == torch.float16
    assert torch.equal(loaded.embedding, features.embedding)
    save_features(tmp_path / FILE, _features())
    assert load_features(tmp_path / FILE).embedding is None


def test_an_embedding_of_other_gaussians_is_a_format_error(tmp_path: Path):
    for embedding in (torch.zeros(6, 5), torch.zeros(7)):
        save_features(tmp_path / FILE, replace(_features(), embedding=embedding))
        with pytest.raises(FormatError, match="its embedding does not fit"):
            load_features(tmp_path / FILE)


def test_the_evidence_for_taught_words_is_the_embedding_or_else_the_features_of_all_levels():
    features = _features(levels=2)
    vectors = features.vectors
    assert torch.equal(features.evidence(), torch.cat([vectors[:, 0], vectors[:, 1]], dim=1))
    embedded = replace(features, embedding=torch.randn(7, 5).half())
    assert torch.equal(embedded.evidence(slice(2, 4)), embedded.embedding[2:4].float())


def test_features_know_their_gaussians_from_others_after_they_came_back_from_disk(tmp_path: Path):
    means = torch.rand(7, 3)
    save_features(tmp_path / FILE, _features().of(means))
    loaded = load_features(tmp_path / FILE)
    assert loaded.are_of(means)
    assert not loaded.are_of(means.flip(0))
    assert not loaded.are_of(means[:6])


def test_features_of_a_file_that_does_not_say_whose_they_are_fit_as_many_gaussians(tmp_path: Path):
    features = _features()
    tensors = {name: getattr(features, name) for name in ("vectors", "weights", "agreement")}
    write_tensors(tmp_path / FILE, tensors, {"format": FORMAT, "encoder_id": "x", "decoders": 0})
    assert load_features(tmp_path / FILE).are_of(torch.rand(7, 3))
    assert not load_features(tmp_path / FILE).are_of(torch.rand(6, 3))


def test_half_precision_halves_the_file_and_moves_cosines_by_less_than_a_thousandth(tmp_path: Path):
    drawn = torch.randn(200, 3, 512, generator=torch.Generator().manual_seed(0))
    vectors = torch.nn.functional.normalize(drawn, dim=-1)
    whole = Features(vectors, torch.ones(200, 3), torch.ones(200, 3), "x")
    save_features(tmp_path / FILE, whole)
    size = (tmp_path / FILE).stat().st_size
    save_features(tmp_path / FILE, Features(vectors.half(), torch.ones(200, 3), torch.ones(200, 3), "x"))
    assert (tmp_path / FILE).stat().st_size < 0.51 * size
    loaded = load_features(tmp_path / FILE)
    assert loaded.unit(1).dtype == torch.float32
    text = vectors[:50, 0].T
    assert float((loaded.unit(1) @ text - whole.unit(1) @ text).abs().max()) < 1e-3


def test_codes_are_decoded_to_unit_features_with_their_own_levels_decoder():
    double, swap = torch.eye(3) * 2.0, torch.eye(3).flip(0)
    decoders = tuple(Perceptron((weight,), (torch.zeros(3),)) for weight in (double, swap))
    codes = torch.tensor([[[0.0, 0.0, 0.5], [0.0, 0.0, 0.5]]])
    features = Features(codes, torch.ones(1, 2), torch.ones(1, 2), "x", decoders)
    assert torch.allclose(features.unit(0), torch.tensor([[0.0, 0.0, 1.0]]))
    assert torch.allclose(features.unit(1), torch.tensor([[1.0, 0.0, 0.0]]))


def test_a_code_of_length_zero_is_a_zero_feature():
    decoder = Perceptron((torch.eye(3),), (torch.ones(3),))
    assert not decoder(torch.zeros(1, 3)).any()


@pytest.mark.parametrize("kept", [0, 5, 100])
def test_damaged_features_are_a_format_error(tmp_path: Path, kept: int):
    save_features(tmp_path / FILE, _features())
    (tmp_path / FILE).write_bytes((tmp_path / FILE).read_bytes()[:kept])
    with pytest.raises(FormatError, match="holds no features"):
        load_features(tmp_path / FILE)


def test_missing_features_are_a_format_error(tmp_path: Path):
    with pytest.raises(FormatError):
        load_features(tmp_path / "none.safetensors")


def test_features_of_the_former_format_are_a_format_error_that_says_what_to_do(tmp_path: Path):
    header = {"format": "fruitlangs-features-1", "encoder_id": "x"}
    write_tensors(tmp_path / FILE, {"vectors": torch.rand(7, 3), "weights": torch.rand(7)}, header)
    with pytest.raises(FormatError, match="Count again from the photos"):
        load_features(tmp_path / FILE)


def test_tensors_that_do_not_fit_each_other_are_a_format_error(tmp_path: Path):
    features = _features()
    save_features(tmp_path / FILE, Features(features.vectors, features.weights[:5], features.agreement, "x"))
    with pytest.raises(FormatError, match="do not fit"):
        load_features(tmp_path / FILE)


def test_a_decoder_that_holds_nan_is_a_format_error(tmp_path: Path):
    broken = Perceptron((torch.full((5, 3), torch.nan),), (torch.zeros(5),))
    features = _features()
    save_features(tmp_path / FILE, Features(features.vectors, features.weights, features.agreement, "x", (broken,)))
    with pytest.raises(FormatError, match="decoder 0"):
        load_features(tmp_path / FILE)
