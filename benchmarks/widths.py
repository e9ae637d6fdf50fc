"""F1 against the width of fruit: trees with known fruit, counted in photos that are read smaller and smaller."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ..engine.config import CountConfig, EmbedConfig, SceneConfig
from ..engine.counting.fruit import FruitCount
from ..engine.counting.prompted import Searched, count_prompts
from ..engine.errors import CountingError
from ..engine.evaluation.metrics import count_metrics
from ..engine.evaluation.truth import Truth, read_truth, true_labels
from ..engine.language.encoders.encoder import sees_fruit
from ..engine.language.features.embedder import Embedder
from ..engine.language.features.photo_features import PhotoFeaturesRecorder
from ..engine.language.prompts.selection import select
from ..engine.photo_size import photo_scales
from ..engine.progress import Progress, part, silent
from ..engine.scene.camera import Camera, Scene
from ..engine.scene.read import read_scene
from ..engine.splatting.gaussians import Gaussians
from ..engine.splatting.ply import read_ply
from ..engine.storage.files import write_text
from .markdown import NONE, markdown
from .orchards import TRUTH, read_origin
from .plots import save_plot

STORED = Path(__file__).with_name("widths.json")
WIDTHS = (6.0, 8.0, 11.0, 16.0, 22.0, 30.0, 42.0, 60.0)
"""Mean widths of fruit in pixels at which a tree is counted, up to that of its own photos."""


@dataclass(frozen=True, kw_only=True)
class WidthRow:
    """One count. width: of the fruit in the photos as read, and seen: as the network sees them, both mean pixels over
    visible fruit and photos; failed: why there is no count, and no measure of one; diameter_bias: None if no fruit is
    right."""

    species: str
    seed: int
    width: float
    seen: float
    visible: int
    failed: str = ""
    counted: int | None = None
    recall: float | None = None
    f1: float | None = None
    diameter_bias: float | None = None


def measure_widths(folder: Path, ply: Path, progress: Progress = silent) -> Iterator[WidthRow]:
    """Count a generated tree in its photos at all WIDTHS that they have, and at their own.

    folder: the tree; ply: Gaussians that were trained on its photos at full size, which serve every width.
    """
    origin = read_origin(folder)
    truth = read_truth(folder / TRUTH, true_labels([origin.species]))
    whole, gaussians = read_scene(folder, SceneConfig(max_side=0)), read_ply(ply)
    own = measure_mean_width(truth, whole.cameras)
    side = max(max(camera.width, camera.height) for camera in whole.cameras)
    widths, embedder = [*(width for width in WIDTHS if width < 0.9 * own), own], Embedder.open(EmbedConfig())
    for place, width in enumerate(widths):
        inner = part(progress, place / len(widths), (place + 1) / len(widths))
        inner(0.0, f"{folder.name}, fruit of {width:.0f} pixels")
        scene = read_scene(folder, SceneConfig(max_side=round(side * width / own)))
        scales = photo_scales(scene, embedder.encoder)
        read = measure_mean_width(truth, scene.cameras)
        seen = read * float(np.mean([max(each) for each in scales]))
        row = WidthRow(
            species=origin.species, seed=origin.seed or 0, width=read, seen=seen, visible=int(truth.visible.sum())
        )
        try:
            found = _count(scene, gaussians, origin.species, embedder, scales)
        except CountingError as error:
            yield replace(row, failed=str(error))
            continue
        metrics = count_metrics(found.centers, found.diameters, truth)
        bias = metrics.diameter_bias if metrics.matched else None
        yield replace(row, counted=metrics.predicted, recall=metrics.recall, f1=metrics.f1, diameter_bias=bias)


def measure_mean_width(truth: Truth, cameras: Sequence[Camera]) -> float:
    """Measure the mean width of the visible fruit over all cameras, in pixels."""
    centers, diameters = truth.centers[truth.visible], truth.diameters[truth.visible]
    widths = [diameters * camera.K[0, 0] / camera.project(centers)[1] for camera in cameras]
    return float(np.mean(widths))


def _count(
    scene: Scene, gaussians: Gaussians, species: str, embedder: Embedder, scales: Sequence[Sequence[float]]
) -> FruitCount:
    """Count a species in photos as a run does, with Gaussians that are given.

    Raises:
        CountingError: see `count_fruit`.
    """
    encoder, config = embedder.encoder, CountConfig()
    assert sees_fruit(encoder)
    recorder = PhotoFeaturesRecorder(encoder.kinds(), encoder.fruit_identity)
    with TemporaryDirectory() as cache:
        features = embedder.lift(gaussians, scene, Path(cache), scales=scales, recorder=recorder)
    searched = Searched(scene, gaussians, features, recorder.collect(), encoder, config)
    probability = select(features, encoder, [species], [], config, gaussians.means)
    return count_prompts(searched, [species], [], probability)


def write_widths(rows: Iterable[WidthRow], path: Path = STORED) -> None:
    """Write the rows, sorted, in place of earlier ones of the same trees."""
    new = list(rows)
    trees = {(row.species, row.seed) for row in new}
    kept = [row for row in read_widths(path) if (row.species, row.seed) not in trees]
    ordered = sorted([*kept, *new], key=lambda row: (row.species, row.seed, row.width))
    write_text(path, json.dumps([asdict(row) for row in ordered], indent=1) + "\n")


def read_widths(path: Path = STORED) -> list[WidthRow]:
    """The rows of the file; none if there is none."""
    return [WidthRow(**row) for row in json.loads(path.read_text(encoding="utf-8"))] if path.is_file() else []


def width_table(rows: Sequence[WidthRow]) -> str:
    """Markdown: F1, recall and bias of diameters by tree and width."""
    lines = [["tree", "fruit in the photos, px", "seen, px", "visible", "counted", "F1", "recall", "bias of diameters"]]
    for row in rows:
        numbers = [f"{row.width:.0f}", f"{row.seen:.0f}", str(row.visible)]
        measures = ["error" if row.failed else str(row.counted), *map(_format_three_places, (row.f1, row.recall))]
        bias = NONE if row.diameter_bias is None else f"{100.0 * row.diameter_bias:+.0f} %"
        lines.append([f"{row.species} {row.seed}", *numbers, *measures, bias])
    return markdown(lines)


def _format_three_places(value: float | None) -> str:
    return NONE if value is None else f"{value:.3f}"


def draw_widths(rows: Sequence[WidthRow], path: Path) -> None:
    """F1 over the width of the fruit in the photos, a line for each tree."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for species, seed in dict.fromkeys((row.species, row.seed) for row in rows):
        own = [row for row in rows if (row.species, row.seed) == (species, seed)]
        scores = [np.nan if row.f1 is None else row.f1 for row in own]
        axes.plot([row.width for row in own], scores, marker="o", label=f"{species} {seed}")
    axes.set_xscale("log")
    ticks = [6, 8, 11, 16, 22, 30]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set_ylim(0.0, 1.0)
    axes.set_xlabel("mean width of the fruit in the photos, pixels")
    axes.set_ylabel("F1 score")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    save_plot(figure, path)
