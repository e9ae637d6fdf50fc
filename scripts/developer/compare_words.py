"""Teach words by a fixed rule of clicks in generated scenes, and count with them there and in others of the species.

    python scripts/developer/compare_words.py apple-small:102 apple-small:103 fig-small:201 --out results/words

Each scene is counted with its built-in word ("fruit" if it has none). Then its fruit is taught under a new name, with
as many positive and negative clicks as --clicks says, and every scene of the species is counted with that word. With
--correct, built-in words are taught instead that their most probable false fruit are none, one by one. With --photos,
words are taught by the boxes of ten photos of each set, and pixels of its validation photos are ranked. Prints tables
in Markdown; OUT gets words.csv, and a second run goes on.

To measure how well a fruit is learnt that the encoder never saw, train an encoder without it (`train_encoder.py`,
`fit_offsets.py`) and put its weights into engine/language/encoders/weights.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401  puts the checkout on the path

from _terminal import import_tyro, report, run, terminal_progress
from fruitlangs.benchmarks.markdown import markdown
from fruitlangs.benchmarks.orchards import read_origin, scene_folder
from fruitlangs.benchmarks.teaching import (
    Tree,
    WordTrial,
    correct,
    corrections_table,
    read_words_csv,
    try_words,
    words_csv,
    words_table,
)
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.storage.files import require_writable, write_text
from fruitlangs.fitting.encoder.pictures import read_photos
from fruitlangs.fitting.taught_photos import TaughtScore, score_taught

tyro = import_tyro()


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to teach, and where."""

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = ()
    """Folders of generated scenes, or presets with seeds such as apple-small:101."""
    out: Path
    """Folder of tables, words and results; that of evaluate.py reuses its training."""
    clicks: tuple[str, ...] = ("1", "3", "5", "10", "5+5")
    """Numbers of positive clicks, or of positive and negative ones."""
    correct: bool = False
    """Correct built-in words instead."""
    photos: Path | None = None
    """Folder of photo sets with annotations.csv, as of train_encoder.py."""


def main(options: Options) -> None:
    lessons = [read_clicks(text) for text in options.clicks]
    require_writable(options.out)
    if not (options.scenes or options.photos):
        raise ConfigError("Nothing is given to teach in. Name scenes, or --photos")
    if options.photos is not None:
        sets = (read_photos(options.photos, split) for split in ("train", "val"))
        print(photos_table(score_taught(EmbeddedEncoder.open(), *sets)))
    if options.scenes:
        teach_scenes(options, lessons)


def teach_scenes(options: Options, lessons: Sequence[tuple[int, int]]) -> None:
    folders = [scene_folder(name, options.out / "scenes", report=report).resolve() for name in options.scenes]
    progress = terminal_progress()
    if options.correct:
        words = options.out / "words"
        found = [correct(Tree.grow(folder, options.out / folder.name, progress), words) for folder in folders]
        print(corrections_table([each for own in found for each in own]))
        return
    file = options.out / "words.csv"
    kept = {trial.place: trial for trial in read_words_csv(file)}
    for species in dict.fromkeys(read_origin(folder).species for folder in folders):
        own = [folder for folder in folders if read_origin(folder).species == species]
        trees = [Tree.grow(folder, options.out / folder.name, progress) for folder in own]
        for trial in try_words(trees, lessons, options.out / "words", [*kept.values()]):
            report(line_of(trial))
            kept[trial.place] = trial
            write_text(file, words_csv([*kept.values()]))
    named = {folder.name for folder in folders}
    print(words_table([trial for trial in kept.values() if trial.scene in named]))


def photos_table(scores: Mapping[str, TaughtScore]) -> str:
    """Markdown: one line per set of photos."""
    lines = [["photos of", "taught on", "average precision", "of the built-in word"]]
    for source, score in scores.items():
        shown = f"{score.boxes} boxes in {score.photos} photos"
        lines.append([source, shown, f"{score.taught:.3f}", f"{score.built_in:.3f}"])
    return markdown(lines)


def line_of(trial: WordTrial) -> str:
    """For people who wait."""
    return (
        f"{trial.scene} with the word of {trial.taught}, {trial.positive} + {trial.negative} clicks: "
        f"F1 {trial.metrics.f1:.3f}, learnt in {trial.seconds:.2f} s"
    )


def read_clicks(text: str) -> tuple[int, int]:
    """ "5+5" → (5, 5), "3" → (3, 0).

    Raises:
        ConfigError: it is spelled otherwise, or has no positive click.
    """
    positive, _, negative = text.partition("+")
    if not (positive.isdecimal() and (negative or "0").isdecimal()) or int(positive) < 1:
        raise ConfigError(f"--clicks {text}: give a number of positive clicks, such as 5, or with negative ones, 5+5")
    return int(positive), int(negative or "0")


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
