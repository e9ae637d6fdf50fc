"""The folder of a block: which trees it has, the state of each, and who works on which.

Workers of any number of drivers share it. A tree is worked on by the process that holds its lock, which the operating
system takes back when the process ends in any way; so a tree that is `running` without a holder was interrupted.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from filelock import FileLock, Timeout

from ..config import PRESETS
from ..errors import FormatError, OutputError
from ..result_folder import ResultFolder
from ..storage.files import require_writable, write_text
from .inputs import Check, Inputs, check_inputs
from .manifest import MANIFEST, STATES, TreeEntry, names_folder

Stage = Literal["waiting", "running", "done", "failed"]
TREES, LOCKS, LOG = "trees", "locks", "log"
"""Folders of a block, besides `STATES`."""
MOST_CRASHES = 3
"""Times that a worker may die with a tree before the tree is given up."""


@dataclass(frozen=True, kw_only=True)
class TreeState:
    """What became of a tree.

    fingerprint: of the entry that it is about; inputs: from which it was counted, if it is done; crashes: workers that
    died with it, without a word, one after another; run: of the driver that last worked on it; seconds: of the count;
    reason: of a failure, or why an earlier count is repeated.
    """

    stage: Stage = "waiting"
    fingerprint: str = ""
    inputs: Inputs = field(default_factory=Inputs)
    crashes: int = 0
    run: str = ""
    seconds: float = 0.0
    reason: str = ""

    @property
    def is_open(self) -> bool:
        """Whether the tree has to be counted, or a process does so. One that failed is tried again only after
        `Ledger.reopen`."""
        return self.stage in ("waiting", "running")


@dataclass(frozen=True)
class Ledger:
    """The folder of a block."""

    path: Path

    def result(self, tree: TreeEntry) -> ResultFolder:
        """Where a tree is counted."""
        return self.folder(tree.id)

    def folder(self, own: str) -> ResultFolder:
        """Where the tree with this id is counted."""
        return ResultFolder(self.path / TREES / own)

    def write_trees(self, trees: Sequence[TreeEntry]) -> None:
        """Note the trees of the block, in place of earlier ones, for its workers.

        Raises:
            OutputError: the folder cannot be written.
        """
        for name in (TREES, STATES, LOCKS, LOG):
            require_writable(self.path / name)
        document = [{**asdict(tree), "source": str(tree.source)} for tree in trees]
        write_text(self.path / MANIFEST, json.dumps(document, indent=1))

    def trees(self) -> list[TreeEntry]:
        """The trees that were noted.

        Raises:
            OutputError: the folder is not that of a block.
            FormatError: it is damaged, or another version wrote it.
        """
        try:
            document = json.loads((self.path / MANIFEST).read_text(encoding="utf-8"))
            return [_tree(entry) for entry in document]
        except OSError as error:
            raise OutputError(f"{self.path} holds no {MANIFEST}. It is not the folder of a block") from error
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise FormatError(
                f"{self.path / MANIFEST} is damaged or of another version ({error}). Count into another folder"
            ) from error

    def state(self, tree: TreeEntry) -> TreeState:
        """What became of a tree; waiting if it is new, was changed, or its result is gone."""
        try:
            stored = _state(json.loads(self._file(tree).read_text(encoding="utf-8")))
        except (AttributeError, OSError, TypeError, ValueError):
            return TreeState(fingerprint=tree.fingerprint)
        gone = stored.stage == "done" and not self.result(tree).holds_result()
        if stored.fingerprint != tree.fingerprint or gone:
            return TreeState(fingerprint=tree.fingerprint)
        return stored

    def states(self) -> dict[str, TreeState]:
        """{id: state} of all trees; a tree whose worker died is waiting."""
        found = {}
        for tree in self.trees():
            state = self.state(tree)
            if state.stage == "running":
                with self.claim(tree) as mine:
                    state = self.state(tree) if not mine else replace(state, stage="waiting")
            found[tree.id] = state
        return found

    def reopen(self) -> None:
        """Let trees wait again that failed until now, or whose inputs have changed since they were counted. Later
        failures stay: of two drivers at work, neither tries again what failed with the other.

        Raises:
            OutputError: the folder cannot be written.
        """
        for tree in self.trees():
            state = self.state(tree)
            check = self.check(tree, state)
            if state.stage != "failed" and not check.outdated:
                continue
            with self.claim(tree) as mine:
                if mine and self.state(tree) == state:
                    self.write(tree, TreeState(fingerprint=tree.fingerprint, reason=check.note))

    def check(self, tree: TreeEntry, state: TreeState) -> Check:
        """Whether the count of a tree that is done is of its present inputs; nothing to say of other trees."""
        return check_inputs(tree, state.inputs) if state.stage == "done" else Check()

    def write(self, tree: TreeEntry, state: TreeState) -> None:
        """Note what became of a tree; only with its lock.

        Raises:
            OutputError: the folder cannot be written.
        """
        write_text(self._file(tree), json.dumps(asdict(state)))

    @contextmanager
    def claim(self, tree: TreeEntry) -> Iterator[bool]:
        """Claim the tree until the block ends; yield whether it is this process's, because no other process works on
        it."""
        lock = FileLock(self.path / LOCKS / f"{tree.id}.lock", timeout=0)
        try:
            lock.acquire()
        except Timeout:
            yield False
            return
        except OSError as error:
            raise OutputError(f"{lock.lock_file} cannot be locked ({error.strerror or error})") from error
        try:
            yield True
        finally:
            lock.release()

    def _file(self, tree: TreeEntry) -> Path:
        return self.path / STATES / f"{tree.id}.json"


def _tree(entry: Mapping[str, Any]) -> TreeEntry:
    lists = {name: tuple(entry[name]) for name in ("prompt", "negative")}
    settings = {name: tuple(each) if isinstance(each, list) else each for name, each in entry["settings"].items()}
    tree = TreeEntry(**{**entry, **lists, "source": Path(entry["source"]), "settings": settings})
    if not names_folder(tree.id) or tree.preset not in PRESETS or not isinstance(tree.row, str):
        raise ValueError(f"the tree {tree.id!r}")
    if not all(isinstance(text, str) for text in (*tree.prompt, *tree.negative)):
        raise ValueError(f"the prompt of {tree.id}")
    for place in (tree.position, tree.latitude, tree.longitude):
        if place is not None and not math.isfinite(place):
            raise ValueError(f"the place of {tree.id}")
    return tree


def _state(stored: Mapping[str, Any]) -> TreeState:
    state = TreeState(**{**stored, "inputs": Inputs(**stored.get("inputs", {}))})
    texts, numbers = (
        (state.fingerprint, state.run, state.reason, *astuple(state.inputs)),
        (state.crashes, state.seconds),
    )
    if state.stage not in get_args(Stage) or not all(isinstance(text, str) for text in texts):
        raise ValueError(f"stage {state.stage!r}")
    if not all(isinstance(number, int | float) and math.isfinite(number) for number in numbers):
        raise ValueError(f"numbers {numbers!r}")
    return state


def run_name() -> str:
    """A name for a driver's run that no other one has."""
    return f"{os.getpid()}-{os.urandom(4).hex()}"
