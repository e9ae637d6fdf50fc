"""A check of a graphics card, for whoever has one: is it right, does it repeat, how fast is it."""

from __future__ import annotations

import hashlib
import math
import platform
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...engine.config import PRESETS, Config, SceneConfig, TrainConfig
from ...engine.errors import Cancelled, GpuError
from ...engine.evaluation.metrics import count_metrics
from ...engine.evaluation.truth import read_truth
from ...engine.pipeline import count_scene
from ...engine.progress import Progress, part, silent
from ...engine.scene.camera import Scene
from ...engine.scene.read import read_scene
from ...engine.splatting.gaussians import PARAMETERS, Gaussians
from ...engine.splatting.gpu.adapters import LIMITS, Adapter
from ...engine.splatting.gpu.card import Card
from ...engine.splatting.gpu.drawing import Canvas, Learnt, pack_photo, view_of
from ...engine.splatting.rendering.agreement import compare_card_with_reference, compare_with_reference
from ...engine.splatting.rendering.render import DrawRules, arrays_of
from ...engine.splatting.training.train import train
from ..markdown import markdown
from .step_times import SH_DEGREE, look_ahead, make_orchard_like

COUNTS, SIZES = (50_000, 200_000, 1_000_000, 3_000_000), ((400, 300), (800, 600), (1600, 1200))
SMALL = 300
"""Gaussians of the scenes that are compared with the reference."""
BOUND = 1e-3
"""Largest error, of the largest value of the reference, of a card that is right."""
SHORT = TrainConfig(steps=60, max_gaussians=20_000, densify_every=20, checkpoint_every=25, sh_degree=2)
STOPPED_AFTER = 40
"""The trainings whose bytes are compared, and the steps after which one of them is interrupted."""
REPEATS = 10


@dataclass(frozen=True)
class StepTime:
    """A step of training. seconds: None if the card refuses, for `reason`; shares: of its time by stage, empty without
    a clock; bytes: of all buffers."""

    gaussians: int
    width: int
    height: int
    seconds: float | None
    shares: Mapping[str, float]
    bytes: int
    reason: str = ""


@dataclass(frozen=True)
class Counted:
    """The sample, end to end. device: what trained; psnr: of held-out photos, dB; training: seconds."""

    device: str
    psnr: float
    f1: float
    count: int
    training: float


