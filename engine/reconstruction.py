"""Everything about a scene before any prompt: photos → cameras → Gaussians → features, each cached and reused."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .config import Config, list_ineffective, select_decisive
from .counting.evidence.pixel_width import focal_length
from .errors import ConfigError, FruitLangsError, SceneError
from .language.encoders.encoder import Encoder, sees_fruit, sees_whole
from .language.features.features import Features, load_features, save_features
from .language.features.lift import record_photos
from .language.features.photo_features import (
    PhotoFeatures,
    PhotoFeaturesRecorder,
    load_photo_features,
    save_photo_features,
)
from .memory import camera_search_threads, require_memory
from .photo_size import find_scaled_down, fruit_angle, needed_bytes, photo_scales, side_to_read
from .progress import Progress, part, silent
from .result_folder import SPOOL, ResultFolder
from .scene.camera import Scene
from .scene.formats.cameras_json import read_cameras
from .scene.photos.photo import FilePhoto, read_header
from .scene.photos.spool import spool_photos
from .scene.scale import scale_by_length
from .scene.sfm.find_cameras import list_photos
from .scene.source import Source
from .splatting.gaussians import Gaussians
from .splatting.imported.imported_gaussians import PLACED, import_gaussians, render_again
from .splatting.ply import read_ply
from .storage.files import write_text
from .storage.keys import stage_key
from .training import CAMERAS, FEATURES, GAUSSIANS, Run, RunLog, train_scene

PHOTOS = "photos.safetensors"
FORMER_IMPORTED = "foreign"
"""Key of `provenance.imported` in results of earlier versions."""
ENCODING = ("scene", "language", "splatting", "compiled")
"""Packages whose code encodes photos and lifts features into Gaussians."""
FIXED = ("scene", "photos", "train", "embed")
"""Stages whose settings an earlier result keeps, except `scene.up`."""


@dataclass(frozen=True)
class Files:
    """Paths of what is stored of a reconstruction."""

    gaussians: Path
    cameras: Path
    features: Path
    photos: Path | None = None


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Everything about a scene that does not depend on the prompt, with its files.

    origin: inputs (source path, hash, encoder) and training results, for the provenance; photos: features of the
    photos' pixels, None if there are no photos, if the encoder does not distinguish fruit, or in a result of an
    earlier version.
    """

    scene: Scene
    gaussians: Gaussians
    features: Features
    files: Files
    config: Config
    origin: Mapping[str, Any]
    photos: PhotoFeatures | None = None


def reconstruct(source: Source, imported: Path | None, run: Run, progress: Progress) -> Reconstruction:
    """Photos → Gaussians → features, each from the cache if it is there.

    source: photos, with or without cameras, a video, or a .ply of an imported reconstruction, which gets cameras and
    renders for photos; imported: such a .ply in the frame of the photos' cameras. Imported Gaussians are not trained.

    Raises:
        ConfigError: features are to be trained along with Gaussians that are not trained.
    """
    path, start = source.path, 0.0
    alone = path.suffix.lower() == ".ply"
    if run.embedder.trains and (alone or imported is not None):
        raise ConfigError("--features joint trains with the Gaussians, and these are given. Use --features lift")
    if alone:
        return _import_gaussians(path, None, {"source": str(path)}, run, progress)
    if imported is None and source.is_alone():
        start = 0.4
        with run.log.time_stage("photos"):
            source = source.stills(run.cache, progress=part(progress, 0.0, 0.1))
            photos, threads = source.photos_alone(), 1
            if photos is not None and not source.has_poses(run.cache, run.config.photos):
                headers = [read_header(file) for file in list_photos(photos)]
                sizes = [(header.width, header.height) for header in headers]
                threads = camera_search_threads(sizes, run.config.photos.max_side)
            source = source.find_poses(
                run.cache, run.config.photos, threads=threads, progress=part(progress, 0.1, start)
            )
        run.log.notices += source.notices
        run.log.reused += ["photos"] if source.reused else []
    progress = part(progress, start, 1.0)
    with run.log.time_stage("scene"):
        run = read_larger(source, run, part(progress, 0.0, 0.01)) if imported is None else run
        scene = _read_photos(source, run, part(progress, 0.01, 0.03))
        inputs = {"source": str(path), "inputs_sha256": source.hash()}
    with spool_photos(scene, run.cache / SPOOL) as decoded_once:
        if imported is not None:
            made = _import_gaussians(imported, decoded_once, inputs, run, progress)
        else:
            done = train_scene(decoded_once, inputs["inputs_sha256"], run, part(progress, 0.03, 0.75))
            origin = {**inputs, "training": done.results}
            made = _load_made(done.folder, done.key, decoded_once, origin, run, part(progress, 0.75, 1.0))
    return dataclasses.replace(made, scene=dataclasses.replace(made.scene, images=scene.images))


