"""Teach a word for a fruit that the encoder does not know, or correct one that it knows.

    python scripts/teach_word.py RESULT --word fig --positive IMG_12.jpg:1034,887 --negative IMG_12.jpg:400,300
    python scripts/count_fruit.py RESULT --prompt fig --out results/figs

RESULT is the folder of an earlier count; its Gaussians are learnt from. The word goes into the user's folder of words,
which every count reads.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import _checkout  # noqa: F401

from _help import parse_arguments
from _terminal import arguments_of, import_tyro, run
from fruitlangs.engine.errors import ConfigError, VocabularyError

if TYPE_CHECKING:
    import tyro

    from fruitlangs.engine.language.teaching.lesson import Mark
    from fruitlangs.engine.language.teaching.region import Ground
    from fruitlangs.engine.publishing import Result
else:
    tyro = import_tyro()

EXAMPLE = "results/tree7 --word fig --positive IMG_12.jpg:1034,887"


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Teach a word from examples in the photos of an earlier result."""

    result: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")]
    """Folder of an earlier result, with its photos still available."""
    word: str
    """Name of the fruit, without colour or ripeness, for example fig or "cherry tomato"."""
    positive: tuple[str, ...] = ()
    """Places that show it: PHOTO:X,Y in pixels of the photo."""
    negative: tuple[str, ...] = ()
    """Places that show something else that the word matches."""
    fruit: tuple[int, ...] = ()
    """Numbers of fruit in RESULT that show the word."""
    not_fruit: tuple[int, ...] = ()
    """Numbers of fruit in RESULT that do not show it."""
    boxes: Path | None = None
    """CSV of boxes: image, xmin, ymin, xmax, ymax and, if it has one, label; other labels are negative examples."""
    masks: Path | None = None
    """Folder of mask pictures, each named as its photo and white on the fruit."""
    start: Path | None = None
    """A .fruitword of the same word, whose examples are kept."""
    out: Path | None = None
    """File to write, named as the word; if not given, the user's folder of words."""
    notes: str = ""
    """Text for people, stored in the file."""
    licence: str = ""
    """Licence under which the word is passed on, stored in the file."""


def main() -> None:
    arguments = parse()
    from fruitlangs.engine.language.features.embedder import Embedder
    from fruitlangs.engine.language.prompts.relevancy import relevancy
    from fruitlangs.engine.language.taught.library import word_file
    from fruitlangs.engine.language.taught.name import word_name
    from fruitlangs.engine.language.taught.word import read_word, save_word
    from fruitlangs.engine.language.teaching.lesson import Lesson
    from fruitlangs.engine.language.teaching.region import Ground
    from fruitlangs.engine.open_result import open_result
    from fruitlangs.engine.report.word_picture import save_word_picture
    from fruitlangs.engine.storage.files import require_writable
    from fruitlangs.engine.user_folders import words_folder

    result = open_result(arguments.result)
    encoder = Embedder.open(result.config.embed).encoder
    ground = Ground.of(result.gaussians.means, result.features)
    start = None if arguments.start is None else read_word(arguments.start)
    name = word_file(Path(), word_name(arguments.word)).name
    file = arguments.out or words_folder() / name
    if file.name != name:
        raise ConfigError(f"--out {file} must be named {name}, as its word")
    lesson = Lesson(arguments.word, ground, result.features, encoder, start)
    marks = marks_of(arguments, lesson.name, result, ground)
    word = lesson.word(marks, notes=arguments.notes, licence=arguments.licence)
    require_writable(file.parent)
    save_word(file, word)
    probability = relevancy(result.features, encoder.with_words({word.name: word}), [word.name])
    written = [file]
    if result.scene.images:
        written.append(file.with_suffix(".jpg"))
        places = [each.place for each in word.examples]
        save_word_picture(written[1], result.scene, result.gaussians, probability, places)
    shown = sum(example.positive for example in word.examples)
    print(f"{word.name}: learnt from {shown} positive and {len(word.examples) - shown} negative examples")
    print(f"  {int((probability >= 0.5).sum()):,} of {len(probability):,} Gaussians of this scene match")
    print("\nwritten:", *written, sep="\n  ")
    print("\nOpen the picture. If it shows too much or too little, add examples there. Then count:")
    folder = "" if arguments.out is None else f" --words {file.parent}"
    print(f'  python scripts/count_fruit.py {arguments.result} --prompt "{word.name}" --out DIR{folder}')


def marks_of(arguments: Arguments, name: str, result: Result, ground: Ground) -> list[Mark]:
    """All examples, in the order of the flags."""
    from fruitlangs.engine.language.teaching.lesson import Mark
    from fruitlangs.engine.language.teaching.photo_marks import (
        Click,
        marks_of_boxes,
        marks_of_clicks,
        marks_of_masks,
    )

    scene, gaussians = result.scene, result.gaussians
    texts = [(text, True) for text in arguments.positive] + [(text, False) for text in arguments.negative]
    clicks = [Click.read(text, positive=positive) for text, positive in texts]
    marks = marks_of_clicks(clicks, scene, gaussians, ground)
    by_id = {fruit.id: fruit for fruit in result.fruit_count.fruits}
    for numbers, positive in ((arguments.fruit, True), (arguments.not_fruit, False)):
        for number in numbers:
            if number not in by_id:
                raise ConfigError(f"{arguments.result} has no fruit {number}. See fruits.csv")
            if not len(by_id[number].members):
                raise VocabularyError(
                    f"Fruit {number} was found in the photos alone and has no Gaussians to learn from. Click on it in "
                    "a photo instead"
                )
            marks.append(Mark(positive, f"fruit {number}", ground.grow_region(by_id[number].center)))
    if arguments.boxes is not None:
        marks += marks_of_boxes(arguments.boxes, name, scene, gaussians, ground)
    if arguments.masks is not None:
        marks += marks_of_masks(arguments.masks, scene, gaussians, ground)
    return marks


def parse() -> Arguments:
    """The arguments, or exit 2 with a usage message."""
    needed: Any = tyro.MISSING
    arguments: Arguments = parse_arguments(
        Arguments, Arguments(result=needed, word=needed), arguments_of(__file__), __file__, EXAMPLE
    )
    return arguments


if __name__ == "__main__":
    run(main)
