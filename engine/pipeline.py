"""The whole chain: photos → cameras → Gaussians → features → probability → fruits → files.

The command line and Blender's operators call `count_scene`. Training and lifting are kept in `OUT/cache/` under the
hash of their inputs, settings and code, so a second prompt reuses them. The files of a result are made in a folder of
their own and put in place at the end, fruits.json last.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from .cache import stage_key
from .config import Config
from .counting.count import count_fruit
from .counting.fruit import FruitCount
from .errors import ConfigError, FruitLangsError, OutputError
from .files import file_hash, require_writable, write_text
from .language.encoders import Encoder, open_encoder
from .language.lift import Features, encode_photos, lift_features, load_features, save_features
from .language.relevancy import check_prompts, relevancy
from .language.vocabulary import parse
from .progress import Progress, part, silent
from .report.meshes import write_glb, write_points_ply
from .report.pictures import write_strips
from .report.provenance import run_stamp, versions
from .report.results import BLEND, FRUITS_JSON, dump, fruits_document, read_results, set_id
from .report.tables import fruits_csv
from .scene.camera import Scene
from .scene.photo import FilePhoto
from .scene.source import Source, photos_alone, pose_photos, posed_before
from .scene.stored import dump_cameras, read_cameras
from .splatting.borrowed import PLACED, borrow, drawn_again
from .splatting.gaussians import Gaussians
from .splatting.ply import read_ply, write_ply
from .splatting.train import train

GAUSSIANS, FEATURES, CAMERAS, PICTURES = "gaussians.ply", "features.safetensors", "cameras.json", "pictures"
_DAY = 86_400.0


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Everything about a scene that does not depend on the prompt, with the files that hold it.

    origin: what went in (source path, hash of the inputs, encoder) and what training reached, for the provenance.
    """

    scene: Scene
    gaussians: Gaussians
    features: Features
    gaussians_file: Path
    features_file: Path
    cameras_file: Path
    config: Config
    origin: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Result:
    """What a run leaves in memory beside its files.

    probability: (N,) that a Gaussian belongs to the prompt; seconds by stage; reused: stages that an earlier run had
    done; notices: what the user should know though the run went well; set_id names this set of result files; files:
    their paths, fruits.json last.
    """

    scene: Scene
    gaussians: Gaussians
    features: Features
    probability: Tensor
    fruit_count: FruitCount
    origin: Mapping[str, Any]
    config: Config
    seconds: Mapping[str, float]
    reused: Sequence[str]
    notices: Sequence[str]
    out: Path
    set_id: str = ""
    files: Sequence[Path] = ()


Writer = Callable[[Path, Result], None]
"""Writes one more file of the result from what is in memory, for example Blender's scene.blend."""