def check_card(
    adapter: Adapter,
    scene_folder: Path,
    *,
    counts: Sequence[int] = COUNTS,
    sizes: Sequence[tuple[int, int]] = SIZES,
    sample: bool = True,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Everything that is known of a card after some minutes, as it is written to card.json.

    scene_folder: a generated scene with truth.json; sample: also count it on the card and on the CPU.

    Raises:
        GpuError: the card cannot be opened.
        SceneError: the scene cannot be read.
    """
    card = Card.open(adapter, timed=True)
    progress(0.0, "Comparing with the reference")
    errors = _measure_errors(card)
    progress(0.1, "Comparing bytes")
    bytes_equal = _check_repeats(adapter, read_scene(scene_folder, SceneConfig()))
    times = _time_steps(adapter, counts, sizes, part(progress, 0.3, 0.6))
    counted = _count_sample(adapter, scene_folder, part(progress, 0.6, 1.0)) if sample else []
    return {
        "adapter": {
            "name": adapter.name,
            "driver": adapter.driver,
            "backend": adapter.backend,
            "software": adapter.software,
            "limits": {name: adapter.handle.limits[name] for name in (*LIMITS, "max-buffer-size")},
        },
        "system": {"platform": platform.platform(), "python": platform.python_version()},
        "errors": errors,
        "right": max(errors["card"].values()) < BOUND,
        "repeats": bytes_equal,
        "steps": [asdict(each) for each in times],
        "sample": [asdict(each) for each in counted],
    }


def _measure_errors(card: Card) -> dict[str, dict[str, float]]:
    """Measure the largest errors over harmonics of degree 0 to 3, and antialiased, of the card and of the CPU."""
    found: dict[str, dict[str, float]] = {"card": {}, "CPU": {}}
    for degree, antialiased in ((0, False), (1, False), (2, False), (3, False), (3, True)):
        gaussians = make_orchard_like(SMALL, degree)
        terms = (degree + 1) ** 2
        scene = replace(gaussians, sh=gaussians.sh[:, :terms].contiguous(), antialiased=antialiased)
        camera = look_ahead(97, 73)
        for name, errors in (
            ("card", compare_card_with_reference(Canvas(card), scene, camera, seed=degree)),
            ("CPU", compare_with_reference(scene, camera, seed=degree)),
        ):
            for value, error in errors.items():
                found[name][value] = max(error, found[name].get(value, 0.0))
    shared = found["card"].keys()
    found["CPU"] = {value: error for value, error in found["CPU"].items() if value in shared}
    return found


def _check_repeats(adapter: Adapter, scene: Scene) -> dict[str, Any]:
    """Check whether two short trainings, and one that was interrupted and resumed, give the same bytes."""

    def stop(_: float, message: str) -> None:
        if message.startswith(f"step {STOPPED_AFTER}/"):
            raise Cancelled

    one, other = (train(scene, SHORT, adapter=adapter) for _ in range(2))
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = Path(folder) / "checkpoint.safetensors"
        with suppress(Cancelled):
            train(scene, SHORT, checkpoint=checkpoint, adapter=adapter, progress=stop)
        resumed = train(scene, SHORT, checkpoint=checkpoint, adapter=adapter)
    hashes = [_hash(each.gaussians) for each in (one, other, resumed)]
    return {"device": one.device, "again": hashes[0] == hashes[1], "resumed": hashes[0] == hashes[2], "hash": hashes[0]}


def _hash(gaussians: Gaussians) -> str:
    digest = hashlib.sha256()
    for name in PARAMETERS:
        digest.update(getattr(gaussians, name).numpy().tobytes())
    return digest.hexdigest()[:16]


def _time_steps(
    adapter: Adapter, counts: Sequence[int], sizes: Sequence[tuple[int, int]], progress: Progress
) -> list[StepTime]:
    found = []
    settings = [(count, *size) for count in counts for size in sizes]
    for k, (count, width, height) in enumerate(settings):
        progress(k / len(settings), f"{count:,} Gaussians at {width}×{height}")
        try:
            found.append(_time(adapter, count, width, height))
        except GpuError as error:
            found.append(StepTime(count, width, height, None, {}, 0, str(error)))
    return found


def _time(adapter: Adapter, count: int, width: int, height: int) -> StepTime:
    """The mean of `REPEATS` steps, without the time of uploads, on a card that holds nothing else."""
    card = Card.open(adapter, timed=True)
    canvas, values = Canvas(card), arrays_of(make_orchard_like(count))
    columns = 11 + 3 * (SH_DEGREE + 1) ** 2
    zeros = {name: np.zeros_like(value) for name, value in values.items()}
    learnt = Learnt(values, zeros, zeros, np.zeros(count, np.int32), np.zeros((count, 2), np.float32))
    photo = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    view = view_of(look_ahead(width, height), DrawRules(sh_degree=SH_DEGREE), count)
    view["with_mean_gradients"], view["rates"] = 1, 1e-6
    view["l1_weight"], view["ssim_weight"] = 0.8 / (3 * width * height), 0.2 / (3 * width * height)
    canvas.compute(values, view)  # makes room for the pairs
    canvas.put(learnt)
    buffer = card.upload("photo", pack_photo(photo, None))
    canvas.learn(view, buffer, columns=columns)
    card.download("plan", np.uint32, 1)
    begun = time.perf_counter()
    for _ in range(REPEATS):
        work = canvas.learn(view, buffer, columns=columns)
    card.download("plan", np.uint32, 1)
    seconds = (time.perf_counter() - begun) / REPEATS
    found = StepTime(count, width, height, seconds, work.shares(), card.bytes)
    card.close()
    return found


def _count_sample(adapter: Adapter, scene_folder: Path, progress: Progress) -> list[Counted]:
    """Count the scene on the CPU and on the card."""
    found = []
    for k, device in enumerate(("cpu", adapter.name)):
        config = Config(train=replace(PRESETS["quick"], device=device))
        with tempfile.TemporaryDirectory() as folder:
            result = count_scene(
                scene_folder, ["apple"], Path(folder), config=config, progress=part(progress, 0.5 * k, 0.5 * k + 0.5)
            )
            counted, training = result.fruit_count, result.origin["training"]
            truth = read_truth(scene_folder / "truth.json", {"apple"})
            f1 = count_metrics(counted.centers, counted.diameters, truth).f1
        found.append(Counted(training["device"], training["psnr"], f1, counted.count, result.seconds["train"]))
    return found


def page(report: Mapping[str, Any]) -> str:
    """The report in Markdown."""
    adapter, repeats = report["adapter"], report["repeats"]
    kind = "played by the CPU" if adapter["software"] else "a real card"
    errors = [["", *report["errors"]["card"]]]
    errors += [[name, *(f"{error:.1e}" for error in found.values())] for name, found in report["errors"].items()]
    steps = [["Gaussians", "pixels", "ms a step", "ms a stage", "MiB on the card"]]
    steps += [
        [
            f"{each['gaussians']:,}",
            f"{each['width']}×{each['height']}",
            each["reason"] if each["seconds"] is None else f"{1e3 * each['seconds']:.2f}",
            ", ".join(f"{name} {1e3 * share * each['seconds']:.2f}" for name, share in each["shares"].items()),
            f"{math.ceil(each['bytes'] / 2**20)}",
        ]
        for each in report["steps"]
    ]
    lines = [
        f"# {adapter['name']}",
        f"{adapter['backend']}, {adapter['driver']}, {kind}. {report['system']['platform']}",
        "## Values and gradients",
        f"Largest difference from the float64 reference, of its largest value. Allowed: {BOUND:g}. "
        + ("**Right.**" if report["right"] else "**Wrong.**"),
        markdown(errors),
        "## Bytes",
        f"Trained on: {repeats['device']}. A second training gives the same bytes: {_yes(repeats['again'])}. One that "
        f"was interrupted and resumed: {_yes(repeats['resumed'])}.",
        "## A step of training",
        markdown(steps),
    ]
    if report["sample"]:
        counted = [["trained on", "PSNR/dB", "F1", "count", "training/s"]]
        counted += [
            [each["device"], f"{each['psnr']:.2f}", f"{each['f1']:.3f}", str(each["count"]), f"{each['training']:.1f}"]
            for each in report["sample"]
        ]
        lines += ["## The sample, preset quick", markdown(counted)]
    return "\n\n".join(lines) + "\n"


def _yes(value: bool) -> str:
    return "yes" if value else "**no**"