def _read_photos(source: Source, run: Run, progress: Progress) -> Scene:
    """The posed photos of `source`; adds a notice if some are missing, or if they are scaled down."""
    config = run.config
    scene = source.read(config.scene, progress=progress)
    run.log.notices += source.open().notices
    # Photos that held-out measurement cannot read must not cost a training run.
    scale_by_length(config.units, [photo.name for photo in scene.images], scene.cameras)
    headers = [photo.header for photo in scene.images if isinstance(photo, FilePhoto)]
    largest = max((max(header.width, header.height) for header in headers), default=0)
    if 0 < config.scene.max_side < largest / config.scene.downscale:
        run.log.notices.append(
            f"photos with up to {largest} pixels a side were read at {config.scene.max_side}; --scene.max-side sets it"
        )
    return scene


def read_larger(source: Source, run: Run, progress: Progress = silent) -> Run:
    """Return the run with a larger `scene.max_side` if fruit would be too narrow and the user did not set the size.

    The decision is stored in the cache, because it depends on the free memory, and later prompts must find the same
    Gaussians.
    """
    config, encoder = run.config, run.embedder.encoder
    given = config.list_changed() if run.given is None else set(run.given)
    if {"scene.max_side", "scene.downscale"} & given or not sees_whole(encoder):
        return run
    scene = source.read(config.scene)
    reduced = find_scaled_down(scene.images)
    if not reduced:
        return run
    settings = config.scene, select_decisive(config.train)
    key = stage_key((*ENCODING, "photo_size"), source.hash(), encoder.identity, *settings)
    record = run.cache / f"size-{key}.json"
    if record.is_file():
        decided = json.loads(record.read_text(encoding="utf-8"))
    else:
        cameras = [camera for camera, photo in zip(scene.cameras, scene.images, strict=True) if photo in reduced]
        angle = fruit_angle(reduced, cameras, encoder, progress)
        width = None if angle is None else angle * float(np.median([focal_length(camera) for camera in cameras]))
        decided = {"width": width, "max_side": side_to_read(width, scene.images, scene.cameras, config)}
        write_text(record, json.dumps(decided))
    side = decided["max_side"]
    if side == config.scene.max_side:
        return run
    factor = side / config.scene.max_side
    needed = needed_bytes(side, scene.images, scene.cameras, config)
    which = "the photos" if len(reduced) == len(scene.images) else f"{len(reduced)} of {len(scene.images)} photos"
    run.log.notices.append(
        f"fruit would be about {decided['width']:.0f} pixels wide, so {which} were read larger than usual. This "
        f"needs about {needed / 2**30:.1f} GB of memory and up to "
        f"{factor**2:.1f} times the time; --scene.max-side {config.scene.max_side} prevents it"
    )
    return dataclasses.replace(
        run, config=dataclasses.replace(config, scene=dataclasses.replace(config.scene, max_side=side))
    )


def _import_gaussians(
    file: Path, scene: Scene | None, inputs: Mapping[str, str], run: Run, progress: Progress
) -> Reconstruction:
    """Import a reconstruction, with the scene's photos, or with its own renders."""
    with run.log.time_stage("import"):
        imported = import_gaussians(file, scene, inputs.get("inputs_sha256", ""), run.config.scene, run.cache)
    run.log.notices += imported.notices
    run.log.reused += ["import"] if imported.reused else []
    origin = {"inputs_sha256": imported.record["sha256"], **inputs, "imported": imported.record}
    return _load_made(imported.folder, imported.key, scene, origin, run, part(progress, 0.1, 1.0))


