"""Pretrained models of `transformers`, opened from a folder or, with consent, from the Hugging Face hub.

Only safetensors are read, because a pickle can run any code. Without consent nothing is requested from the network.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import EncoderError
from ...storage.files import files_hash
from ...user_folders import checkpoints_folder

_INSTALL = "python -m pip install 'transformers>=5'"
_WEIGHTS = ("model.safetensors", "model.safetensors.index.json")
_PICKLES = (".bin", ".pt", ".pth", ".ckpt", ".pkl")
_PICTURES = ("preprocessor_config.json", "processor_config.json")
_WORDS = ("tokenizer.json", "vocab.json", "spiece.model")
_HUB_FILES = ("*.json", "merges.txt", "spiece.model", "model.safetensors", "model-*-of-*.safetensors")
_CONVERTED = "Adding `safetensors` variant of this model"
"""Title of the pull request of Hugging Face's own converter for a repository that has only a pickle."""


@dataclass(frozen=True)
class Kind:
    """The requirements for a checkpoint.

    name: for messages; flag: the setting that names it; types: `model_type` of its config.json; speaks: whether it
    reads words, so that it needs a tokenizer.
    """

    name: str
    flag: str
    types: tuple[str, ...]
    speaks: bool

    @property
    def files(self) -> str:
        """The files that its folder must contain, for messages."""
        words = ", tokenizer_config.json and tokenizer.json (or vocab.json with merges.txt)"
        pictures = "config.json, model.safetensors and preprocessor_config.json"
        return pictures.replace(" and ", ", ") + words if self.speaks else pictures


CLIP = Kind("CLIP or SigLIP", "--embed.clip", ("clip", "siglip"), speaks=True)
SAM = Kind("SAM", "--embed.sam", ("sam",), speaks=False)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """An opened model, on the GPU in half precision if there is one.

    model: the transformers model, in evaluation mode; pictures: its image processor; words: its tokenizer, None without
    one; identity: name and a hash of the contents of its files.
    """

    model: Any
    pictures: Any
    words: Any
    identity: str


def open_checkpoint(kind: Kind, name: str, *, allow_download: bool) -> Checkpoint:
    """Open a checkpoint by local folder or name on the hub.

    Raises:
        EncoderError: it is not on this computer and may not be downloaded, is of another kind, holds a pickle, lacks
            files or is damaged; or transformers is not installed.
    """
    try:
        import transformers
    except ImportError as error:
        raise EncoderError(f"{kind.name} needs the package transformers ({error}). Run: {_INSTALL}") from error
    folder = _find_folder(kind, name, allow_download)
    used = _check_files(kind, folder)
    with _silence(transformers), _explain_damage(kind, folder):
        model, report = transformers.AutoModel.from_pretrained(
            folder,
            local_files_only=True,
            trust_remote_code=False,
            use_safetensors=True,
            output_loading_info=True,
            ignore_mismatched_sizes=True,  # they are in the report, which is checked below
            dtype="float32",
        )
        pictures = transformers.AutoImageProcessor.from_pretrained(folder, local_files_only=True, backend="pil")
        words = transformers.AutoTokenizer.from_pretrained(folder, local_files_only=True) if kind.speaks else None
    absent = sorted(map(str, [*report["missing_keys"], *report["mismatched_keys"]]))
    if absent:
        raise EncoderError(
            f"The weights in {folder} do not fit its config.json ({len(absent)} tensors are missing or of another size,"
            f" first {absent[0]}). Get both from the same place"
        )
    identity = f"{Path(name).name}-{files_hash(used, folder)[:16]}"
    return Checkpoint(_move_to_device(model.eval()), pictures, words, identity)


def _find_folder(kind: Kind, name: str, allow_download: bool) -> Path:
    """Find the folder of a checkpoint: as given, in the checkpoints folder, or in the cache of the hub."""
    given = Path(name).expanduser()
    if name.strip() and given.is_dir():
        return given
    if not re.fullmatch(r"[\w-][\w.-]*(/[\w-][\w.-]*)?", name):
        raise EncoderError(
            f"{kind.flag} is '{name}', which is not a folder. Give a folder with {kind.files}, or a name on the "
            "Hugging Face hub"
        )
    own = checkpoints_folder() / name
    if own.is_dir():
        return own
    cached = _in_hub_cache(name)
    if cached is not None:
        return cached
    if not allow_download:
        raise EncoderError(
            f"The {kind.name} checkpoint '{name}' is not on this computer. Allow its download with --allow-download "
            f"(in Blender with Allow Download and online access), or put {kind.files} from "
            f"https://huggingface.co/{name} into {own}, or name another folder with {kind.flag}"
        )
    _download(kind, name, own)
    return own


def _in_hub_cache(name: str) -> Path | None:
    """The folder of a checkpoint in the cache of huggingface_hub; None if it has none."""
    import huggingface_hub
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError

    try:
        folder = Path(huggingface_hub.snapshot_download(name, local_files_only=True))
    except (OSError, ValueError, HfHubHTTPError, LocalEntryNotFoundError):
        return None
    return folder if any((folder / weights).is_file() for weights in _WEIGHTS) else None


