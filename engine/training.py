"""Posed photos → Gaussians, cached: of a whole scene at once, or of a long walk section by section."""

from __future__ import annotations

import dataclasses
import json
import shutil
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .config import Config, TrainConfig, select_decisive
from .counting.accounts.zero import Quality
from .language.features.embedder import Embedder
from .language.features.features import save_features
from .language.features.joint import judge_channels
from .memory import require_memory
from .progress import Progress, part
from .result_folder import SPOOL
from .scene.alignment import Similarity
from .scene.camera import Camera, Scene
from .scene.formats.cameras_json import dump_cameras, read_cameras
from .scene.walk import SECTION_PHOTOS, Walk, cut_walk
from .splatting.gaussians import Gaussians, concatenate, transform_gaussians
from .splatting.gpu.adapters import Adapter
from .splatting.ply import read_ply, write_ply
from .splatting.training.schedule import grow_settings
from .splatting.training.train import CPU, Watch, train
from .storage.files import write_text
from .storage.keys import stage_key

GAUSSIANS, FEATURES, CAMERAS = "gaussians.ply", "features.safetensors", "cameras.json"
RECORD = "training.json"
QUALITIES = ("psnr", "ssim", "reduced_psnr", "reduced_ssim")
"""Numbers of `ViewScore` in the results of a training, of every held-out photo and as means."""


