"""The network that verifies fruit belongs to the networks whose maps it was trained on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from balls_in_photos import balls_of, verifier_of

from fruitlangs.engine.counting.photos.places import NO_PLACES, Places
from fruitlangs.engine.counting.photos.verifier import (
    CELLS,
    FORMAT,
    SCENE,
    STORED,
    Network,
    Networks,
    read_networks,
    require_trained_for,
    write_networks,
)
from fruitlangs.engine.counting.photos.view_kernels import CHANNELS
from fruitlangs.engine.errors import EncoderError
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.storage.files import read_tensors, write_tensors

BALLS = balls_of(np.array([0.06, 0.09, 0.08, 0.07, 0.08, 0.09]))


@pytest.mark.parametrize("error", [0.75, 1.0, 1.25])
def test_a_sphere_grows_to_the_radius_of_its_fruit(error: float) -> None:
    places = Places(BALLS.centers, error * BALLS.radii)
    said = verifier_of(BALLS, 0.16).verify(places, NO_PLACES)
    assert places.radii * np.exp(said.growths) == pytest.approx(BALLS.radii, rel=0.12)
    assert (said.log_odds > 0.0).all()
    assert (said.radius_sds < 0.2).all()


def test_a_ball_that_is_much_larger_than_the_fruit_is_none_and_one_that_is_smaller_may_be_one() -> None:
    verifier = verifier_of(BALLS, 0.16)
    usual = verifier.verify(BALLS, NO_PLACES).log_odds
    of_small, of_large = (verifier.with_size(size, 0.1).verify(BALLS, NO_PLACES).log_odds for size in (0.06, 0.4))
    assert (usual > 0.0).all()
    assert (of_small < usual - 3.0).all()
    assert (of_large > 0.0).all()
    varied = verifier.with_size(0.06, 0.6).verify(BALLS, NO_PLACES).log_odds
    assert (varied > of_small).all()


def test_a_sphere_beside_its_fruit_moves_to_it() -> None:
    places = Places(BALLS.centers + [0.0, 0.02, -0.02], BALLS.radii)
    said = verifier_of(BALLS, 0.16).verify(places, NO_PLACES)
    assert np.linalg.norm(places.centers + said.moves - BALLS.centers, axis=1).max() < 0.012


def test_the_answers_of_several_networks_are_averaged(tmp_path: Path) -> None:
    torch.manual_seed(0)
    one, other = Network().eval(), Network().eval()
    path = tmp_path / "two.safetensors"
    write_networks(path, Networks([one, other]), [{"trees": ["a"]}, {"trees": ["b"]}], "one+offsets")
    stored = read_networks(path)
    given = torch.rand(5, 3, CHANNELS, CELLS, CELLS), torch.ones(5, 3, dtype=torch.bool), torch.rand(5, SCENE)
    with torch.inference_mode():
        for mean, first, second in zip(stored.networks(*given), one(*given), other(*given), strict=True):
            torch.testing.assert_close(mean, (first + second) / 2.0, atol=0.01, rtol=0.01)
    assert [each["trees"] for each in stored.notes] == [["a"], ["b"]]


def test_the_networks_of_the_package_belong_together() -> None:
    require_trained_for(EmbeddedEncoder.open().fruit_identity)


def test_a_verifier_of_other_networks_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "verifier.safetensors"
    write_networks(path, Networks([Network()]), [{}], "one+offsets")
    require_trained_for("one+offsets", path)
    with pytest.raises(EncoderError, match=r"trained for one\+offsets, not for one\+others.*fit_verifier\.py"):
        require_trained_for("one+others", path)


def test_a_verifier_that_does_not_say_what_it_was_trained_for_is_refused(tmp_path: Path) -> None:
    tensors, header = read_tensors(STORED)
    del header["encoder"]
    write_tensors(tmp_path / "old.safetensors", tensors, header)
    with pytest.raises(EncoderError, match="Install the package again"):
        read_networks(tmp_path / "old.safetensors")


@pytest.mark.parametrize("content", [b"", b"nothing", None])
def test_a_damaged_verifier_is_refused_with_a_sentence(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "verifier.safetensors"
    if content is None:
        write_tensors(path, {}, {"format": FORMAT, "encoder": "one", "networks": [{}]})
    else:
        path.write_bytes(content)
    with pytest.raises(EncoderError, match="Install the package again"):
        read_networks(path)
