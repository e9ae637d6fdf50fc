"""Everything about a scene before any prompt: photos → cameras → Gaussians → features, each cached and reused."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .cache import stage_key
from .config import Config, EmbedConfig, SceneConfig
from .errors import ConfigError, FruitLangsError, OutputError
from .files import require_writable, write_text
from .language.features.embedder import Embedder, portable
from .language.features.features import Features, load_features, save_features
from .language.features.joint import judged
from .progress import Progress, part
from .report.results import FRUITS_JSON, read_results, source_of
from .scene.camera import Scene
from .scene.formats.cameras_json import dump_cameras, read_cameras
from .scene.photos.photo import FilePhoto
from .scene.scale import scale_by_length
from .scene.source import Source, photos_alone, pose_photos, posed_before
from .splatting.gaussians import Gaussians
from .splatting.imported.imported_gaussians import PLACED, import_gaussians, rendered_again
from .splatting.ply import read_ply, write_ply
from .splatting.training.train import Watch, train

POOR = 0.4
"""Held-out SSIM below which Gaussians show little more than a blur; the paper's worst scan has .527."""
GAUSSIANS, FEATURES, CAMERAS = "gaussians.ply", "features.safetensors", "cameras.json"
FORMER_IMPORTED = "foreign"
"""Key of `provenance.imported` in results of earlier versions."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Everything about a scene that does not depend on the prompt, with its files.

    origin: inputs (source path, hash, encoder) and training results, for the provenance.
    """

    scene: Scene
    gaussians: Gaussians
    features: Features
    gaussians_file: Path
    features_file: Path
    cameras_file: Path
    config: Config
    origin: Mapping[str, Any]


