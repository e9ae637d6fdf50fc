"""Puts a result in place: its files are written to a staging folder and moved at the end, fruits.json last."""

from __future__ import annotations

import dataclasses
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from .config import Config
from .counting.accounts.ids import NO_FRUIT, KnownFruit
from .counting.fruit import FruitCount
from .errors import FruitLangsError, OutputError
from .files import file_hash, write_text
from .language.features.features import Features
from .reconstruction import CAMERAS, FEATURES, GAUSSIANS, Reconstruction, Stages
from .report.audit import audit_text
from .report.framing import framing
from .report.meshes import write_glb, write_points_ply
from .report.page import write_page
from .report.pictures import write_strips
from .report.provenance import run_stamp, versions
from .report.results import BLEND, FRUITS_JSON, dump, fruits_document, keep_source, read_results, set_id
from .report.selection import SELECTION, write_selection
from .report.still import draw_still, save_still
from .report.tables import fruits_csv
from .report.words import headline
from .scene.camera import Scene
from .scene.formats.cameras_json import with_scene_facts
from .splatting.gaussians import Gaussians

PICTURES = "pictures"
STILL, PAGE = "still.jpg", "report.html"
_DAY = 86_400.0


@dataclass(frozen=True, eq=False)
class Result:
    """What a run keeps in memory in addition to its files.

    probability: (N,) that a Gaussian matches the prompt; seconds: by stage; reused: stages taken from an earlier run;
    notices: messages for the user; known: fruit that earlier counts of the scene numbered; set_id: names this set of
    result files; files: their paths, fruits.json last.
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
    known: KnownFruit = NO_FRUIT
    set_id: str = ""
    files: Sequence[Path] = ()


Writer = Callable[[Path, Result], None]
"""Writes one more file of the result, for example Blender's scene.blend."""


def publish(
    result: Result, made: Reconstruction, writers: Mapping[str, Writer], keep: Path | None, stages: Stages
) -> Result:
    """Write every file to a staging folder, then move the set into place, fruits.json last."""
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
        source = Path(result.origin["source"])
        document = fruits_document(
            result.fruit_count,
            config=dataclasses.asdict(made.config),
            provenance={
                **result.origin,
                "source": source.resolve().name,
                "versions": versions(),
                **run_stamp(stages.seconds),
            },
            files=files,
            unhashed_files=list(writers),
            metres_per_unit=result.scene.metres_per_unit,
            known=result.known,
        )
        write_text(staging / FRUITS_JSON, dump(document))
        keep_source(result.out, source)
        names = [*hashed, *writers, FRUITS_JSON]
        _move_into_place(staging, result.out, names, keep)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{result.out} cannot be written ({reason}). Free space or choose another --out") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return dataclasses.replace(result, files=[result.out / name for name in names])


def _write_set(folder: Path, result: Result, made: Reconstruction) -> list[str]:
    """Write the files that depend on the inputs only; returns their names."""
    shutil.copyfile(made.gaussians_file, folder / GAUSSIANS)
    shutil.copyfile(made.features_file, folder / FEATURES)
    write_text(folder / CAMERAS, with_scene_facts(made.cameras_file, result.scene))
    csv = fruits_csv(result.fruit_count, metres_per_unit=result.scene.metres_per_unit)
    write_text(folder / "fruits.csv", csv)
    prompt = ", ".join(result.origin["prompts"])
    audit = audit_text(result.fruit_count, prompt=prompt, metres_per_unit=result.scene.metres_per_unit)
    write_text(folder / "audit.txt", audit)
    write_glb(folder / "fruits.glb", result.fruit_count, result.scene.metres_per_unit, up=result.scene.up)
    write_points_ply(folder / "fruits.ply", result.fruit_count)
    write_selection(folder / SELECTION, result.probability, result.fruit_count, result.origin)
    pictures = write_strips(
        folder / PICTURES, result.scene, result.gaussians, result.features, result.probability, result.fruit_count
    )
    _write_page(folder, result)
    names = [GAUSSIANS, FEATURES, CAMERAS, "fruits.csv", "audit.txt", "fruits.glb", "fruits.ply"]
    return names + [SELECTION, STILL, PAGE] + [f"{PICTURES}/{path.name}" for path in pictures]


def _write_page(folder: Path, result: Result) -> None:
    """The still and the report.

    Neither contains the date, seconds or the path of the photos, so equal runs give equal files.
    """
    fruit_count, metres_per_unit = result.fruit_count, result.scene.metres_per_unit
    title = headline(fruit_count, ", ".join(result.origin["prompts"]))
    camera = framing(result.scene, result.gaussians, fruit_count.fruits)
    still = draw_still(result.gaussians, fruit_count.fruits, camera, metres_per_unit=metres_per_unit, title=title)
    save_still(folder / STILL, still)
    origin = {name: value for name, value in result.origin.items() if name != "source"}
    made_with = {"notices": result.notices, **origin, "versions": versions()}
    write_page(
        folder / PAGE,
        fruit_count,
        title=", ".join(result.origin["prompts"]),
        metres_per_unit=metres_per_unit,
        still=still,
        provenance={**made_with, "config": dataclasses.asdict(result.config)},
    )


def _remove_dead(staging: Path) -> None:
    """Remove the staging folders of killed runs: those of this process, and any that was not changed for a day."""
    for folder in staging.parent.glob("publish-*"):
        with suppress(FileNotFoundError):
            if folder == staging or time.time() - folder.stat().st_mtime > _DAY:
                shutil.rmtree(folder, ignore_errors=True)


def _move_into_place(staging: Path, out: Path, names: Sequence[str], keep: Path | None) -> None:
    """Replace the old set by the new one, and remove files that the new set does not have, so that no old picture
    remains.

    A scene.blend is replaced only if the old fruits.json lists it: another one belongs to the user.
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
    """Whether the result in `out`, if it is valid, wrote its scene.blend."""
    with suppress(FruitLangsError):
        return BLEND in read_results(out, verify=False).get("unhashed_files", ())
    return False