class _Stages:
    """The log of a run: seconds by stage, which stages an earlier run had done, and what the user should know."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.reused: list[str] = []
        self.notices: list[str] = []

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def count_scene(
    source: Path,
    prompts: Sequence[str],
    out: Path,
    *,
    negatives: Sequence[str] = (),
    config: Config = Config(),  # noqa: B008 (frozen)
    writers: Mapping[str, Writer] | None = None,
    keep: Path | None = None,
    foreign: Path | None = None,
    progress: Progress = silent,
) -> Result:
    """Count the fruit that `prompts` name in the scene at `source` and write the result folder `out`.

    Args:
        source: a COLMAP model with its images, a transforms.json or its folder, a folder of photos alone, an earlier
            result folder, or a `.ply` of Gaussians or coloured points, around which cameras are placed.
        prompts: what to count; fitting any of them is enough.
        negatives: what must not be counted, beside what the encoder contrasts by itself.
        writers: more files to write, by name; `scene.blend` comes from the caller, because the engine knows no Blender.
        keep: a file that stays although it belongs to the earlier result, such as the .blend a person has open.
        foreign: a `.ply` of Gaussians or coloured points in the frame of the scene's cameras; nothing is trained then.

    Raises:
        OutputError: among others, `out` is the folder of the photos: it would be taken for a result from then on.
        FruitLangsError: something the user can act on; earlier results in `out` are then as they were.
        Cancelled: `progress` asked for it; finished stages and the last checkpoint stay in `out/cache`.
    """
    encoder = open_encoder(config.embed)
    check_prompts(encoder, prompts, negatives)  # a word that cannot be answered must not cost a training run
    stages = _Stages()
    if foreign is not None:
        _check_foreign(source, foreign, out)
    if (source / FRUITS_JSON).is_file():
        made = _reopen(source, out, encoder, config, stages)
        require_writable(out / "cache")
    elif out.resolve() == (source.parent if source.is_file() else source).resolve():
        raise OutputError(f"{out} is the folder of the scene itself; choose another folder for the results")
    elif foreign is not None or source.suffix.lower() == ".ply":
        made = _adopt(source, foreign, out / "cache", encoder, config, stages, part(progress, 0.0, 0.9))
    else:
        made = _reconstruct(source, out / "cache", encoder, config, stages, part(progress, 0.0, 0.9))
    with stages.timed("count"):
        probability = relevancy(made.features, encoder, prompts, negatives)
        fruit_count = count_fruit(
            made.gaussians,
            probability,
            made.scene.cameras,
            config.count,
            label=_label(prompts),
            progress=part(progress, 0.9, 0.97),
        )
    result = Result(
        scene=made.scene,
        gaussians=made.gaussians,
        features=made.features,
        probability=probability,
        fruit_count=fruit_count,
        origin={**made.origin, "prompts": list(prompts), "negatives": list(negatives)},
        config=made.config,
        seconds=stages.seconds,
        reused=stages.reused,
        notices=stages.notices,
        out=out,
    )
    progress(0.97, "writing results")
    result = _publish(result, made, writers or {}, keep, stages)
    progress(1.0, "done")
    return result


def _label(prompts: Sequence[str]) -> str:
    """What the counted things are called: "Apples" → "apple"; several prompts are joined."""
    return " or ".join(dict.fromkeys(parse(prompt).text for prompt in prompts))


def _reconstruct(
    source: Path, cache: Path, encoder: Encoder, config: Config, stages: _Stages, progress: Progress
) -> Reconstruction:
    """Photos → Gaussians → features, each from the cache where it is there."""
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
    train_key = stage_key(("scene", "splatting"), inputs, config.scene, config.train)
    gaussians_file = cache / f"train-{train_key}" / GAUSSIANS
    with stages.timed("train"):
        quality = _train_into(gaussians_file, scene, config, stages, part(progress, 0.03, 0.75))
        cameras_file = gaussians_file.with_name(CAMERAS)
        scene = dataclasses.replace(scene, cameras=read_cameras(cameras_file).cameras)
        # Read back even when just trained: the first prompt must see what later ones will.
        gaussians = read_ply(gaussians_file)
    features_file = _embed_into(cache, train_key, scene, gaussians, encoder, config, stages, part(progress, 0.75, 1.0))
    origin = {
        "source": str(source.resolve()),
        "inputs_sha256": inputs,
        "encoder": encoder.identity,
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


def _adopt(
    source: Path,
    foreign: Path | None,
    cache: Path,
    encoder: Encoder,
    config: Config,
    stages: _Stages,
    progress: Progress,
) -> Reconstruction:
    """A foreign reconstruction → features, from the photos at `source` or, where it is `source`, pictures of itself."""
    with stages.timed("scene"):
        given = Source(path=source)
        scene = None if foreign is None else _read_photos(given, config, stages, part(progress, 0.0, 0.03))
        inputs = "" if foreign is None else given.hash()
    require_writable(cache)
    with stages.timed("borrow"):
        borrowed = borrow(foreign or source, scene, inputs, config.scene, cache)
    stages.notices += borrowed.notices
    if borrowed.reused:
        stages.reused.append("borrow")
    features_file = _embed_into(
        cache, borrowed.key, borrowed.scene, borrowed.gaussians, encoder, config, stages, part(progress, 0.1, 1.0)
    )
    return Reconstruction(
        scene=borrowed.scene,
        gaussians=borrowed.gaussians,
        features=load_features(features_file),
        gaussians_file=borrowed.gaussians_file,
        features_file=features_file,
        cameras_file=borrowed.cameras_file,
        config=config,
        origin={
            "source": str(source.resolve()),
            "inputs_sha256": inputs or borrowed.record["sha256"],
            "encoder": encoder.identity,
            "training": {"steps": 0, "gaussians": len(borrowed.gaussians), "psnr": None, "ssim": None, "held_out": []},
            "foreign": borrowed.record,
        },
    )


def _check_foreign(source: Path, foreign: Path, out: Path) -> None:
    """Raise where a foreign reconstruction has no place: one is there already, or the result would overwrite it."""
    if (source / FRUITS_JSON).is_file() or source.suffix.lower() == ".ply":
        raise ConfigError(f"{source} holds its own Gaussians; with --gaussians give the photos and cameras as SCENE")
    if foreign.resolve().parent == out.resolve():
        raise OutputError(f"{out} is the folder of {foreign.name} itself; choose another folder for the results")


def _read_photos(source: Source, config: Config, stages: _Stages, progress: Progress) -> Scene:
    """The posed photos of `source`; notes where they are read smaller than they are."""
    scene = source.read(config.scene, progress=progress)
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
    encoder: Encoder,
    config: Config,
    stages: _Stages,
    progress: Progress,
) -> Path:
    """The file of the features that the photos lend the Gaussians, which `key` names; made unless it is there."""
    embed_key = stage_key(("language", "splatting"), key, encoder.identity, config.embed)
    features_file = cache / f"embed-{embed_key}" / FEATURES
    with stages.timed("embed"):
        if features_file.is_file():
            stages.reused.append("embed")
        else:
            lifted = lift_features(
                gaussians,
                scene.cameras,
                encode_photos(scene, encoder),
                encoder_id=encoder.identity,
                progress=progress,
            )
            save_features(features_file, lifted)
    return features_file


def _train_into(
    gaussians_file: Path, scene: Scene, config: Config, stages: _Stages, progress: Progress
) -> Mapping[str, Any]:
    """Train unless `gaussians_file` and its record are there; returns what training reached."""
    record = gaussians_file.with_name("training.json")
    if record.is_file() and gaussians_file.is_file():
        stages.reused.append("train")
        return json.loads(record.read_text(encoding="utf-8"))
    checkpoint = gaussians_file.with_name("checkpoint.safetensors")
    training = train(scene, config.train, checkpoint=checkpoint, progress=progress)
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


def _reopen(folder: Path, out: Path, encoder: Encoder, config: Config, stages: _Stages) -> Reconstruction:
    """An earlier result folder: its Gaussians and features as they are, its photos where they still are."""
    with stages.timed("scene"):
        document = read_results(folder)
        stored = Config.from_document(document["config"])
        for name in ("scene", "photos", "train", "embed"):
            asked = getattr(config, name)
            if asked not in (getattr(stored, name), getattr(Config(), name)):
                raise ConfigError(
                    f"{folder} was made with other {name} settings; to use new ones give the photos' folder as SCENE"
                )
        gaussians_file, features_file = folder / GAUSSIANS, folder / FEATURES
        features = load_features(features_file)
        if features.encoder_id != encoder.identity:
            raise ConfigError(
                f"{features_file} is of encoder {features.encoder_id}, not {encoder.identity}; "
                "give the folder of the photos as SCENE to embed it anew"
            )
        scene = read_cameras(folder / CAMERAS)
        kept = ("source", "inputs_sha256", "encoder", "training", "foreign")
        origin = {key: document["provenance"][key] for key in kept if key in document["provenance"]}
        gaussians = read_ply(gaussians_file)
        source = Path(origin["source"])
        # From here on photos are only looked at: without them the result lacks its pictures and nothing else.
        with suppress(FruitLangsError):
            if origin.get("foreign", {}).get("cameras") == PLACED:
                scene = drawn_again(gaussians, scene)
            else:
                photos, found = photos_alone(source), Source(path=source)
                if photos is not None:
                    found = posed_before(photos, folder / "cache", out / "cache", stored.photos)
                if found.hash() == origin["inputs_sha256"]:
                    scene = found.read(stored.scene)
        if not scene.images:
            stages.notices.append(f"the photos at {source} are gone or have changed: no pictures were made")
    stages.reused += ["train", "embed"]
    return Reconstruction(
        scene=scene,
        gaussians=gaussians,
        features=features,
        gaussians_file=gaussians_file,
        features_file=features_file,
        cameras_file=folder / CAMERAS,
        config=dataclasses.replace(stored, count=config.count),
        origin=origin,
    )


def _publish(
    result: Result, made: Reconstruction, writers: Mapping[str, Writer], keep: Path | None, stages: _Stages
) -> Result:
    """Make every file in a staging folder, then move the set into place, fruits.json last."""
    staging = result.out / "cache" / f"publish-{os.getpid()}"
    _remove_dead(staging)
    (staging / PICTURES).mkdir(parents=True)
    try:
        with stages.timed("report"):
            hashed = _write_set(staging, result, made)
            files = {name: file_hash(staging / name) for name in hashed}
            result = dataclasses.replace(result, set_id=set_id(files))
            for name, write in writers.items():
                write(staging / name, result)
        document = fruits_document(
            result.fruit_count,
            config=dataclasses.asdict(made.config),
            provenance={**result.origin, "versions": versions(), **run_stamp(stages.seconds)},
            files=files,
            unhashed_files=list(writers),
            metres_per_unit=result.scene.metres_per_unit,
        )
        write_text(staging / FRUITS_JSON, dump(document))
        names = [*hashed, *writers, FRUITS_JSON]
        _move_into_place(staging, result.out, names, keep)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{result.out} cannot be written ({reason}); free space or choose another --out") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return dataclasses.replace(result, files=[result.out / name for name in names])


def _write_set(folder: Path, result: Result, made: Reconstruction) -> list[str]:
    """Write the files whose bytes follow from the inputs alone; returns their names."""
    shutil.copyfile(made.gaussians_file, folder / GAUSSIANS)
    shutil.copyfile(made.features_file, folder / FEATURES)
    shutil.copyfile(made.cameras_file, folder / CAMERAS)
    csv = fruits_csv(result.fruit_count, metres_per_unit=result.scene.metres_per_unit)
    write_text(folder / "fruits.csv", csv)
    write_glb(folder / "fruits.glb", result.fruit_count, result.scene.up)
    write_points_ply(folder / "fruits.ply", result.fruit_count)
    pictures = write_strips(
        folder / PICTURES, result.scene, result.gaussians, result.features, result.probability, result.fruit_count
    )
    names = [GAUSSIANS, FEATURES, CAMERAS, "fruits.csv", "fruits.glb", "fruits.ply"]
    return names + [f"{PICTURES}/{path.name}" for path in pictures]


def _remove_dead(staging: Path) -> None:
    """Remove the staging folders that killed runs left: this process's own, and any that nobody wrote to for a day."""
    for folder in staging.parent.glob("publish-*"):
        with suppress(FileNotFoundError):
            if folder == staging or time.time() - folder.stat().st_mtime > _DAY:
                shutil.rmtree(folder, ignore_errors=True)


def _move_into_place(staging: Path, out: Path, names: Sequence[str], keep: Path | None) -> None:
    """Replace the old set by the new one; what the new set does not have is removed, so that no old picture remains.

    A scene.blend goes only where the old fruits.json lists it: another one is the user's own.
    """
    (out / PICTURES).mkdir(exist_ok=True)
    stale = [path for path in (out / PICTURES).glob("view_*.png") if f"{PICTURES}/{path.name}" not in names]
    blend = out / BLEND
    if BLEND not in names and _lists_blend(out) and (keep is None or keep.resolve() != blend.resolve()):
        stale.append(blend)
    for path in stale:
        path.unlink(missing_ok=True)
    for name in names:
        os.replace(staging / name, out / name)


def _lists_blend(out: Path) -> bool:
    """Whether the result in `out`, if there is a sound one, wrote its scene.blend itself."""
    with suppress(FruitLangsError):
        return BLEND in read_results(out, verify=False).get("unhashed_files", ())
    return False
