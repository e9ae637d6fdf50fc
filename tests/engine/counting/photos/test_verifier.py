"""The network that verifies fruit belongs to the networks whose maps it was trained on."""

from __future__ import annotations

from pathlib import Path

import pytest

from fruitlangs.engine.counting.photos.verifier import FORMAT, STORED, Network, read_network, require_trained_for
from fruitlangs.engine.errors import EncoderError
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.storage.files import halved, read_tensors, write_tensors


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
