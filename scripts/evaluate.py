"""Measure counts against truth: the ablation ladder of generated scenes, or existing results.

    python scripts/evaluate.py SCENE… --out DIR
    python scripts/evaluate.py apple-small:101 plum-small:101 --out DIR
    python scripts/evaluate.py RESULT… --truth truth.json

With --out every scene (a folder of make_orchard.py, or a preset of it with a seed) is counted in every ablation stage:
with true masks, poses and geometry instead of estimated ones, which shows what each part loses. DIR gets tables, a page
with plots and pictures of the worst mistakes; an interrupted run continues. With --truth existing results are measured;
those with cameras that were found from photos are moved to the truth by these cameras.
F1 is against visible fruit of the counted kinds; a prediction on another true fruit of them is ignored.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

sys.path.insert(0, str(Path(__file__).resolve().parent))

import _checkout  # noqa: F401  puts the checkout on the path

import numpy as np

from _terminal import arguments_of, format_table, import_tyro, preset_of, report, run, spell_out, terminal_progress
from fruitlangs.benchmarks.ladder.ladder import StageResult, climb
from fruitlangs.benchmarks.ladder.pages import stage_rows, write_pages
from fruitlangs.benchmarks.ladder.stages import SAME_POSE
from fruitlangs.benchmarks.markdown import markdown
from fruitlangs.benchmarks.orchards import measure_each
from fruitlangs.engine.config import PRESETS, Config, CountConfig, EmbedConfig, Preset, SceneConfig, TrainConfig
from fruitlangs.engine.errors import ConfigError, FormatError, SceneError
from fruitlangs.engine.evaluation.camera_errors import camera_errors, camera_similarity
from fruitlangs.engine.evaluation.metrics import CountMetrics, count_metrics
from fruitlangs.engine.evaluation.truth import read_truth, read_views, true_labels
from fruitlangs.engine.progress import Progress
from fruitlangs.engine.result_folder import ResultFolder
from fruitlangs.engine.scene.alignment import Similarity
from fruitlangs.engine.scene.formats.cameras_json import camera_names, read_cameras
from fruitlangs.engine.training import CAMERAS

if TYPE_CHECKING:
    import tyro
else:
    tyro = import_tyro()

RADII = (0.5, 1.0)
HEADER = (
    "result", "radius", "predicted", "visible", "matched", "ignored", "precision", "recall", "F1", "doubles", "merges",
    "count error", "centre error", "diameter error", "diameter bias",
)  # fmt: skip
Stage = Literal["counting-only", "true-geometry", "true-masks", "true-poses", "end-to-end"]


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Measure counts against truth."""

    given: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENE|RESULT")]
    """With --out: folders of generated scenes, or presets with seeds such as apple-small:101. With --truth: results."""
    out: Path | None = None
    """Folder of the ladder's tables, pictures and cached stages."""
    truth: Path | None = None
    """truth.json of the scene that was counted in the result folders."""
    label: str | None = None
    """With --truth: measure against true fruit of this word only; else against those of the counted prompts."""
    prompt: tuple[str, ...] = ()
    """With --out: what to count; else the species that each scene says it has."""
    stages: Annotated[tuple[Stage, ...], tyro.conf.arg(aliases=("--rungs",))] = get_args(Stage)
    """With --out: the ablation stages to count. --rungs is the earlier name."""
    preset: Preset = "standard"
    """Settings of training to start from."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    embed: EmbedConfig = field(default_factory=EmbedConfig)
    """How Gaussians get features that words can query. These flags may go without their stage: --encoder clip."""
    count: CountConfig = field(default_factory=CountConfig)


def main(given: Sequence[str] | None = None) -> None:
    """Measure what the command line names.

    Raises:
        FruitLangsError: a result or a scene could not be measured; tables of the others are written before.
    """
    arguments = parse(arguments_of(__file__) if given is None else list(given))
    if (arguments.out is None) == (arguments.truth is None):
        raise ConfigError("Give --out DIR to count scenes, or --truth truth.json to measure results, and not both")
    if not arguments.given:
        raise ConfigError("Nothing is given to measure. Name scenes or results")
    if arguments.truth is not None and arguments.prompt:
        raise ConfigError("--prompt is for scenes that are counted with --out. Leave it out")
    if arguments.out is not None and arguments.label:
        raise ConfigError("--label is for results that are measured with --truth. With --out give --prompt")
    if arguments.truth is not None:
        folders = [Path(name) for name in arguments.given]
        rows = [row for folder in folders for row in measure(folder, arguments.truth, arguments.label)]
        print(format_table([HEADER, *rows]))
    else:
        run_ladder(arguments)


def run_ladder(arguments: Arguments) -> None:
    """Count every scene and write the pages after each, so that an interrupt keeps what was measured."""
    assert arguments.out is not None
    config = Config(scene=arguments.scene, train=arguments.train, embed=arguments.embed, count=arguments.count)
    out, progress, rows = arguments.out, terminal_progress(), list[StageResult]()

    def climb_one(folder: Path, share: Progress) -> None:
        rows.extend(
            climb(
                folder,
                out / folder.name,
                config=config,
                prompts=arguments.prompt,
                stages=arguments.stages,
                report=report,
                progress=share,
            )
        )
        write_pages(rows, out, title="Counts by stage of the ablation ladder")

    broken = measure_each(arguments.given, out, climb_one, report=report, progress=progress)
    progress(1.0, "Done")
    if rows:
        print(markdown(stage_rows(rows)))
        print(f"\nwritten: {out / 'index.html'}, ladder.csv, ladder.md, visibility.csv, times.csv")
    broken += [f"{row.scene}, {row.stage}: {row.failed}" for row in rows if row.failed]
    if broken:
        raise ConfigError(f"{len(broken)} could not be measured. The first: {broken[0]}")


def measure(folder: Path, truth_file: Path, label: str | None) -> list[tuple[str, ...]]:
    """One row of cells per matching radius for a result folder."""
    document = ResultFolder(folder).read(verify=False)
    fruits = document["fruits"]
    truth = read_truth(truth_file, true_labels([label] if label else document["provenance"]["prompts"]))
    unit = document["metres_per_unit"] or 1.0
    centers = np.array([fruit["center"] for fruit in fruits], dtype=np.float64).reshape(-1, 3)
    diameters = np.array([fruit["diameter"] / unit for fruit in fruits], dtype=np.float64)
    moved = align_to_truth(folder / CAMERAS, truth_file, truth.mean_diameter)
    if moved is not None:
        centers, diameters = moved.apply(centers), moved.apply_to_lengths(diameters)
    return [cells(folder.name, count_metrics(centers, diameters, truth, radius)) for radius in RADII]


def align_to_truth(cameras: Path, truth_file: Path, diameter: float) -> Similarity | None:
    """Find the similarity from a result's frame to that of the truth, by the cameras that both list; None if the frames
    are the same, or if one of them lists no cameras. Cameras that were found from photos have a frame of their own.

    Raises:
        FormatError: the frames differ, and the cameras that both list do not tell how: they are too few, or half of
            them are off by more than a fruit's mean `diameter`.
    """
    true = read_views(truth_file)
    if not true or not cameras.is_file():
        return None
    found = dict(zip((Path(name).name for name in camera_names(cameras)), read_cameras(cameras).cameras, strict=True))
    same = {
        view.name: dataclasses.replace(found[view.name], world_to_camera=view.world_to_camera)
        for view in true
        if view.name in found
    }
    if same and all(
        np.abs(found[name].world_to_camera - same[name].world_to_camera).max() < SAME_POSE for name in same
    ):
        return None
    unknown = "so the fruit cannot be moved to the truth. Give the truth of the scene that was counted"
    try:
        moved, errors = camera_similarity(found, same), camera_errors(found, same)
    except SceneError as error:
        raise FormatError(f"{cameras} and {truth_file} share {len(same)} cameras, {unknown}") from error
    if errors.center > diameter:
        raise FormatError(f"{cameras} has half of its cameras more than a fruit's diameter off {truth_file}, {unknown}")
    report(
        f"{cameras.parent}: moved to the truth by {errors.placed} cameras, which are then off by {errors.center:.4f} "
        f"(median) and {errors.center_90:.4f} (90th percentile) scene units"
    )
    return moved


def cells(name: str, metrics: CountMetrics) -> tuple[str, ...]:
    """A table row of one measurement."""
    counts = (metrics.predicted, metrics.visible, metrics.matched, metrics.ignored)
    ratios = (metrics.precision, metrics.recall, metrics.f1)
    return (
        name,
        f"{metrics.radius:g}",
        *(str(count) for count in counts),
        *(f"{ratio:.3f}" for ratio in ratios),
        str(metrics.doubles),
        str(metrics.merges),
        f"{metrics.count_error:+d} ({metrics.relative_count_error:+.1%})",
        f"{metrics.center_error:.3f}",
        f"{metrics.diameter_error:.1%}",
        f"{metrics.diameter_bias:+.1%}",
    )


def parse(given: list[str]) -> Arguments:
    """The arguments, or exit 2 with a usage message."""
    given = spell_out(given, "embed", EmbedConfig)
    preset = preset_of(given)
    default = Arguments(given=(), preset=preset, train=PRESETS[preset])
    return tyro.cli(Arguments, args=given, default=default, prog="evaluate.py", description=__doc__)


if __name__ == "__main__":
    run(main)
