"""The network that verifies fruit belongs to the networks whose maps it was trained on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from balls_in_photos import balls_of, verifier_of

from fruitlangs.engine.counting.photos import verifier
from fruitlangs.engine.counting.photos.verifier import (
    FORMAT,
    LARGEST,
    SEEN,
    STORED,
    Looked,
    Network,
    look,
    read_network,
    require_trained_for,
)
from fruitlangs.engine.errors import EncoderError
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.storage.files import halved, read_tensors, write_tensors


def test_spheres_and_known_fruit_are_judged_at_a_share_of_their_radii(monkeypatch: pytest.MonkeyPatch) -> None:
    balls, radii = balls_of(np.array([0.06, 0.09, 0.08])), []

    def recorded(*given: Any) -> Looked:
        radii.append((given[3], given[5]))
        return look(*given)

    monkeypatch.setattr(verifier, "look", recorded)
    odds, _ = verifier_of(balls, 0.16).verify(balls.select(np.arange(2)), balls, np.arange(2))
    ((own, known),) = radii
    seen = SEEN * np.array([0.06, LARGEST * 0.08, 0.08])
    assert np.allclose(own, seen[:2], rtol=1e-12)
    assert np.allclose(known, seen, rtol=1e-12)
    assert (odds > 0.0).all()


def test_the_networks_of_the_package_belong_together() -> None:
    require_trained_for(EmbeddedEncoder.open().fruit_identity)


def test_a_verifier_of_other_networks_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "verifier.safetensors"
    write_tensors(path, halved(Network().state_dict()), {"format": FORMAT, "encoder": "one+offsets"})
    require_trained_for("one+offsets", path)
    with pytest.raises(EncoderError, match=r"trained for one\+offsets, not for one\+others.*fit_verifier\.py"):
        require_trained_for("one+others", path)


def test_a_verifier_that_does_not_say_what_it_was_trained_for_is_refused(tmp_path: Path) -> None:
    tensors, header = read_tensors(STORED)
    del header["encoder"]
    write_tensors(tmp_path / "old.safetensors", tensors, header)
    with pytest.raises(EncoderError, match="Install the package again"):
        read_network(tmp_path / "old.safetensors")


@pytest.mark.parametrize("content", [b"", b"nothing", None])
def test_a_damaged_verifier_is_refused_with_a_sentence(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "verifier.safetensors"
    if content is None:
        write_tensors(path, {}, {"format": FORMAT, "encoder": "one"})
    else:
        path.write_bytes(content)
    with pytest.raises(EncoderError, match="Install the package again"):
        read_network(path)
