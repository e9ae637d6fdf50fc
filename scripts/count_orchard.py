"""Count the trees of a block: one command for a manifest, or for a folder with a folder of photos for each tree.

    python scripts/count_orchard.py orchard.csv --out results/block
    python scripts/count_orchard.py photos --prompt apple --out results/block

Run it again to go on after an interruption, to try failed trees again, or after the manifest or photos have changed: a
tree whose inputs are the same stays. Exit code 0: every tree is counted; 1: some are not, with a line for each; 2:
usage; 130: cancelled.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

sys.path.insert(0, str(Path(__file__).resolve().parent))

import _checkout  # noqa: F401

from _help import parse_arguments
from _terminal import arguments_of, import_tyro, run, say
from fruitlangs.engine.errors import ConfigError, CountingError, FruitLangsError
from fruitlangs.engine.progress import duration

if TYPE_CHECKING:
    import tyro

    from fruitlangs.engine.block.ledger import Ledger, TreeState
    from fruitlangs.engine.block.manifest import TreeEntry
    from fruitlangs.engine.config import EmbedConfig
    from fruitlangs.engine.language.encoders.encoder import Encoder
else:
    tyro = import_tyro()

EXAMPLE = "orchard.csv --out results/block"
NAMED = 5
"""Trees that a line names of those that it is about."""
MINUTE = 60
"""Seconds to which the time of a tree is rounded."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Count many trees, by several workers, and sum up the block."""

    manifest: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MANIFEST")]
    """A .csv or .toml with a line for each tree, or a folder with a folder of photos for each tree."""
    out: Path
    """Folder of the block: a result for each tree, and the tables."""
    prompt: tuple[str, ...] = ()
    """What to count on trees for which the manifest does not say it."""
    settings: str = ""
    """Settings of all trees, as in the manifest: "train.steps=400 | count.threshold=0.4"."""
    jobs: int | None = None
    """Trees that are counted at a time; if not given, as many as cores and memory allow."""
    executor: Literal["local", "slurm"] = "local"
    """Where the workers run: on this computer, or on a cluster with Slurm."""
    partition: str = ""
    """Slurm's partition."""
    minutes: int = 60 * 24 * 7
    """Longest time of a worker."""
    cores: int = 4
    """Cores of a worker that Slurm reserves."""
    gigabytes: float = 0.0
    """Memory of a worker that Slurm reserves."""
    gpus: int = 0
    """Graphics cards of a worker that Slurm reserves."""
    all_trees: int | None = None
    """Number of all trees of the block, if those of the manifest are a random sample of them."""
    density: float | None = None
    """Kilograms per cubic metre of the fruit, for weights; needs the scale of every tree."""
    dry_run: bool = False
    """Only say what would be counted, and how long that takes."""


def main() -> None:
    arguments = parse()
    from fruitlangs.engine.block.driver import Workers, drive, python_command
    from fruitlangs.engine.block.ledger import Ledger
    from fruitlangs.engine.block.manifest import read_manifest
    from fruitlangs.engine.block.publish import publish_block
    from fruitlangs.engine.block.totals import require_sample
    from fruitlangs.engine.compiled.jit import is_all_compiled
    from fruitlangs.engine.memory import available_bytes

    trees = read_manifest(arguments.manifest, prompt=arguments.prompt, settings=arguments.settings)
    if arguments.all_trees is not None:
        require_sample(sum(tree.trees for tree in trees), arguments.all_trees)
    ledger = Ledger(arguments.out)
    if arguments.dry_run:
        plan(trees, ledger)
        return
    ledger.write_trees(trees)
    workers = Workers(
        executor=arguments.executor,
        jobs=arguments.jobs,
        partition=arguments.partition,
        minutes=arguments.minutes,
        cores=arguments.cores,
        gigabytes=arguments.gigabytes,
        gpus=arguments.gpus,
    )
    ledger.reopen()
    say_before(ledger.states())

    if arguments.executor == "local" and not is_all_compiled():
        from fruitlangs.engine.compile_ahead import compile_once

        say("compiling for this computer (first run only, about a minute)")
        compile_once()
    command = python_command(Path(__file__).resolve())

    def report_change(own: str, state: TreeState) -> None:
        say(f"{own}: {state_text(state, ledger.folder(own).path)}")

    drive(ledger, trees, workers, command, free=available_bytes(), changed=report_change)
    answer = publish_block(ledger, all_trees=arguments.all_trees, density=arguments.density)
    say(block_text(answer.document))
    say("\n".join(["", "written:", *(f"  {path}" for path in answer.files)]))
    failed = len(answer.document["failed"])
    if failed:
        every = answer.document["trees"]
        raise CountingError(f"{failed} of {every} trees failed and are not in the sums. See {answer.files[0]}")


