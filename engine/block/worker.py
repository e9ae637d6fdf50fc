"""A worker: counts trees of a block, one after another, until no tree is left for it."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from dataclasses import replace

from ..errors import Cancelled, FruitLangsError
from ..pipeline import count_scene
from ..progress import silent
from ..storage.files import write_text
from .inputs import read_inputs
from .ledger import LOG, MOST_CRASHES, Ledger, TreeState
from .manifest import TreeEntry

Count = Callable[[TreeEntry, Ledger], None]


def count_tree(tree: TreeEntry, ledger: Ledger) -> None:
    """Count a tree into its folder of the block.

    Raises:
        FruitLangsError: it cannot be counted.
    """
    count_scene(
        tree.source,
        tree.prompt,
        ledger.result(tree).path,
        negatives=tree.negative,
        config=tree.config,
        given=set(tree.settings),
        progress=silent,
    )


def work(ledger: Ledger, run: str, *, count: Count = count_tree) -> int:
    """Count the trees that are open (`TreeState.is_open`) and that no other process works on; returns how many.

    Raises:
        OutputError: the folder of the block cannot be written.
        Cancelled: the user asked for it.
    """
    counted = 0
    for tree in ledger.trees():
        with ledger.claim(tree) as mine:
            if mine and ledger.state(tree).is_open:
                counted += _attempt(ledger, tree, run, count)
    return counted


def _attempt(ledger: Ledger, tree: TreeEntry, run: str, count: Count) -> bool:
    """Count one tree, whose lock is held; whether it is done now. Any error is a failure of the tree: it would come
    again. Only a tree with which the worker died is tried again."""
    before = ledger.state(tree)
    crashes = before.crashes + 1 if before.stage == "running" else 0
    state = TreeState(stage="running", fingerprint=tree.fingerprint, crashes=crashes, run=run, reason=before.reason)
    if crashes >= MOST_CRASHES:
        reason = f"{crashes} workers died with it without a word, perhaps for want of memory: use fewer --jobs"
        ledger.write(tree, replace(state, stage="failed", crashes=0, reason=reason))
        return False
    ledger.write(tree, state)
    begun = time.monotonic()
    try:
        inputs = read_inputs(tree)  # before the count, so that a photo that is added during it is counted the next time
        count(tree, ledger)
    except FruitLangsError as error:
        reason = " ".join(str(error).split())
        ledger.write(tree, replace(state, stage="failed", crashes=0, reason=reason))
        return False
    except (Cancelled, KeyboardInterrupt):
        ledger.write(tree, replace(state, stage="waiting", crashes=0))
        raise
    except Exception as error:
        log = ledger.path / LOG / f"{tree.id}_error.txt"
        write_text(log, traceback.format_exc())
        reason = f"{type(error).__name__}: {' '.join(str(error).split()) or 'without a message'}. See {log}"
        ledger.write(tree, replace(state, stage="failed", crashes=0, reason=reason))
        return False
    seconds = round(time.monotonic() - begun, 1)
    ledger.write(tree, replace(state, stage="done", inputs=inputs, crashes=0, seconds=seconds, reason=""))
    return True