def _download(kind: Kind, name: str, own: Path) -> None:
    """Download a checkpoint from the hub to `own`; continues an interrupted download."""
    import huggingface_hub

    arriving = own.with_name(f"{own.name}.part")
    try:
        huggingface_hub.snapshot_download(
            name, revision=_find_safe_revision(name), local_dir=arriving, allow_patterns=list(_HUB_FILES)
        )
        os.replace(arriving, own)
    except Exception as error:  # of the hub, of its network library, or of the disk
        raise EncoderError(
            f"The {kind.name} checkpoint '{name}' cannot be downloaded ({_first_line(error)}). Try again, or put "
            f"{kind.files} from https://huggingface.co/{name} into {own}"
        ) from error


def _find_safe_revision(name: str) -> str:
    """Find the revision of a repository that has safetensors: the main one, or that of the converter."""
    import huggingface_hub

    hub = huggingface_hub.HfApi()
    if set(_WEIGHTS) & set(hub.list_repo_files(name)):
        return "main"
    for proposal in hub.get_repo_discussions(name, author="SFconvertbot", discussion_type="pull_request"):
        if proposal.title == _CONVERTED:
            return f"refs/pr/{proposal.num}"
    raise ValueError("it holds no safetensors, only a pickle, which is not opened")


def _check_files(kind: Kind, folder: Path) -> list[Path]:
    """Check the kind and the files of a checkpoint and return the files, sorted."""
    try:
        model_type = json.loads((folder / "config.json").read_text(encoding="utf-8"))["model_type"]
    except FileNotFoundError as error:
        raise EncoderError(f"{folder} holds no config.json. Put {kind.files} there") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EncoderError(f"{folder / 'config.json'} cannot be read ({_first_line(error)}). Get it again") from error
    if model_type not in kind.types:
        raise EncoderError(
            f"The checkpoint in {folder} is of the type '{model_type}', not {' or '.join(kind.types)}. Give a "
            f"{kind.name} checkpoint with {kind.flag}"
        )
    present = {path.name for path in folder.iterdir() if path.is_file()}
    if not present & set(_WEIGHTS):
        pickles = sorted(name for name in present if name.endswith(_PICKLES))
        if pickles:
            raise EncoderError(
                f"The weights {folder / pickles[0]} are a pickle, which can run any program when opened. If you trust "
                f"it, convert it once: {_conversion(folder)}"
            )
        raise EncoderError(f"{folder} holds no model.safetensors. Put {kind.files} there")
    if not present & set(_PICTURES):
        raise EncoderError(f"{folder} holds no preprocessor_config.json. Put {kind.files} there")
    if kind.speaks and not present & set(_WORDS):
        raise EncoderError(f"{folder} holds no tokenizer (tokenizer.json). Put {kind.files} there")
    kinds = (".json", ".txt", ".model", ".safetensors")
    return sorted(folder / name for name in present if name.endswith(kinds))


def _conversion(folder: Path) -> str:
    """A command that writes the tensors of a pickle as safetensors next to it."""
    code = f"from transformers import AutoModel as M; M.from_pretrained(r'{folder}').save_pretrained(r'{folder}')"
    return f'python -c "{code}"'


def _move_to_device(model: Any) -> Any:
    """Move a model to an NVIDIA or Apple card, in half precision, if PyTorch has one; else leave it on the CPU."""
    import torch

    if torch.cuda.is_available():
        return model.half().to("cuda")
    return model.half().to("mps") if torch.backends.mps.is_available() else model


@contextmanager
def explain_misfit(kind: Kind, name: str) -> Iterator[None]:
    """Turn errors of a model's first use into an EncoderError: its files belong to different models."""
    try:
        yield
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise EncoderError(
            f"The files of the {kind.name} checkpoint {name} do not fit each other ({_first_line(error)}). Get all of "
            "them from one place"
        ) from error


@contextmanager
def _explain_damage(kind: Kind, folder: Path) -> Iterator[None]:
    """Turn any error of transformers about a damaged checkpoint into an EncoderError of one line."""
    try:
        yield
    except ImportError as error:
        raise EncoderError(
            f"The checkpoint in {folder} needs a package that is missing ({_first_line(error)}). Run: python -m pip "
            "install sentencepiece protobuf"
        ) from error
    except Exception as error:  # safetensors, tokenizers, hub and torch have their own errors, without a common base
        raise EncoderError(
            f"The {kind.name} checkpoint in {folder} cannot be opened ({_first_line(error)}). Get its files again: "
            f"{kind.files}"
        ) from error


@contextmanager
def _silence(transformers: Any) -> Iterator[None]:
    """Silence the progress bars and warnings of transformers: relevant ones become errors of ours."""
    log = transformers.utils.logging
    verbosity, bars = log.get_verbosity(), log.is_progress_bar_enabled()
    log.set_verbosity(log.CRITICAL)
    log.disable_progress_bar()
    try:
        yield
    finally:
        log.set_verbosity(verbosity)
        if bars:
            log.enable_progress_bar()


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
