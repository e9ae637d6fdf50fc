"""The paper's three tables on any scenes: reconstruction, counts and the ablation of language."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from ...engine.config import Config, CountConfig
from ...engine.counting.count import count_fruit
from ...engine.errors import FormatError, FruitLangsError
from ...engine.evaluation.datasets.cloud import ColoredCloud, write_cloud
from ...engine.evaluation.metrics import count_metrics
from ...engine.evaluation.renders import read_depths, read_instances
from ...engine.evaluation.true_surface import true_surface
from ...engine.evaluation.truth import Truth, read_truth, true_labels
from ...engine.pipeline import Result, count_scene
from ...engine.progress import Progress, part, silent
from ...engine.scene.camera import Scene
from ...engine.scene.read import read_scene
from ...engine.splatting.gaussians import Gaussians
from ...engine.splatting.rendering.rasterize import render
from ..orchards import TRUTH, read_origin
from .fruit_field import learn_fruit_field


@dataclass(frozen=True, kw_only=True)
class Variant:
    """The paper's parts in a training; all of them schedule tiles by load, which does not change the picture."""

    pair_alpha: float = 1.0
    drop_unneeded: float = 0.0
    load_weight: float = 0.0

    def of(self, config: Config) -> Config:
        return replace(config, train=replace(config.train, **asdict(self)))


_TAU, _DROPPED, _LOAD = 4.0, 1.0, 0.02
VARIANTS: Mapping[str, Variant] = {
    "3DGS": Variant(),
    "eq. 3": Variant(pair_alpha=_TAU, drop_unneeded=_DROPPED),
    "eq. 4": Variant(load_weight=_LOAD),
    "eq. 3 + 4": Variant(pair_alpha=_TAU, drop_unneeded=_DROPPED, load_weight=_LOAD),
}
"""Trainings by name: as 3DGS, with the paper's pruning of pairs and Gaussians, with its load term, with both."""
OURS = "eq. 3 + 4"
CLOUD, IMPORTED = "nerf.ply", "3dgs.ply"
"""Reconstructions of other programs that a scene's folder may contain, in the frame of its cameras."""
LEAST_OPACITY, LARGEST, LEAST_HEIGHT = 0.1, 0.02, 0.03
"""Without language a Gaussian passes above this opacity, up to this size and above this height over the ground, the
last two as shares of the extent."""
SPEED_VIEWS = 8


@dataclass(frozen=True, kw_only=True)
class Quality:
    """A reconstruction: SSIM and PSNR (dB) of held-out photos, frames per second on this computer's processor."""

    ssim: float | None
    psnr: float | None
    fps: float


@dataclass(frozen=True, kw_only=True)
class Tally:
    """A count and the true one. f1: at half a diameter, if there is a truth; note: why there is no count, or its
    source."""

    counted: int | None = None
    true: int | None = None
    f1: float | None = None
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class SceneTables:
    """The rows of one scene in the three tables, by the names of their columns."""

    name: str
    reconstruction: Mapping[str, Quality] = field(default_factory=dict)
    counts: Mapping[str, Tally] = field(default_factory=dict)
    ablation: Mapping[str, Tally] = field(default_factory=dict)


def measure_tables(
    folder: Path,
    out: Path,
    *,
    config: Config,
    prompts: Sequence[str] = (),
    report: Callable[[str], None] = lambda _: None,
    progress: Progress = silent,
) -> SceneTables:
    """Compute every row of the tables for one scene; trainings and counts are cached in `out`.

    prompts: what to count; the species of the scene if not given.

    Raises:
        FruitLangsError: the scene cannot be read or counted, or nothing says what to count.
    """
    asked = list(prompts) or [read_origin(folder).species]
    if not asked[0]:
        raise FormatError(f"{folder} does not say what grows there. Give --prompt")
    truth = read_truth(folder / TRUTH, true_labels(asked)) if (folder / TRUTH).is_file() else None
    results = {}
    for number, (name, variant) in enumerate(VARIANTS.items()):
        report(f"{folder.name}: training with {name}")
        share = part(progress, 0.15 * number, 0.15 * (number + 1))
        results[name] = count_scene(
            folder, asked, out / name.replace(" ", ""), config=variant.of(config), progress=share
        )
    scene, ours = read_scene(folder, config.scene), results[OURS]
    report(f"{folder.name}: counting in other reconstructions")
    imported = folder / IMPORTED if (folder / IMPORTED).is_file() else results["3DGS"].out / "gaussians.ply"
    note = "" if imported.name == IMPORTED else "our training without eq. 3 and 4"
    from_imported = _count_in_other(folder, imported, asked, out / "foreign", config, truth, note)
    report(f"{folder.name}: FruitNeRF's field")
    fruitnerf = replace(config.count, method="fruitnerf")
    clustered, by_field = _count_in_field(ours, asked, config, [fruitnerf, config.count], truth)
    return SceneTables(
        name=folder.name,
        reconstruction={name: _quality(result) for name, result in results.items()},
        counts={
            "NeRF+Ours": _count_in_cloud(folder, scene, asked, out, config, truth),
            "3DGS+Ours": from_imported,
            "FruitNeRF": clustered,
            "Ours": _tally(ours, truth),
        },
        ablation={
            "with language": _tally(ours, truth),
            "without language": _count_without_language(ours, scene, config, truth, part(progress, 0.9, 1.0)),
            "Fruit Field": by_field,
        },
    )