class RunLog:
    """What happened in a run: seconds by stage, reused stages, and messages for the user."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.reused: list[str] = []
        self.notices: list[str] = []

    @contextmanager
    def time_stage(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


@dataclass(frozen=True, eq=False)
class Run:
    """What all stages of a run share.

    cache: the folder of the outputs of stages; given: settings ("train.steps") that the user gave, whatever their
    value, None if that is not known; watch: receives the Gaussians during training; adapter, without_card: the graphics
    card, None for the CPU, and why it is the CPU (see `adapter_for`).
    """

    cache: Path
    embedder: Embedder
    config: Config
    given: Collection[str] | None = None
    watch: Watch | None = None
    adapter: Adapter | None = None
    without_card: str = ""
    log: RunLog = field(default_factory=RunLog)

    @property
    def device(self) -> tuple[str, ...]:
        """The part of keys that a graphics card adds: its rounding differs from that of the CPU."""
        return () if self.adapter is None else (self.adapter.identity,)


@dataclass(frozen=True)
class Trained:
    """The output of training: its folder, the key that names it, and the results for the provenance."""

    folder: Path
    key: str
    results: Mapping[str, Any]


def train_scene(scene: Scene, inputs: str, run: Run, progress: Progress) -> Trained:
    """Return the Gaussians of a scene's photos, from the cache if they are there. A long walk is trained in sections.

    inputs: hash of what the scene was read from.

    Raises:
        ConfigError: memory does not suffice, or `scene.sections` asks for more than there are.
        TrainingError, SceneError, OutputError, Cancelled: as `train`.
    """
    embedder, config = run.embedder, run.config
    # The up direction does not affect training, only where a walk is cut.
    settings = dataclasses.replace(config.scene, up=None), select_decisive(config.train)
    key = stage_key(("scene", "splatting", "compiled", "training"), inputs, *settings, *run.device)
    if embedder.trains:
        key = stage_key(("scene", "splatting", "language", "compiled"), key, embedder.key)
    with run.log.time_stage("train"):
        walk = cut_walk(scene, photos=SECTION_PHOTOS, sections=config.scene.sections)
        if walk is not None and embedder.trains:
            run.log.notices.append("features are trained along, so the walk was not cut into sections")
            walk = None
        if walk is not None:
            key = stage_key((), key, *(f"{section.low} {section.photos.tolist()}" for section in walk.sections))
        folder = run.cache / f"train-{key}"
        results = _read(folder)
        if results is not None:
            run.log.reused += ["train", "embed"] if embedder.trains else ["train"]
        elif walk is not None:
            results = _train_walk(folder, scene, walk, run, progress)
        else:
            longer = _change_settings(run, grow_settings(config.train, scene.cameras, len(scene.cameras)))
            require_memory(longer.config.train.max_gaussians, longer.config, scene.cameras, trained=True)
            results = _train_into(folder, scene, longer, progress)
        _report(results, run)
    return Trained(folder, key, results)


def _report(results: Mapping[str, Any], run: Run) -> None:
    """What the user should know of a training."""
    sections = results.get("sections", [results])
    stopped = [each["device"] for each in sections if each.get("device", CPU) not in (CPU, *run.device)]
    if run.without_card:
        run.log.notices.append(run.without_card)
    elif stopped:
        run.log.notices.append(f"the graphics card did not train to the end: {stopped[0]}")
    for number, each in enumerate(sections, start=1):
        quality = Quality.of(each)
        if quality.poor:
            of = f" of section {number} of {len(sections)} (from {each['first']} on)" if "first" in each else ""
            run.log.notices.append(
                f"held-out photos{of} are reproduced poorly ({quality}): the cameras and the "
                "count may be wrong. Check the pictures, and take more photos in smaller steps"
            )


def _train_walk(folder: Path, scene: Scene, walk: Walk, run: Run, progress: Progress) -> dict[str, Any]:
    """Train a walk section by section, each cached on its own, and join the sections; returns the results.

    Every Gaussian is of the section in whose cell its centre lies, and every camera of the one in whose cell it looks.
    """
    config, count = run.config, len(walk.sections)
    scenes = [scene.of_views(section.photos) for section in walk.sections]
    runs = [_lengthen(each, run) for each in scenes]
    for alone, seen in zip(runs, scenes, strict=True):
        require_memory(alone.config.train.max_gaussians, config, seen.cameras, trained=True)
    folders = [folder.with_name(f"{folder.name}-{number}") for number in range(1, count + 1)]
    gaussians, results, cameras = list[Gaussians](), list[dict[str, Any]](), list(scene.cameras)
    for number, (section, own) in enumerate(zip(walk.sections, folders, strict=True)):
        share = _prefix_messages(
            part(progress, number / count, (number + 1) / count), f"section {number + 1} of {count}: "
        )
        trained_alone = _read(own) or _train_into(own, scenes[number], runs[number], share)
        found, posed = read_ply(own / GAUSSIANS), read_cameras(own / CAMERAS).cameras
        if config.train.refine_poses:
            found, posed = _anchor_section(found, posed, scenes[number].cameras)
        gaussians.append(found.select(torch.from_numpy(walk.cells(found.means.double().numpy()) == number)))
        owned = np.flatnonzero(walk.owners[section.photos] == number)
        for view in owned:
            cameras[section.photos[view]] = posed[view]
        names = [scenes[number].images[view].name for view in owned]
        held_out = [each for each in trained_alone["held_out"] if each["view"] in names]
        results.append({**trained_alone, "first": names[0], "held_out": held_out})
    joined = concatenate(gaussians)
    require_memory(len(joined), config, scene.cameras, trained=False)
    write_ply(folder / GAUSSIANS, joined)
    write_text(folder / CAMERAS, dump_cameras(dataclasses.replace(scene, cameras=cameras)))
    together = _combine_results(results, len(joined))
    write_text(folder / RECORD, json.dumps(together))
    for own in folders:
        shutil.rmtree(own, ignore_errors=True)
    return together


def _lengthen(section: Scene, run: Run) -> Run:
    """Return the run with as many steps and Gaussians more as a section has photos more than usual, because others
    overlap, and as large photos need."""
    train = grow_settings(run.config.train, section.cameras)
    more = max(len(section.cameras) / SECTION_PHOTOS, 1.0)
    longer = dataclasses.replace(
        train, steps=round(more * train.steps), max_gaussians=round(more * train.max_gaussians)
    )
    return _change_settings(run, longer)


def _change_settings(run: Run, train: TrainConfig) -> Run:
    """Return the run with other settings of training."""
    return dataclasses.replace(run, config=dataclasses.replace(run.config, train=train))


def _anchor_section(
    gaussians: Gaussians, posed: Sequence[Camera], given: Sequence[Camera]
) -> tuple[Gaussians, Sequence[Camera]]:
    """Bring a section whose cameras were refined back to the frame of the given ones, which all sections share: refined
    cameras drift together. The turn is the mean of those of all cameras (chordal; Hartley et al. 2013), which two
    places or a straight line of them do not determine. Colours keep their directions: it is a fraction of a degree."""
    turns = [
        one.world_to_camera[:3, :3].T @ other.world_to_camera[:3, :3] for one, other in zip(given, posed, strict=True)
    ]
    left, _, right = np.linalg.svd(np.sum(turns, axis=0))
    rotation = (left * [1.0, 1.0, np.linalg.det(left @ right)]) @ right
    source, target = (np.array([camera.center for camera in each]) for each in (posed, given))
    spread = float(np.linalg.norm(source - source.mean(axis=0)))
    scale = float(np.linalg.norm(target - target.mean(axis=0))) / spread if spread else 1.0
    moved = Similarity(scale, rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0))
    return transform_gaussians(gaussians, moved), [_transform_camera(camera, moved) for camera in posed]


def _transform_camera(camera: Camera, moved: Similarity) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = camera.world_to_camera[:3, :3] @ moved.rotation.T
    pose[:3, 3] = -pose[:3, :3] @ moved.apply(camera.center)
    return dataclasses.replace(camera, world_to_camera=pose)


def _read(folder: Path) -> dict[str, Any] | None:
    """The results of a training that is finished in this folder."""
    if not (folder / RECORD).is_file() or not (folder / GAUSSIANS).is_file():
        return None
    stored: dict[str, Any] = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    return stored


def _prefix_messages(progress: Progress, name: str) -> Progress:
    """Return the same progress with messages that begin with a name."""
    return lambda share, text: progress(share, name + text)


def _combine_results(sections: Sequence[Mapping[str, Any]], gaussians: int) -> dict[str, Any]:
    """Combine the results of a walk: sums of its sections, means over all held-out photos, and the sections
    themselves."""
    held_out = [view for section in sections for view in section["held_out"]]
    mean = {name: _round(np.mean([view[name] for view in held_out]) if held_out else None) for name in QUALITIES}
    kept = ("first", "steps", "gaussians", "device", *QUALITIES)
    return {
        "steps": sum(section["steps"] for section in sections),
        "gaussians": gaussians,
        "device": sections[0]["device"],
        **mean,
        "held_out": held_out,
        "sections": [{name: section[name] for name in kept} for section in sections],
    }


def _train_into(folder: Path, scene: Scene, run: Run, progress: Progress) -> dict[str, Any]:
    """Train Gaussians, with features if they are trained jointly; returns the training results."""
    checkpoint, embedder, config = folder / "checkpoint.safetensors", run.embedder, run.config
    if embedder.trains:
        views = embedder.views(scene, run.cache, progress=part(progress, 0.0, 0.3))
        semantics = embedder.prepare(scene, views, run.cache / SPOOL, progress=part(progress, 0.3, 0.4))
        extra, progress = semantics.channels(config.embed), part(progress, 0.4, 1.0)
    else:
        views, semantics, extra = None, None, None
    training = train(
        scene, config.train, checkpoint=checkpoint, extra=extra, adapter=run.adapter, watch=run.watch, progress=progress
    )
    if semantics is not None and views is not None:
        features = judge_channels(semantics, training.channels, training.gaussians, training.cameras, views)
        save_features(folder / FEATURES, features.of(training.gaussians.means))
    write_ply(folder / GAUSSIANS, training.gaussians)
    write_text(folder / CAMERAS, dump_cameras(dataclasses.replace(scene, cameras=training.cameras)))
    results = {
        "steps": training.steps,
        "gaussians": len(training.gaussians),
        "device": training.device,
        **{name: _round(training.mean_score(name)) for name in QUALITIES},
        "held_out": [
            {"view": view.name, **{name: _round(getattr(view, name)) for name in QUALITIES}}
            for view in training.held_out
        ],
    }
    write_text(folder / RECORD, json.dumps(results))
    checkpoint.unlink(missing_ok=True)
    return results


def _round(value: float | None) -> float | None:
    return None if value is None else round(float(value), 4)
