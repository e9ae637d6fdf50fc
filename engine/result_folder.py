"""A folder of results: one writer at a time, a set of files that is replaced as a whole, and the cache of stages."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import FruitLangsError, OutputError
from .report.results import FRUITS_JSON, parse_results
from .storage.files import file_hash, require_writable, write_text
from .storage.lock import hold_lock

CACHE, SOURCE = "cache", "cache/source.txt"
"""The folder of a result that stays on this computer, and the file in it that contains the path of the source: absolute
in its first line, and relative to the folder in its second if it is on the same drive."""
SPOOL = "spool"
"""The folder in the cache of pixels that a run has decoded."""
_STAGING, _OLD, _SWAP = "publish", "old", "swap.json"


@dataclass(frozen=True)
class ResultFolder:
    """The folder of one tree's results.

    Its set of files is `fruits.json` with the files that it lists. In `cache` are the outputs of stages, each in a
    folder named by a hash of everything it depends on.
    """

    path: Path

    @property
    def cache(self) -> Path:
        return self.path / CACHE

    def holds_result(self) -> bool:
        """Whether there is a finished result."""
        return (self.path / FRUITS_JSON).is_file()

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Be the only one who writes to the folder, which is made if it does not exist.

        Raises:
            OutputError: another run writes to it, or it cannot be written.
        """
        require_writable(self.cache)
        with hold_lock(self.cache, self.path):
            self._undo()
            # Killed runs left them: only the owner of the lock writes here.
            for left in (*self.cache.glob(f"{_STAGING}*"), self.cache / SPOOL):
                shutil.rmtree(left, ignore_errors=True)
            yield

    def read(self, *, verify: bool = True) -> dict[str, Any]:
        """The content of fruits.json; with `verify`, the other files are checked to belong to the same set.

        Raises:
            OutputError: there is no fruits.json, a file of the set is missing or belongs to another run, or the set is
                being replaced.
            FormatError: fruits.json is not of a schema this version reads, or lacks a field that a reader relies on.
        """
        if (self.cache / _SWAP).is_file():  # of a run that was killed, or that is about to end
            with hold_lock(self.cache, self.path):
                self._undo()
        path = self.path / FRUITS_JSON
        if not path.is_file():
            raise OutputError(
                f"{self.path} holds no {FRUITS_JSON}. It is not a result folder, or its run was never finished"
            )
        document = parse_results(path)
        for name, expected in document["files"].items() if verify else ():
            if not (self.path / name).is_file() or file_hash(self.path / name) != expected:
                raise OutputError(
                    f"{self.path / name} is missing or not of the same run as {FRUITS_JSON}. Count again into this "
                    "folder"
                )
        return document

    def list_files(self) -> Collection[str]:
        """List the names of the files of the set, without fruits.json; empty without a valid result."""
        with suppress(FruitLangsError):
            document = self.read(verify=False)
            return [*document["files"], *document.get("unhashed_files", ())]
        return ()

    def source(self, document: Mapping[str, Any]) -> Path:
        """The path of the source of the result: from the cache, else next to the folder.

        If it was moved together with the folder, its relative path leads to it. Results of version 0.1 contain its
        absolute path themselves.
        """
        stored = Path(document["provenance"]["source"])
        if stored.is_absolute():
            return stored
        try:
            absolute, *relative = (self.path / SOURCE).read_text(encoding="utf-8").splitlines()
        except (OSError, ValueError):  # missing, empty or not text
            return self.path.parent / stored
        moved = [path for path in (self.path / text for text in relative) if path.exists()]
        return moved[0].resolve() if moved and not Path(absolute).exists() else Path(absolute)

    def source_text(self, source: Path) -> str:
        """The content of the file that `source` reads."""
        with suppress(ValueError):  # another drive
            return f"{source.absolute()}\n{Path(os.path.relpath(source, self.path.resolve())).as_posix()}\n"
        return f"{source.absolute()}\n"

    @contextmanager
    def staging(self) -> Iterator[Path]:
        """An empty folder in which a new set is written before `replace`; only with the lock."""
        staging = self.cache / _STAGING
        staging.mkdir()
        try:
            yield staging
        finally:
            if not (self.cache / _SWAP).is_file():
                shutil.rmtree(staging, ignore_errors=True)

    def replace(self, staging: Path, names: Sequence[str], stale: Collection[str] = ()) -> None:
        """Move the files `names` from `staging` into place, in this order, and remove the `stale` ones.

        On an error, the earlier set is put back. If the process is killed in between, the next `read` or `lock`
        puts it back.

        Raises:
            OutputError: a file cannot be replaced; the earlier set is there.
        """
        old = staging / _OLD
        try:
            kept = [name for name in (*stale, *names) if (self.path / name).is_file()]
            for name in kept:
                _duplicate(self.path / name, old / name)
            added = [name for name in names if name not in kept]
            write_text(self.cache / _SWAP, json.dumps({"kept": kept, "added": added}))
        except OSError as error:
            raise self._make_error(error) from error
        try:
            for name in stale:
                (self.path / name).unlink(missing_ok=True)
            for name in names:
                (self.path / name).parent.mkdir(exist_ok=True)
                os.replace(staging / name, self.path / name)
            (self.cache / _SWAP).unlink()
        except OSError as error:
            with suppress(OutputError):  # otherwise the next reader tries again
                self._undo()
            raise self._make_error(error) from error

    def _make_error(self, error: OSError) -> OutputError:
        name = error.filename2 or error.filename or self.path
        return OutputError(
            f"{name} cannot be replaced ({error.strerror or error}), so the earlier result stays. Close other programs "
            "that have it open, free space, or choose another --out"
        )

    def _undo(self) -> None:
        """Put back the set that an unfinished `replace` had begun to replace; only with the lock."""
        record, old = self.cache / _SWAP, self.cache / _STAGING / _OLD
        if not record.is_file():
            return
        try:
            content = json.loads(record.read_text(encoding="utf-8"))
            for name in content["kept"]:
                if (old / name).is_file() and not _same(old / name, self.path / name):
                    os.replace(old / name, self.path / name)
            for name in content["added"]:
                (self.path / name).unlink(missing_ok=True)
            record.unlink()
        except OSError as error:
            raise OutputError(
                f"A run stopped while it replaced {self.path}, and {error.filename2 or error.filename} cannot be put "
                f"back ({error.strerror or error}). Close other programs that have it open, then try again"
            ) from error


def _duplicate(file: Path, copy: Path) -> None:
    """A second name for a file, or a copy where the file system has one name for each file."""
    copy.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(file, copy)
    except OSError:
        shutil.copy2(file, copy)


def _same(one: Path, other: Path) -> bool:
    """Whether two files are one, or have equal content; False if the second is missing."""
    return other.is_file() and (os.path.samefile(one, other) or file_hash(one) == file_hash(other))