def say_before(states: Mapping[str, TreeState]) -> None:
    """Say how many trees are done, and which are counted again for which reason."""
    done = sum(state.stage == "done" for state in states.values())
    if done:
        say(f"{done} of {len(states)} trees are done")
    by_reason: dict[str, list[str]] = {}
    for own, state in states.items():
        if state.stage == "waiting" and state.reason:
            by_reason.setdefault(state.reason, []).append(own)
    for reason, trees in by_reason.items():
        say(f"{describe_counted(len(trees))} counted again ({join_names(trees)}): {reason}")


def describe_counted(count: int) -> str:
    return "1 tree is" if count == 1 else f"{count} trees are"


def join_names(names: Sequence[str]) -> str:
    """Join names as a list, of which the first are given."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def state_text(state: TreeState, folder: Path) -> str:
    """A tree that starts, is done or failed in words. folder: of its result."""
    from fruitlangs.engine.block.trees import fruit_text

    if state.stage == "running":
        return "started"
    return f"{fruit_text(folder)} in {state.seconds:.0f} s" if state.stage == "done" else state.reason


def block_text(document: dict[str, Any]) -> str:
    """The sums of a block (`tables.summary`) in words."""
    if not document["done"]:
        return "block: no tree was counted"
    block, prompts, where = document["block"], document.get("prompts"), f"on {document['done']} of {document['trees']}"
    if prompts:
        counts = ", ".join(f"{sums['count']} {prompt}" for prompt, sums in prompts.items())
        lines = [f"block: visible fruit counted {where} trees: {counts}"]
        for prompt, sums in prompts.items():
            lines += [_sums_text(prompt, sums), *(f"  {line}" for line in _parts(sums))]
    else:
        lines = [
            f"block: {block['count']} visible fruit counted {where} trees, {_interval_text(block, '90 % interval ')}"
        ]
        lines += _parts(document)
    if document["elsewhere"]:
        lines.append(f"  {document['elsewhere']} counted fruit belong to no tree of their row and are not in the sums")
    notes = list(document["notes"].items())
    lines += [f"  note on {own}: {note}" for own, note in notes[:NAMED]]
    if len(notes) > NAMED:
        lines.append(f"  notes on {len(notes) - NAMED} more are in the tables")
    return "\n".join(lines)


def _parts(numbers: dict[str, Any]) -> list[str]:
    """The sums of rows, and the estimate for all trees, a line each."""
    lines = [_sums_text(f"row {name}", sums) for name, sums in numbers["rows"].items()]
    every = numbers.get("all_trees")
    if every and "no_estimate" in every:
        lines.append(f"  no estimate for all {every['trees']} trees: {every['no_estimate']}")
    elif every:
        lines.append(f"  all {every['trees']} trees: {every['likely']:.0f} ({every['low']:.0f}–{every['high']:.0f})")
    return lines


def _sums_text(name: str, sums: dict[str, Any]) -> str:
    trees = "1 tree" if sums["trees"] == 1 else f"{sums['trees']} trees"
    return f"  {name}: {sums['count']} on {trees}, {_interval_text(sums)}"


def _interval_text(sums: dict[str, Any], name: str = "") -> str:
    """'most likely 33 (29–40)', or why a sum has no interval. name: of the interval."""
    if sums["likely"] is None:
        return f"without an interval, because {sums['without_interval']} of {sums['trees']} have none"
    return f"most likely {sums['likely']:.0f} ({name}{sums['low']:.0f}–{sums['high']:.0f})"


def plan(trees: list[TreeEntry], ledger: Ledger) -> None:
    """Say what would be counted, with the time that it takes on this computer.

    Raises:
        CountingError: some trees cannot be counted.
    """
    wrong, total = 0, 0.0
    for tree in trees:
        state = ledger.state(tree)
        check = ledger.check(tree, state)
        if state.stage == "done" and not check.outdated:
            say(f"{tree.id}: done" + (f", but {check.note}" if check.note else ""))
            continue
        try:
            text, seconds = estimate_tree(tree)
            text += f" (again: {check.note})" if check.outdated else ""
        except FruitLangsError as error:
            text, seconds = str(error), 0.0
            wrong += 1
        say(f"{tree.id}: {text}")
        total += seconds
    if total:
        say(f"in all about {duration(total, MINUTE)} with all cores for one tree at a time")
    if wrong:
        raise CountingError(f"{wrong} of {len(trees)} trees cannot be counted. The reasons are above")


def estimate_tree(tree: TreeEntry) -> tuple[str, float]:
    """Estimate what counting a tree takes, in words, and its seconds; 0 if they cannot be estimated.

    Raises:
        FruitLangsError: the tree cannot be counted, because of its words or its source.
    """
    from fruitlangs.engine.language.prompts.relevancy import check_prompts
    from fruitlangs.engine.photo_check.cost import estimate_costs
    from fruitlangs.engine.photo_check.photo_files import list_photo_files
    from fruitlangs.engine.result_folder import ResultFolder
    from fruitlangs.engine.scene.photos.photo import read_header
    from fruitlangs.engine.scene.source import Source

    check_prompts(encoder_of(tree.config.embed), tree.prompt, tree.negative)
    source = Source(path=tree.source)
    gaussians = tree.source.suffix.lower() == ".ply" and tree.source.is_file()
    other = gaussians or ResultFolder(tree.source).holds_result() or source.video() is not None
    files = None if other else list_photo_files(source)
    if files is None or not files.photos:
        return "it has no photo from which its time can be estimated", 0.0
    headers = [read_header(photo) for photo in files.photos]
    sizes = [(header.width, header.height) for header in headers]
    costs = estimate_costs(sizes, tree.config, posed=files.posed)
    seconds, most = sum(cost.seconds for cost in costs), max(cost.bytes for cost in costs)
    return f"{len(files.photos)} photos, about {duration(seconds, MINUTE)} and {most / 2**30:.1f} GB", seconds


@cache
def encoder_of(config: EmbedConfig) -> Encoder:
    """The encoder that the settings name, opened once for all trees.

    Raises:
        ConfigError, EncoderError: there is no such encoder, or its weights cannot be used.
    """
    from fruitlangs.engine.language.features.embedder import Embedder

    return Embedder.open(config).encoder


def run_worker(given: list[str]) -> None:
    """Run what `--worker` starts: a process that counts trees of a block. given: its folder, the name of the run, and
    the executor."""
    from fruitlangs.engine.block.ledger import Ledger
    from fruitlangs.engine.block.worker import work
    from fruitlangs.engine.child_process import end_with_parent

    if len(given) != 3:
        raise ConfigError("--worker is for count_orchard.py itself")
    if given[2] == "local":
        end_with_parent()
    work(Ledger(Path(given[0])), given[1])


def parse() -> Arguments:
    """The arguments, or exit 2 with a usage message."""
    needed: Any = tyro.MISSING
    arguments: Arguments = parse_arguments(
        Arguments, Arguments(manifest=needed, out=needed), arguments_of(__file__), __file__, EXAMPLE
    )
    return arguments


if __name__ == "__main__":
    own = arguments_of(__file__)
    run((lambda: run_worker(own[1:])) if own[:1] == ["--worker"] else main)
