"""The paper's tables on any scenes: reconstruction, counts, and the language ablation.

    python scripts/tables.py SCENE… --out DIR
    python scripts/tables.py apple-small:101 --out DIR --preset quick

A scene is a folder that count_fruit.py reads, with a truth.json where counts are to be measured, or a preset of
make_orchard.py with a seed. `3dgs.ply` and `nerf.ply` in its folder are used for the rows of other reconstructions.
Prints the tables in Markdown and writes them to DIR/tables.md; an interrupted run continues.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import _checkout  # noqa: F401  puts the checkout on the path

from _terminal import arguments_of, import_tyro, preset_of, report, run, spell_out, terminal_progress
from fruitlangs.benchmarks.orchards import measure_each
from fruitlangs.benchmarks.paper.pages import ablation_table, count_table, reconstruction_table
from fruitlangs.benchmarks.paper.tables import SceneTables, measure_tables
from fruitlangs.engine.config import PRESETS, Config, CountConfig, EmbedConfig, Preset, SceneConfig, TrainConfig
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.progress import Progress
from fruitlangs.engine.storage.files import write_text

if TYPE_CHECKING:
    import tyro
else:
    tyro = import_tyro()


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The paper's tables on any scenes."""

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Folders of scenes, or presets of make_orchard.py with seeds such as apple-small:101."""
    out: Path
    """Folder of the tables and of what was trained for them."""
    prompt: tuple[str, ...] = ()
    """What to count; else the species that each scene says it has."""
    preset: Preset = "standard"
    """Settings of training to start from; the paper's are 30,000 steps."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    embed: EmbedConfig = field(default_factory=EmbedConfig)
    """How Gaussians get features that words can query. These flags may go without their stage: --encoder clip."""
    count: CountConfig = field(default_factory=CountConfig)


def main() -> None:
    arguments = parse(arguments_of(__file__))
    config = Config(scene=arguments.scene, train=arguments.train, embed=arguments.embed, count=arguments.count)
    out, progress, measured = arguments.out, terminal_progress(), list[SceneTables]()
    setting = f"{config.train.steps} steps, at most {config.train.max_gaussians} Gaussians"

    def measure(folder: Path, share: Progress) -> None:
        measured.append(
            measure_tables(
                folder, out / folder.name, config=config, prompts=arguments.prompt, report=report, progress=share
            )
        )
        write_text(out / "tables.md", pages(measured, setting))

    broken = measure_each(arguments.scenes, out, measure, report=report, progress=progress)
    progress(1.0, "Done")
    if measured:
        print(pages(measured, setting))
    if broken:
        raise ConfigError(f"{len(broken)} of {len(arguments.scenes)} scenes could not be measured; {broken[0]}")


def pages(measured: list[SceneTables], setting: str) -> str:
    """The three tables with their titles."""
    return (
        "\n\n".join(
            [
                f"Reconstruction, {setting}; in brackets what the paper printed.",
                reconstruction_table(measured),
                "Counts against visible fruit.",
                count_table(measured),
                "Ablation of language.",
                ablation_table(measured),
            ]
        )
        + "\n"
    )


def parse(given: list[str]) -> Arguments:
    """The arguments, or exit 2 with a usage message."""
    given = spell_out(given, "embed", EmbedConfig)
    preset = preset_of(given)
    missing: Any = tyro.MISSING
    default = Arguments(scenes=missing, out=missing, preset=preset, train=PRESETS[preset])
    return tyro.cli(Arguments, args=given, default=default, prog="tables.py", description=__doc__)


if __name__ == "__main__":
    run(main)