class Stages:
    """The log of a run: seconds by stage, reused stages, and messages for the user."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.reused: list[str] = []
        self.notices: list[str] = []

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def reconstruct(
    source: Path,
    cache: Path,
    embedder: Embedder,
    config: Config,
    stages: Stages,
    progress: Progress,
    watch: Watch | None = None,
) -> Reconstruction:
    """Photos → Gaussians → features, each from the cache if it is there; `watch` receives the Gaussians during
    training."""
    found, start = Source(path=source), 0.0
    photos = photos_alone(source)
    if photos is not None:
        start = 0.4
        with stages.timed("photos"):
            found = pose_photos(photos, cache, config.photos, progress=part(progress, 0.0, start))
        stages.notices += found.notices
        stages.reused += ["photos"] if found.reused else []
    progress = part(progress, start, 1.0)
    with stages.timed("scene"):
        scene = _read_photos(found, config, stages, part(progress, 0.0, 0.03))
        inputs = found.hash()
    require_writable(cache)
    # The up direction does not affect training.
    train_key = stage_key(("scene", "splatting"), inputs, dataclasses.replace(config.scene, up=None), config.train)
    if embedder.trains:
        train_key = stage_key(("language",), train_key, embedder.key)
    gaussians_file = cache / f"train-{train_key}" / GAUSSIANS
    with stages.timed("train"):
        training = part(progress, 0.03, 0.75)
        quality = _train_into(gaussians_file, scene, cache, embedder, config, stages, training, watch)
        if quality["ssim"] is not None and quality["ssim"] < POOR:
            stages.notices.append(
                f"held-out photos are reproduced poorly (SSIM {quality['ssim']:.2f}): the cameras and the "
                "count may be wrong. Check the pictures, and take more photos in smaller steps"
            )
        cameras_file = gaussians_file.with_name(CAMERAS)
        scene = dataclasses.replace(scene, cameras=read_cameras(cameras_file).cameras)
        # Read back even when just trained: the first prompt must use the same bytes as later ones.
        gaussians = read_ply(gaussians_file)
    if embedder.trains:
        features_file = gaussians_file.with_name(FEATURES)
    else:
        features_file = _embed_into(cache, train_key, scene, gaussians, embedder, stages, part(progress, 0.75, 1.0))
    origin = {
        "source": str(source.resolve()),
        "inputs_sha256": inputs,
        "encoder": embedder.encoder.identity,
        "training": quality,
    }
    return Reconstruction(
        scene=scene,
        gaussians=gaussians,
        features=load_features(features_file),
        gaussians_file=gaussians_file,
        features_file=features_file,
        cameras_file=cameras_file,
        config=config,
        origin=origin,
    )


def adopt(
    source: Path,
    imported: Path | None,
    cache: Path,
    embedder: Embedder,
    config: Config,
    stages: Stages,
    progress: Progress,
) -> Reconstruction:
    """An imported reconstruction → features, from the photos at `source` or, if it is `source`, from its own renders.

    Raises:
        ConfigError: features shall be trained along with Gaussians that are not trained.
    """
    if embedder.trains:
        raise ConfigError("--features joint trains with the Gaussians, and these are given. Use --features lift")
    with stages.timed("scene"):
        given = Source(path=source)
        scene = None if imported is None else _read_photos(given, config, stages, part(progress, 0.0, 0.03))
        inputs = "" if imported is None else given.hash()
    require_writable(cache)
    with stages.timed("import"):
        adopted = import_gaussians(imported or source, scene, inputs, config.scene, cache)
    stages.notices += adopted.notices
    if adopted.reused:
        stages.reused.append("import")
    features_file = _embed_into(
        cache, adopted.key, adopted.scene, adopted.gaussians, embedder, stages, part(progress, 0.1, 1.0)
    )
    return Reconstruction(
        scene=adopted.scene,
        gaussians=adopted.gaussians,
        features=load_features(features_file),
        gaussians_file=adopted.gaussians_file,
        features_file=features_file,
        cameras_file=adopted.cameras_file,
        config=config,
        origin={
            "source": str(source.resolve()),
            "inputs_sha256": inputs or adopted.record["sha256"],
            "encoder": embedder.encoder.identity,
            "training": {"steps": 0, "gaussians": len(adopted.gaussians), "psnr": None, "ssim": None, "held_out": []},
            "imported": adopted.record,
        },
    )


def check_imported(source: Path, imported: Path, out: Path) -> None:
    """Refuse an import where the source is a result with Gaussians of its own, or where the result would overwrite the
    file."""
    if (source / FRUITS_JSON).is_file() or source.suffix.lower() == ".ply":
        raise ConfigError(f"{source} holds its own Gaussians. With --gaussians give the photos and cameras as SCENE")
    if imported.resolve().parent == out.resolve():
        raise OutputError(f"{out} is the folder of {imported.name} itself. Choose another folder for the results")


def _read_photos(source: Source, config: Config, stages: Stages, progress: Progress) -> Scene:
    """The posed photos of `source`; adds a notice if they are scaled down."""
    scene = source.read(config.scene, progress=progress)
    # Photos that held-out measurement cannot read must not cost a training run.
    scale_by_length(config.units, [photo.name for photo in scene.images], scene.cameras)
    headers = [photo.header for photo in scene.images if isinstance(photo, FilePhoto)]
    largest = max((max(header.width, header.height) for header in headers), default=0)
    if 0 < config.scene.max_side < largest / config.scene.downscale:
        stages.notices.append(
            f"photos with up to {largest} pixels a side were read at {config.scene.max_side}; --scene.max-side sets it"
        )
    return scene


def _embed_into(
    cache: Path,
    key: str,
    scene: Scene,
    gaussians: Gaussians,
    embedder: Embedder,
    stages: Stages,
    progress: Progress,
) -> Path:
    """The file of the features for these Gaussians, named by `key`; computed if it does not exist."""
    embed_key = stage_key(("language", "splatting"), key, embedder.key)
    features_file = cache / f"embed-{embed_key}" / FEATURES
    with stages.timed("embed"):
        if features_file.is_file():
            stages.reused.append("embed")
        else:
            lifted = embedder.lift(gaussians, scene, cache, progress=progress)
            save_features(features_file, lifted.of(gaussians.means))
    return features_file


def _train_into(
    gaussians_file: Path,
    scene: Scene,
    cache: Path,
    embedder: Embedder,
    config: Config,
    stages: Stages,
    progress: Progress,
    watch: Watch | None,
) -> Mapping[str, Any]:
    """Train unless `gaussians_file` and its record exist, with features if they are trained jointly.

    Returns the training results.
    """
    record = gaussians_file.with_name("training.json")
    if record.is_file() and gaussians_file.is_file():
        stages.reused += ["train", "embed"] if embedder.trains else ["train"]
        return json.loads(record.read_text(encoding="utf-8"))
    checkpoint = gaussians_file.with_name("checkpoint.safetensors")
    if embedder.trains:
        views = list(embedder.views(scene, cache, progress=part(progress, 0.0, 0.3)))
        semantics = embedder.prepare(scene, views, progress=part(progress, 0.3, 0.4))
        extra, progress = semantics.channels(config.embed), part(progress, 0.4, 1.0)
    else:
        views, semantics, extra = [], None, None
    training = train(scene, config.train, checkpoint=checkpoint, extra=extra, watch=watch, progress=progress)
    if semantics is not None:
        features = judged(semantics, training.channels, training.gaussians, training.cameras, views)
        save_features(gaussians_file.with_name(FEATURES), features.of(training.gaussians.means))
    write_ply(gaussians_file, training.gaussians)
    write_text(gaussians_file.with_name(CAMERAS), dump_cameras(dataclasses.replace(scene, cameras=training.cameras)))
    quality = {
        "steps": training.steps,
        "gaussians": len(training.gaussians),
        "psnr": _rounded(training.psnr),
        "ssim": _rounded(training.ssim),
        "held_out": [
            {"view": view.name, "psnr": _rounded(view.psnr), "ssim": _rounded(view.ssim)} for view in training.held_out
        ],
    }
    write_text(record, json.dumps(quality))
    checkpoint.unlink(missing_ok=True)
    return quality


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), 4)


def reopen(folder: Path, out: Path, embedder: Embedder | None, config: Config, stages: Stages) -> Reconstruction:
    """An earlier result folder: its Gaussians and features, and its photos if they are still available.

    embedder: the one to query it with; None if it is only shown.
    """
    with stages.timed("scene"):
        document = read_results(folder)
        stored = Config.from_document(document["config"])
        for name in ("scene", "photos", "train", "embed"):
            asked, before, usual = (_fixed(getattr(each, name)) for each in (config, stored, Config()))
            if asked not in (before, usual):
                raise ConfigError(
                    f"{folder} was made with other {name} settings. "
                    "To change them, give the folder of the photos as SCENE"
                )
        gaussians_file, features_file = folder / GAUSSIANS, folder / FEATURES
        features = load_features(features_file)
        if embedder is not None and features.encoder_id != embedder.encoder.identity:
            raise ConfigError(
                f"{features_file} is of encoder {features.encoder_id}, not {embedder.encoder.identity}. "
                "Use the same --encoder, or give the folder of the photos as SCENE"
            )
        scene = _turned(read_cameras(folder / CAMERAS), config)
        kept = ("source", "inputs_sha256", "encoder", "training", "imported", "scale")
        provenance = document["provenance"]
        if FORMER_IMPORTED in provenance:
            provenance["imported"] = provenance.pop(FORMER_IMPORTED)
        origin = {key: provenance[key] for key in kept if key in provenance}
        gaussians = read_ply(gaussians_file)
        source = source_of(folder, document)
        origin["source"] = str(source)
        # From here on photos are only shown: without them the result has no pictures.
        with suppress(FruitLangsError):
            if origin.get("imported", {}).get("cameras") == PLACED:
                scene = rendered_again(gaussians, scene)
            else:
                photos, found = photos_alone(source), Source(path=source)
                if photos is not None:
                    found = posed_before(photos, folder / "cache", out / "cache", stored.photos)
                if found.hash() == origin["inputs_sha256"]:
                    photos_read = found.read(stored.scene)
                    scene = dataclasses.replace(
                        photos_read, cameras=scene.cameras, up=scene.up, metres_per_unit=scene.metres_per_unit
                    )
        if not scene.images:
            stages.notices.append(f"the photos at {source} are missing or have changed, so no pictures were made")
    stages.reused += ["train", "embed"]
    return Reconstruction(
        scene=scene,
        gaussians=gaussians,
        features=features,
        gaussians_file=gaussians_file,
        features_file=features_file,
        cameras_file=folder / CAMERAS,
        config=dataclasses.replace(
            stored,
            count=config.count,
            scene=dataclasses.replace(stored.scene, up=config.scene.up or stored.scene.up),
        ),
        origin=origin,
    )


def _fixed(settings: Any) -> Any:
    """The settings of a stage without those that may differ when an earlier result is opened again."""
    if isinstance(settings, EmbedConfig):
        return portable(settings)
    return dataclasses.replace(settings, up=None) if isinstance(settings, SceneConfig) else settings


def _turned(scene: Scene, config: Config) -> Scene:
    """The scene with the up direction from the settings, if they give one."""
    up = config.scene.up
    return scene if up is None else dataclasses.replace(scene, up=np.asarray(up) / np.linalg.norm(up))