def _count_in_field(
    ours: Result, prompts: Sequence[str], config: Config, counts: Sequence[CountConfig], truth: Truth | None
) -> list[Tally]:
    """Return counts of the Gaussians that FruitNeRF's field, learnt in ours, says are fruit."""
    try:
        probability = learn_fruit_field(ours, prompts, config)
    except FruitLangsError as error:
        return [_make_unmeasured(error)] * len(counts)
    tallies = []
    for each in counts:
        try:
            found = count_fruit(ours.gaussians, probability, ours.scene.cameras, each, label=prompts[0])
            tally = replace(_tally(replace(ours, fruit_count=found), truth), note="its field learnt in our Gaussians")
        except FruitLangsError as error:
            tally = _make_unmeasured(error)
        tallies.append(tally)
    return tallies


def _quality(result: Result) -> Quality:
    training = result.origin["training"]
    return Quality(ssim=training["ssim"], psnr=training["psnr"], fps=measure_frames_per_second(result))


def measure_frames_per_second(result: Result) -> float:
    """Measure the rendering speed of the photos' views: the median over views, after one to warm up."""
    seconds = []
    for camera in [result.scene.cameras[0], *result.scene.cameras[:SPEED_VIEWS]]:
        start = time.perf_counter()
        with torch.no_grad():
            render(result.gaussians, camera)
        seconds.append(time.perf_counter() - start)
    return 1.0 / float(np.median(seconds[1:]))


def _count_in_other(
    folder: Path, file: Path, prompts: Sequence[str], out: Path, config: Config, truth: Truth | None, note: str
) -> Tally:
    """Return a count in another program's reconstruction, or why there is none."""
    try:
        return replace(_tally(count_scene(folder, prompts, out, config=config, imported=file), truth), note=note)
    except FruitLangsError as error:
        return _make_unmeasured(error)


def _make_unmeasured(error: FruitLangsError) -> Tally:
    return Tally(note=f"not measured: {' '.join(str(error).split())}")


def _count_in_cloud(
    folder: Path, scene: Scene, prompts: Sequence[str], out: Path, config: Config, truth: Truth | None
) -> Tally:
    """Return a count in a coloured point cloud: a NeRF's if the folder has one, else one of true depths if there are
    any."""
    cloud, note = folder / CLOUD, ""
    if not cloud.is_file():
        cloud, note = out / "true_depths.ply", "points of true depths in NeRF's place"
        try:
            surface = true_surface(scene, read_depths(folder, scene), read_instances(folder, scene)).gaussians
        except FruitLangsError as error:
            return _make_unmeasured(error)
        colors = (255 * surface.base_colors).round().byte().numpy()
        write_cloud(cloud, ColoredCloud(surface.means.double().numpy(), colors))
    return _count_in_other(folder, cloud, prompts, out / "cloud", config, truth, note)


def select_without_language(gaussians: Gaussians, scene: Scene) -> torch.Tensor:
    """Return (N,) 1 for every Gaussian that passes cuts of opacity, size, ground and surroundings, else 0.

    Ground is everything below LEAST_HEIGHT of the extent above the lowest twentieth of what the cameras surround;
    surroundings and sky are everything farther from the cameras' middle than the cameras.
    """
    means = gaussians.means.double().numpy()
    heights, away = means @ scene.up, np.linalg.norm(means - scene.middle, axis=1)
    opaque = gaussians.opacities.numpy() >= LEAST_OPACITY
    inside = away < scene.spread
    floor = float(np.percentile(heights[inside & opaque], 5)) if (inside & opaque).any() else -np.inf
    small = gaussians.scales.numpy().max(axis=1) <= LARGEST * scene.extent
    kept = opaque & small & inside & (heights > floor + LEAST_HEIGHT * scene.extent)
    return torch.from_numpy(kept.astype(np.float64))


def _count_without_language(
    ours: Result, scene: Scene, config: Config, truth: Truth | None, progress: Progress
) -> Tally:
    probability = select_without_language(ours.gaussians, scene)
    try:
        found = count_fruit(
            ours.gaussians, probability, ours.scene.cameras, config.count, label="fruit", progress=progress
        )
    except FruitLangsError as error:
        return _make_unmeasured(error)
    return _tally(replace(ours, fruit_count=found), truth)


def _tally(result: Result, truth: Truth | None) -> Tally:
    found = result.fruit_count
    if truth is None:
        return Tally(counted=found.count)
    metrics = count_metrics(found.centers, found.diameters, truth)
    return Tally(counted=found.count, true=metrics.visible, f1=metrics.f1)
