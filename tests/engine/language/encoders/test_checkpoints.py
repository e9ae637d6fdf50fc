"""Checkpoints are opened from where they lie, safely, and each fault of one is reported in one line."""

from __future__ import annotations

import json
import shutil
import socket
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import huggingface_hub
import pytest
import torch
from checkpoints import write_clip, write_sam
from safetensors.torch import load_file, save_file

from fruitlangs.engine.errors import EncoderError
from fruitlangs.engine.language.encoders.checkpoints import CLIP, SAM, _move_to_device, open_checkpoint

ABSENT = "somebody/no-such-clip"


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clip") / "tiny")


@pytest.fixture
def copy(clip: Path, tmp_path: Path) -> Path:
    """A CLIP checkpoint to be damaged."""
    return Path(shutil.copytree(clip, tmp_path / "tiny"))


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty place for checkpoints, and a network that must not be used."""
    monkeypatch.setenv("FRUITLANGS_CHECKPOINTS", str(tmp_path / "own"))

    def refuse(*_: object) -> None:
        raise AssertionError("the network was asked")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    return tmp_path / "own"


def refusal(name: Path | str, kind=CLIP, *, allow_download: bool = False) -> str:
    """The one line of the error that opening ends with."""
    with pytest.raises(EncoderError) as caught:
        open_checkpoint(kind, str(name), allow_download=allow_download)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_an_identity_is_the_name_and_the_content(clip, copy, tmp_path):
    identity = open_checkpoint(CLIP, str(clip), allow_download=False).identity
    assert identity.startswith("tiny-")
    assert open_checkpoint(CLIP, str(copy), allow_download=False).identity == identity
    other = write_clip(tmp_path / "other" / "tiny", seed=1)
    assert open_checkpoint(CLIP, str(other), allow_download=False).identity != identity


def test_an_absent_checkpoint_is_an_error_that_says_what_to_put_where_and_asks_no_network(own_folder):
    said = refusal(ABSENT)
    for part in ("--allow-download", str(own_folder / ABSENT), f"https://huggingface.co/{ABSENT}", "model.safetensors"):
        assert part in said


def test_a_checkpoint_put_where_the_error_says_is_found_under_its_name(clip, own_folder):
    shutil.copytree(clip, own_folder / ABSENT)
    assert open_checkpoint(CLIP, ABSENT, allow_download=False).identity.startswith("no-such-clip-")


@pytest.mark.parametrize("name", ["/no/such/folder", "../elsewhere", "", "a/b/c", "~/nothing/here"])
def test_what_is_neither_a_folder_nor_a_name_is_an_error(name):
    assert "which is not a folder" in refusal(name)


def test_a_pickle_is_refused_and_the_reported_conversion_works(copy):
    torch.save(load_file(copy / "model.safetensors"), copy / "pytorch_model.bin")
    (copy / "model.safetensors").unlink()
    said = refusal(copy)
    assert "pytorch_model.bin are a pickle" in said
    code = said.split('-c "')[1].removesuffix('"')
    exec(compile(code, "conversion", "exec"), {})
    open_checkpoint(CLIP, str(copy), allow_download=False)


def test_a_checkpoint_of_another_type_is_an_error(clip, tmp_path):
    assert "of the type 'clip', not sam" in refusal(clip, SAM)
    assert "of the type 'sam', not clip or siglip" in refusal(write_sam(tmp_path / "sam"))


def test_weights_of_another_size_than_the_config_says_are_an_error(copy):
    config = json.loads((copy / "config.json").read_text())
    config["projection_dim"] = 20
    (copy / "config.json").write_text(json.dumps(config))
    assert "do not fit its config.json" in refusal(copy)


def test_weights_that_lack_a_tensor_are_an_error(copy):
    tensors = load_file(copy / "model.safetensors")
    del tensors["visual_projection.weight"]
    save_file(tensors, copy / "model.safetensors", metadata={"format": "pt"})
    assert "1 tensors are missing or of another size, first visual_projection.weight" in refusal(copy)


def test_a_corrupt_safetensors_file_is_an_error(copy):
    weights = (copy / "model.safetensors").read_bytes()
    (copy / "model.safetensors").write_bytes(weights[: len(weights) // 2])
    assert "cannot be opened" in refusal(copy)


@pytest.mark.parametrize("name", ["config.json", "preprocessor_config.json", "tokenizer.json", "model.safetensors"])
def test_a_missing_file_is_an_error_that_names_it(copy, name):
    (copy / name).unlink()
    said = refusal(copy)
    assert f"{copy} holds no" in said
    assert name in said


@pytest.mark.parametrize("name", ["config.json", "preprocessor_config.json", "tokenizer.json"])
def test_a_damaged_file_is_an_error(copy, name):
    (copy / name).write_text("{")
    refusal(copy)


def test_without_transformers_the_error_says_how_to_install_it(clip, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    assert "python -m pip install 'transformers>=5'" in refusal(clip)


class FakeHub:
    """A hub with one repository, whose revisions are folders here."""

    def __init__(self, **revisions: Path) -> None:
        self.revisions = revisions

    def snapshot_download(self, name, *, revision="main", local_dir=None, local_files_only=False, allow_patterns=None):
        if local_files_only:
            raise huggingface_hub.errors.LocalEntryNotFoundError("nothing is kept here")
        ignored = lambda _, names: [n for n in names if not any(Path(n).match(p) for p in allow_patterns)]  # noqa: E731
        shutil.copytree(self.revisions[revision.replace("/", "_")], local_dir, ignore=ignored)

    def list_repo_files(self, name):
        return [path.name for path in self.revisions["main"].iterdir()]

    def get_repo_discussions(self, name, author, discussion_type):
        numbers = [int(key.rsplit("_", 1)[1]) for key in self.revisions if key != "main"]
        return [SimpleNamespace(title="Adding `safetensors` variant of this model", num=number) for number in numbers]


def install(hub: FakeHub, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(huggingface_hub, "snapshot_download", hub.snapshot_download)
    monkeypatch.setattr(huggingface_hub, "HfApi", lambda: hub)


def test_a_checkpoint_is_downloaded_when_that_is_allowed_and_then_is_there(clip, own_folder, monkeypatch):
    install(FakeHub(main=clip), monkeypatch)
    assert "not on this computer" in refusal(ABSENT)
    first = open_checkpoint(CLIP, ABSENT, allow_download=True)
    assert sorted(path.name for path in own_folder.rglob("*clip*")) == ["no-such-clip"]
    assert open_checkpoint(CLIP, ABSENT, allow_download=False).identity == first.identity


def test_where_the_hub_has_a_pickle_the_converters_proposal_is_taken(clip, copy, own_folder, monkeypatch):
    (copy / "model.safetensors").rename(copy / "pytorch_model.bin")
    install(FakeHub(main=copy, refs_pr_7=clip), monkeypatch)
    open_checkpoint(CLIP, ABSENT, allow_download=True)
    assert not list(own_folder.rglob("*.bin"))


def test_a_hub_that_holds_only_a_pickle_is_an_error(copy, monkeypatch):
    (copy / "model.safetensors").rename(copy / "pytorch_model.bin")
    install(FakeHub(main=copy), monkeypatch)
    assert "it holds no safetensors, only a pickle" in refusal(ABSENT, allow_download=True)


def test_a_hub_that_cannot_be_reached_is_an_error(own_folder):
    said = refusal(ABSENT, allow_download=True)
    assert "cannot be downloaded" in said
    assert str(own_folder / ABSENT) in said


@pytest.mark.parametrize(("cuda", "mps", "place"), [(True, False, "cuda"), (False, True, "mps"), (False, False, None)])
def test_a_checkpoint_is_put_on_the_card_that_pytorch_has(
    cuda: bool, mps: bool, place: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: cuda)
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: mps)
    model = Mock()
    assert _move_to_device(model) is (model if place is None else model.half.return_value.to.return_value)
    if place is not None:
        model.half.return_value.to.assert_called_once_with(place)
