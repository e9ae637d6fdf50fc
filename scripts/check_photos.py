"""Check the photos of a tree before a long run, in about half a minute for 80 photos.

    python scripts/check_photos.py SCENE --out DIR

Prints what is wrong with the photos and what to do, and how long a run takes, and writes a contact sheet with the
photos in question marked. Exit code 0: checked, whatever was found; 1: not checked, with one line that says why; 2:
usage; 130: cancelled.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

from _checkout import ROOT

from _help import parse_arguments
from _terminal import arguments_of, format_table, import_tyro, preset_of, run, terminal_progress
from fruitlangs.engine.config import PRESETS, Config, PhotosConfig, Preset, SceneConfig, TrainConfig

if TYPE_CHECKING:
    import tyro

    from fruitlangs.engine.photo_check.finding import PhotoCheck
else:
    tyro = import_tyro()

EXAMPLE = "photos/tree7 --out results/tree7-check"
SHEET = "contact_sheet.jpg"
WIDTH = 100
"""Characters of a printed line."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Check the photos of a tree: blur, gaps, exposure, cameras, and the time and memory of a run."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Folder of photos, of a COLMAP model with images, or of a nerfstudio transforms.json; or a video."""
    out: Path | None = None
    """Folder for the contact sheet; by default a folder SCENE-check next to SCENE."""
    preset: Preset = "standard"
    """Training settings that the expected time is for: quick, standard or paper."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    photos: PhotosConfig = field(default_factory=PhotosConfig)
    train: TrainConfig = field(default_factory=TrainConfig)


def report_lines(source: Path, check: PhotoCheck) -> Iterator[str]:
    """The findings in the scene, then the expected time and memory, as lines of text."""
    from fruitlangs.engine.photo_check.finding import photos_text
    from fruitlangs.engine.progress import duration

    yield f"{source}: {photos_text(len(check.photos))}, {check.counts}"
    for finding in check.findings:
        yield ""
        yield from textwrap.wrap(f"{finding.severity}: {finding.sentence}.", WIDTH, subsequent_indent="  ")
        yield from textwrap.wrap(f"  What to do: {finding.advice}.", WIDTH, subsequent_indent="  ")
    if check.costs:
        rows = [(cost.stage, duration(cost.seconds), f"{cost.bytes / 2**30:.1f} GB") for cost in check.costs]
        whole = ("in all", duration(check.seconds), f"{check.bytes / 2**30:.1f} GB")
        yield "\nexpected on this computer, within a factor of two:"
        yield textwrap.indent(format_table([("stage", "time", "memory"), *rows, whole]), "  ")


def main() -> None:
    arguments = parse()
    from fruitlangs.engine.photo_check.check import check_photos
    from fruitlangs.engine.photo_check.sheet import sheet_folder, write_sheet

    folder = sheet_folder(arguments.source, arguments.out)
    if arguments.out is None:
        folder = keep_outside_checkout(folder)
    config = Config(scene=arguments.scene, photos=arguments.photos, train=arguments.train)
    check = check_photos(arguments.source, config, progress=terminal_progress())
    print("\n".join(report_lines(arguments.source, check)))
    if check.photos:
        write_sheet(folder / SHEET, check)
        print(f"\nwritten:\n  {folder / SHEET}")


def keep_outside_checkout(folder: Path) -> Path:
    """Return the folder, or one in `results`, which no build takes files from, if it is inside the checkout."""
    return ROOT / "results" / folder.name if folder.is_relative_to(ROOT) else folder


def parse() -> Arguments:
    """The arguments, or exit 2 with a usage message."""
    given = arguments_of(__file__)
    needed: Any = tyro.MISSING
    default = Arguments(source=needed, preset=preset_of(given), train=PRESETS[preset_of(given)])
    arguments: Arguments = parse_arguments(Arguments, default, given, __file__, EXAMPLE)
    return arguments


if __name__ == "__main__":
    run(main)
