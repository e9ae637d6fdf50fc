"""Writing files atomically, and hashing files that were read."""

from __future__ import annotations

import hashlib
import json
import os
import re
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import OutputError

if TYPE_CHECKING:
    from torch import Tensor


_DEVICES = re.compile(r"(con|prn|aux|nul|(com|lpt)[0-9¹²³]) *(\..*)?", re.IGNORECASE)


def names_device(name: str) -> bool:
    """Whether Windows keeps the name of a file or folder for a device, whatever its ending is."""
    return _DEVICES.fullmatch(name) is not None


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to `path` (same suffix) and move it into place if the block ends without an error.

    Raises:
        OutputError: the folder cannot be made or written.
    """
    # Processes in two containers that share a folder may have the same id.
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{path} cannot be written ({reason}). Choose another output folder") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    with replace_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_tensors(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write a safetensors file atomically; `about` goes into its header as JSON, under `fruitlangs`.

    Raises:
        OutputError: the file cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    with replace_file(path) as temporary:
        # save_file makes a file that only its owner may read; a result has the permissions of its other files.
        temporary.touch()
        mode = temporary.stat().st_mode
        try:
            save_file(dict(tensors), temporary, metadata={"fruitlangs": json.dumps(about, sort_keys=True)})
        except SafetensorError as error:  # its name for a full disk
            raise OSError(str(error)) from error
        temporary.chmod(mode)


def halve_precision(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors of a network as weights are stored: numbers with a point in half precision."""
    return {
        name: (tensor.half() if tensor.is_floating_point() else tensor).contiguous() for name, tensor in tensors.items()
    }


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors of a file from `write_tensors`, in memory, and what its header says about them.

    They are copies of the mapped file: as long as a file is mapped, Windows does not replace it.

    Raises:
        ValueError: the file is missing, damaged, or of another program.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {})["fruitlangs"])
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, OSError, KeyError, TypeError) as error:
        raise ValueError(str(error).partition("\n")[0]) from error
    if not isinstance(about, dict):
        raise ValueError("its header is of another program")
    return tensors, about


def require_writable(folder: Path) -> None:
    """Make `folder` and check that files can be written to it, before a long run.

    Raises:
        OutputError: it cannot.
    """
    probe = folder / f".writable.{uuid.uuid4().hex[:8]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise OutputError(
            f"The output folder {folder} cannot be written ({error.strerror or error}). Choose another with --out"
        ) from error


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_hash(paths: Iterable[Path], root: Path, hash_of: Callable[[Path], str] = file_hash) -> str:
    """SHA-256 over the names relative to `root` and the hashes of files, in the order given."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(f"{_relative(path, root)}\0{hash_of(path)}\n".encode())
    return digest.hexdigest()


def _relative(path: Path, root: Path) -> str:
    try:
        return Path(os.path.relpath(path, root)).as_posix()
    except ValueError:  # on another drive
        return path.as_posix()


def text_hash(*parts: str) -> str:
    """SHA-256 of texts, in hexadecimal."""
    digest = hashlib.sha256()
    for text in parts:
        digest.update(text.encode())
        digest.update(b"\0")
    return digest.hexdigest()