def _load_made(
    folder: Path, key: str, scene: Scene | None, origin: Mapping[str, Any], run: Run, progress: Progress
) -> Reconstruction:
    """Load what is in the folder of a stage, with features, and with the photos of the scene or else renders."""
    # Read back even when just made: the first prompt must use the same bytes as later ones.
    gaussians, stored = read_ply(folder / GAUSSIANS), read_cameras(folder / CAMERAS)
    kept = scene is not None and sees_fruit(run.embedder.encoder)  # renders show nothing that Gaussians leave out
    scene = dataclasses.replace(scene, cameras=stored.cameras) if scene else render_again(gaussians, stored)
    if "training" not in origin:
        require_memory(len(gaussians), run.config, scene.cameras, trained=False)
    embedded = folder / FEATURES if run.embedder.trains else _embed(key, scene, gaussians, run, progress, kept)
    photos = embedded.with_name(PHOTOS) if kept else None
    files = Files(gaussians=folder / GAUSSIANS, cameras=folder / CAMERAS, features=embedded, photos=photos)
    untrained: dict[str, Any] = {"steps": 0, "gaussians": len(gaussians), "psnr": None, "ssim": None, "held_out": []}
    origin = {
        "source": origin["source"],
        "inputs_sha256": origin["inputs_sha256"],
        "encoder": run.embedder.encoder.identity,
        "training": untrained,
        **origin,
    }
    return Reconstruction(scene, gaussians, load_features(files.features), files, run.config, origin, _photos(files))


def _photos(files: Files) -> PhotoFeatures | None:
    return None if files.photos is None else load_photo_features(files.photos)


def _embed(key: str, scene: Scene, gaussians: Gaussians, run: Run, progress: Progress, kept: bool) -> Path:
    """Return the file of the features for these Gaussians, named by `key`; computed if it does not exist. kept: with
    features of the photos' pixels, in a file next to it."""
    embed_key = stage_key(ENCODING, key, run.embedder.key, *run.device)
    features_file = run.cache / f"embed-{embed_key}" / FEATURES
    with run.log.time_stage("embed"):
        if features_file.is_file():
            run.log.reused.append("embed")
        else:
            encoder, recorder = run.embedder.encoder, None
            if kept and sees_fruit(encoder):
                recorder = PhotoFeaturesRecorder(encoder.kinds(), encoder.fruit_identity)
            scales = photo_scales(scene, encoder, part(progress, 0.0, 0.1))
            lifted = run.embedder.lift(
                gaussians, scene, run.cache, scales=scales, recorder=recorder, progress=part(progress, 0.1, 1.0)
            )
            if recorder is not None:
                save_photo_features(features_file.with_name(PHOTOS), recorder.collect())
            save_features(features_file, lifted.of(gaussians.means))
    return features_file


def reopen(
    folder: ResultFolder,
    document: dict[str, Any],
    config: Config,
    log: RunLog,
    *,
    cache: Path,
    given: Collection[str] = (),
    encoder_id: str | None = None,
) -> Reconstruction:
    """Open an earlier result: its Gaussians and features, and its photos if they are still available.

    document: its fruits.json; config, given: the settings of this run, and which of them the user gave; cache: where
    cameras that were found for its photos are kept; encoder_id: identity of the encoder that will query it, None if it
    is only shown.

    Raises:
        ConfigError: it was made with other settings than were given, or with another encoder.
        OutputError, FormatError: a file of it is damaged.
    """
    with log.time_stage("scene"):
        stored = Config.from_document(document["config"])
        _require_same(folder.path, stored, config, given)
        photos = folder.path / PHOTOS if PHOTOS in document["files"] else None
        files = Files(folder.path / GAUSSIANS, folder.path / CAMERAS, folder.path / FEATURES, photos)
        features = load_features(files.features)
        if encoder_id is not None and features.encoder_id != encoder_id:
            raise ConfigError(
                f"{files.features} is of encoder {features.encoder_id}, not {encoder_id}. "
                "Use the same --encoder, or give the folder of the photos as SCENE"
            )
        provenance = {**document["provenance"]}
        if FORMER_IMPORTED in provenance:
            provenance["imported"] = provenance.pop(FORMER_IMPORTED)
        kept = ("inputs_sha256", "encoder", "training", "imported", "scale")
        origin = {"source": str(folder.source(document)), **{key: provenance[key] for key in kept if key in provenance}}
        gaussians, scene = read_ply(files.gaussians), read_cameras(files.cameras)
        if config.scene.up is not None:
            scene = dataclasses.replace(scene, up=np.asarray(config.scene.up) / np.linalg.norm(config.scene.up))
        try:
            scene = _add_photos(scene, gaussians, origin, folder, stored, cache)
        except FruitLangsError as error:  # from here on photos are only shown
            log.notices.append(f"no pictures were made: {error}")
    log.reused += ["train", "embed"]
    settings = dataclasses.replace(
        stored,
        count=config.count,
        scene=dataclasses.replace(stored.scene, up=config.scene.up or stored.scene.up),
    )
    return Reconstruction(scene, gaussians, features, files, settings, origin, _photos(files))


