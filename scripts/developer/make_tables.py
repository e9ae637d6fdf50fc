"""Measure what README, docs/accuracy.md and benchmarks/RESULTS.md claim, and fill in the tables of the last two.

    python scripts/developer/make_tables.py                        # all that is stale or was not measured; many hours
    python scripts/developer/make_tables.py known-cameras phone    # only these studies
    python scripts/developer/make_tables.py --measure-nothing      # only say in the tables what is stale

Scenes are generated and counted one by one, each in a few minutes; after each one its rows are in
benchmarks/results.csv and in the documents, so an interrupted run goes on where it stopped, also on another computer.
Rows are measured again when the code that they depend on has changed.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401  puts the checkout on the path

from _terminal import import_tyro, report, run, terminal_progress
from fruitlangs.benchmarks.evidence.documents import write_documents
from fruitlangs.benchmarks.evidence.records import Record, Trial, merge_records, read_records, record_of, write_records
from fruitlangs.benchmarks.evidence.studies import STUDIES, training_of
from fruitlangs.benchmarks.ladder.ladder import StageResult, climb
from fruitlangs.benchmarks.ladder.stages import TRUE_POSES
from fruitlangs.benchmarks.orchards import scene_folder
from fruitlangs.benchmarks.two_photos import TWO_PHOTOS, count_in_two_photos
from fruitlangs.engine.config import PRESETS, Config
from fruitlangs.engine.errors import ConfigError, FruitLangsError

if TYPE_CHECKING:
    import tyro
else:
    tyro = import_tyro()

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Measure what the documents claim."""

    studies: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="STUDY")] = ()
    """Studies to measure; all if none is given."""
    out: Path = ROOT / "results" / "tables"
    """Folder of generated scenes and trained Gaussians."""
    measure_nothing: bool = False
    """Only say in the tables what is stale."""


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    unknown = set(arguments.studies) - set(STUDIES)
    if unknown:
        raise ConfigError(f"{sorted(unknown)[0]} is not a study. Choose from: {', '.join(STUDIES)}")
    records = read_records()
    write_documents(records)
    if arguments.measure_nothing:
        return
    failed = []
    for scene, trials in open_trials(arguments.studies or tuple(STUDIES), records).items():
        try:
            measured = measure(scene, trials, arguments.out)
        except FruitLangsError as error:
            failed.append(f"{scene}: {error}")
            report(failed[-1])
            continue
        records = merge_records(records, measured)
        write_records(records)
        write_documents(records)
    if failed:
        raise ConfigError(f"{len(failed)} scenes could not be measured. The first: {failed[0]}")


def open_trials(studies: Sequence[str], records: Sequence[Record]) -> dict[str, list[Trial]]:
    """{preset with a seed: its trials that were not measured by this code}, in the order of the studies."""
    done = {record.trial for record in records if not record.stale}
    trials: dict[str, list[Trial]] = {}
    for study in studies:
        for trial in STUDIES[study].trials:
            own = trials.setdefault(trial.scene, [])
            if trial not in done and trial not in own:
                own.append(trial)
    return {":".join(scene.rsplit("-", 1)): own for scene, own in trials.items() if own}


def measure(scene: str, trials: Sequence[Trial], out: Path) -> list[Record]:
    """Count a scene as the trials say; a stage that fails is a record with its reason."""
    folder = scene_folder(scene, out / "scenes", report=report)
    trained = replace(Config(), train=PRESETS[training_of(trials[0])])
    records = []
    for method in dict.fromkeys(trial.method for trial in trials):
        if method == TWO_PHOTOS:
            records.append(record_of(measure_two_photos(folder, out / folder.name, trained), method))
            continue
        count: Any = trained.count
        config = replace(trained, count=replace(count, method=method))
        stages = [trial.stage for trial in trials if trial.method == method]
        progress = terminal_progress()
        rows = climb(folder, out / folder.name, config=config, stages=stages, report=report, progress=progress)
        progress(1.0, "Done")
        records += [record_of(row, method) for row in rows]
    return records


def measure_two_photos(folder: Path, out: Path, config: Config) -> StageResult:
    """Count fruit in two photos of a scene whose result is in `out`, or is made there."""
    (row,) = climb(folder, out, config=config, stages=[TRUE_POSES])
    counted = None if row.failed else count_in_two_photos(out / TRUE_POSES, [row.species])
    return StageResult(
        species=row.species, seed=row.seed, scene=row.scene, stage=TRUE_POSES, counted=counted, failed=row.failed
    )


if __name__ == "__main__":
    run(main)
