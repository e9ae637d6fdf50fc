"""F1 against the width of fruit: trees with known fruit, counted in photos that are read smaller and smaller."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from ..engine.config import CountConfig, SceneConfig
from ..engine.counting.prompted import Searched, count_prompts
from ..engine.errors import CountingError
from ..engine.evaluation.metrics import count_metrics
from ..engine.evaluation.truth import Truth, read_truth, true_labels
from ..engine.language.encoders.embedded import EmbeddedEncoder
from ..engine.language.features.lift import encode_photos, lift_features
from ..engine.language.features.photo_features import PhotoFeaturesRecorder
from ..engine.language.prompts.relevancy import relevancy
from ..engine.photo_size import photo_scales
from ..engine.progress import Progress, part, silent
from ..engine.scene.camera import Camera
from ..engine.scene.read import read_scene
from ..engine.splatting.gaussians import Gaussians
from ..engine.splatting.ply import read_ply
from ..engine.storage.files import replacing, write_text
from .markdown import markdown
from .orchards import TRUTH, read_origin

STORED = Path(__file__).with_name("widths.csv")
WIDTHS = (6.0, 8.0, 11.0, 16.0, 22.0, 30.0, 42.0, 60.0)
"""Mean widths of fruit in pixels at which a tree is counted, up to that of its own photos."""


@dataclass(frozen=True, kw_only=True)
class WidthRow:
    """One count. width: of the fruit in the photos as read, and seen: as the network sees them, both mean pixels over
    visible fruit and photos."""

    species: str
    seed: int
    width: float
    seen: float
    visible: int
    counted: int
    precision: float
    recall: float
    f1: float
    diameter_bias: float


def measure_widths(folder: Path, ply: Path, progress: Progress = silent) -> Iterator[WidthRow]:
    """Count a generated tree in its photos at all WIDTHS that they have, and at their own.

    folder: the tree; ply: Gaussians that were trained on its photos at full size, which serve every width.
    """
    origin = read_origin(folder)
    truth = read_truth(folder / TRUTH, true_labels([origin.species]))
    whole, gaussians = read_scene(folder, SceneConfig(max_side=0)), read_ply(ply)
    own = mean_width(truth, whole.cameras)
    side = max(max(camera.width, camera.height) for camera in whole.cameras)
    widths = [*(width for width in WIDTHS if width < 0.9 * own), own]
    for place, width in enumerate(widths):
        inner = part(progress, place / len(widths), (place + 1) / len(widths))
        inner(0.0, f"{folder.name}, fruit of {width:.0f} pixels")
        yield _counted(folder, gaussians, truth, round(side * width / own), origin.species, origin.seed or 0)


def mean_width(truth: Truth, cameras: Sequence[Camera]) -> float:
    """Mean width of the visible fruit over all cameras, in pixels."""
    centers, diameters = truth.centers[truth.visible], truth.diameters[truth.visible]
    widths = [diameters * camera.K[0, 0] / camera.project(centers)[1] for camera in cameras]
    return float(np.mean(widths))


def _counted(folder: Path, gaussians: Gaussians, truth: Truth, side: int, species: str, seed: int) -> WidthRow:
    scene, encoder = read_scene(folder, SceneConfig(max_side=side)), EmbeddedEncoder.open()
    scales = photo_scales(scene, encoder)
    recorder = PhotoFeaturesRecorder(encoder.kinds(), encoder.fruit_identity)
    photos = encode_photos(scene, encoder, scales, recorder)
    features = lift_features(gaussians, scene.cameras, photos, encoder_id=encoder.identity)
    searched = Searched(scene, gaussians, features, recorder.kept(), encoder, CountConfig())
    width = mean_width(truth, scene.cameras)
    centers, diameters = np.zeros((0, 3)), np.zeros(0)
    try:
        found = count_prompts(searched, [species], [], relevancy(features, encoder, [species]))
        centers, diameters = found.centers, found.diameters
    except CountingError:  # the fruit are too narrow to be counted: none is found
        pass
    metrics = count_metrics(centers, diameters, truth)
    return WidthRow(
        species=species,
        seed=seed,
        width=width,
        seen=width * float(np.mean([max(each) for each in scales])),
        visible=metrics.visible,
        counted=metrics.predicted,
        precision=metrics.precision,
        recall=metrics.recall,
        f1=metrics.f1,
        diameter_bias=metrics.diameter_bias,
    )


def write_widths(rows: Iterable[WidthRow], path: Path = STORED) -> None:
    """Write the rows, sorted, in place of earlier ones of the same trees."""
    new = list(rows)
    trees = {(row.species, row.seed) for row in new}
    kept = [row for row in read_widths(path) if (row.species, row.seed) not in trees]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([each.name for each in fields(WidthRow)])
    for row in sorted([*kept, *new], key=lambda each: (each.species, each.seed, each.width)):
        writer.writerow([f"{value:.4g}" if isinstance(value, float) else value for value in asdict(row).values()])
    write_text(path, text.getvalue())


def read_widths(path: Path = STORED) -> list[WidthRow]:
    """The rows of the table; none if there is no file."""
    if not path.is_file():
        return []
    kinds = {"species": str, "seed": int, "visible": int, "counted": int}
    with path.open(encoding="utf-8", newline="") as file:
        return [
            WidthRow(**{name: kinds.get(name, float)(cell) for name, cell in row.items()})  # type: ignore[arg-type]
            for row in csv.DictReader(file)
        ]


def width_table(rows: Sequence[WidthRow]) -> str:
    """Markdown: F1, recall and bias of diameters by tree and width."""
    lines = [["tree", "fruit in the photos, px", "seen, px", "visible", "counted", "F1", "recall", "bias of diameters"]]
    for row in rows:
        numbers = [f"{row.width:.0f}", f"{row.seen:.0f}", str(row.visible), str(row.counted)]
        bias = "–" if np.isnan(row.diameter_bias) else f"{100.0 * row.diameter_bias:+.0f} %"
        lines.append([f"{row.species} {row.seed}", *numbers, f"{row.f1:.3f}", f"{row.recall:.3f}", bias])
    return markdown(lines)


def draw_widths(rows: Sequence[WidthRow], path: Path) -> None:
    """F1 over the width of the fruit in the photos, a line for each tree."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for species, seed in dict.fromkeys((row.species, row.seed) for row in rows):
        own = [row for row in rows if (row.species, row.seed) == (species, seed)]
        axes.plot([row.width for row in own], [row.f1 for row in own], marker="o", label=f"{species} {seed}")
    axes.set_xscale("log")
    ticks = [6, 8, 11, 16, 22, 30]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set_ylim(0.0, 1.0)
    axes.set_xlabel("mean width of the fruit in the photos, pixels")
    axes.set_ylabel("F1 score")
    axes.grid(alpha=0.3)
    axes.legend()
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png", metadata={"Software": None})