def _add_photos(
    scene: Scene, gaussians: Gaussians, origin: Mapping[str, Any], folder: ResultFolder, stored: Config, cache: Path
) -> Scene:
    """Return the scene of an earlier result with its photos.

    Raises:
        SceneError: they are missing, cannot be read, or have changed.
    """
    if _was_placed(origin):
        return render_again(gaussians, scene)
    path = Path(origin["source"])
    if not path.exists():
        raise SceneError(f"The photos at {path} are missing")
    source = Source(path=path).reuse_poses(folder.cache, cache, stored.photos)
    if source.hash() != origin["inputs_sha256"]:
        missing = "".join(f" ({notice})" for notice in source.open().notices)
        raise SceneError(
            f"The photos at {path} have changed since they were counted{missing}. Count again from the photos"
        )
    photos = source.read(stored.scene)
    return dataclasses.replace(photos, cameras=scene.cameras, up=scene.up, metres_per_unit=scene.metres_per_unit)


def add_fitting_photos(
    made: Reconstruction, encoder: Encoder, cache: Path, log: RunLog, progress: Progress = silent
) -> Reconstruction:
    """Return an earlier result with features of its photos' pixels that belong to this encoder.

    Those that other weights made, or an earlier version at scales that are not known, are computed again from the
    photos, in `cache`. Without the photos the result has none, and a notice says so.

    Raises:
        SceneError: a photo cannot be read.
        OutputError: `cache` cannot be written.
    """
    if not sees_fruit(encoder) or _was_placed(made.origin):
        return made
    fitting = made.photos is not None and made.photos.are_of(encoder)
    earlier = made.photos is not None and not any(made.photos.seen_at)
    if fitting and not earlier:
        return made
    scene = made.scene
    if earlier:
        log.notices.append(
            "an earlier version made this result and encoded large photos at 960 pixels a side, whatever the width of "
            "the fruit: small fruit may be missing. Give the folder of the photos as SCENE to encode them again"
        )
    if len(scene.images) != len(scene.cameras):
        if fitting:  # and of an earlier version, which is better than none
            return made
        log.notices.append(
            "the result keeps no features of its photos that this version's networks can use, and the photos are "
            "missing: fruit that Gaussians lose were not counted. Give the folder of the photos as SCENE to count them"
        )
        return dataclasses.replace(made, files=dataclasses.replace(made.files, photos=None), photos=None)
    settings = dataclasses.replace(made.config.scene, up=None)
    key = stage_key(ENCODING, made.origin["inputs_sha256"], encoder.fruit_identity, settings)
    path = cache / f"pixels-{key}" / PHOTOS
    if not path.is_file():
        with log.time_stage("embed"):
            scales = photo_scales(scene, encoder, part(progress, 0.0, 0.1))
            save_photo_features(path, record_photos(scene, encoder, scales, progress=part(progress, 0.1, 1.0)))
    files = dataclasses.replace(made.files, photos=path)
    return dataclasses.replace(made, files=files, photos=_photos(files))


def _was_placed(origin: Mapping[str, Any]) -> bool:
    """Whether a result has no photos, because cameras were placed around imported Gaussians."""
    return bool(origin.get("imported", {}).get("cameras") == PLACED)


def _require_same(folder: Path, stored: Config, config: Config, given: Collection[str]) -> None:
    """Refuse settings that were given and differ from those of an earlier result.

    Raises:
        ConfigError: names the first of them.
    """
    free = {"scene.up", *(f"{stage}.{name}" for stage in FIXED for name in list_ineffective(getattr(config, stage)))}
    for name in sorted(set(given) - free):
        stage, _, setting = name.partition(".")
        asked, before = (getattr(getattr(each, stage), setting) for each in (config, stored))
        if stage in FIXED and asked != before:
            raise ConfigError(
                f"{folder} was made with --{stage}.{setting.replace('_', '-')} {before}, not {asked}. "
                "To change it, give the folder of the photos as SCENE"
            )
