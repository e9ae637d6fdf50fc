"""Writes the files of a result and puts them in place together, fruits.json last."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from .config import Config
from .counting.accounts.ids import NO_FRUIT, KnownFruit
from .counting.fruit import FruitCount
from .errors import OutputError
from .language.features.features import Features
from .reconstruction import PHOTOS, Reconstruction
from .report.audit import audit_text
from .report.meshes import write_glb, write_points_ply
from .report.overview import draw_count
from .report.page import write_page
from .report.pictures import write_strips
from .report.provenance import run_stamp, versions
from .report.results import BLEND, FRUITS_JSON, dump, fruits_document, set_id
from .report.selection import SELECTION, write_selection
from .report.still import save_still
from .report.tables import fruits_csv
from .report.words import headline
from .result_folder import SOURCE, ResultFolder
from .scene.camera import Scene
from .scene.formats.cameras_json import add_scene_facts
from .splatting.gaussians import Gaussians
from .storage.files import file_hash, write_text
from .training import CAMERAS, FEATURES, GAUSSIANS, RunLog

PICTURES = "pictures"
STILL, PAGE = "still.jpg", "report.html"


@dataclass(frozen=True, eq=False)
class Result:
    """What a run keeps in memory in addition to its files.

    Attributes
    ----------
    scene : Scene
        Cameras and photos.
    gaussians : Gaussians
        N Gaussians, in the frame of the cameras.
    features : Features
        Their language features.
    probability : Tensor, (N,)
        Probability that each Gaussian matches the prompt.
    fruit_count : FruitCount
        The fruit, the count and its intervals.
    origin : mapping
        Provenance: source, prompts, hashes, encoder, training.
    config : Config
        The settings of the run.
    seconds : mapping of str to float
        Seconds by stage.
    reused : sequence of str
        Stages taken from an earlier run.
    notices : sequence of str
        Messages for the user.
    out : Path
        The result folder.
    known : KnownFruit
        Fruit that earlier counts of the scene numbered.
    set_id : str
        Name of this set of result files.
    files : sequence of Path
        The result files, fruits.json last.
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
    result: Result, made: Reconstruction, writers: Mapping[str, Writer], keep: Path | None, log: RunLog
) -> Result:
    """Write all files to a staging folder, then replace the set in `result.out`, whose lock the caller holds.

    Pictures and a scene.blend of the earlier set that the new one lacks are removed, except the file `keep`. A
    scene.blend that fruits.json does not list belongs to the user.

    Raises:
        OutputError: a file cannot be written; the earlier set is unchanged.
    """
    folder = ResultFolder(result.out)
    try:
        with folder.staging() as staging:
            with log.time_stage("report"):
                (staging / PICTURES).mkdir()
                hashed = _write_set(staging, result, made)
                files = {name: file_hash(staging / name) for name in hashed}
                result = dataclasses.replace(result, set_id=set_id(files))
                for name, write in writers.items():
                    write(staging / name, result)
            write_text(staging / SOURCE, folder.source_text(Path(result.origin["source"])))
            document = fruits_document(
                result.fruit_count,
                config=dataclasses.asdict(made.config),
                provenance={
                    **result.origin,
                    "source": Path(result.origin["source"]).name,
                    "versions": versions(),
                    **run_stamp(log.seconds),
                },
                files=files,
                unhashed_files=list(writers),
                metres_per_unit=result.scene.metres_per_unit,
                known=result.known,
                notices=result.notices,
            )
            write_text(staging / FRUITS_JSON, dump(document))
            names = [*hashed, *writers, FRUITS_JSON]
            (folder.path / PICTURES).mkdir(exist_ok=True)
            folder.replace(staging, [SOURCE, *names], _find_stale(folder, names, keep))
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{result.out} cannot be written ({reason}). Free space or choose another --out") from error
    return dataclasses.replace(result, files=[result.out / name for name in names])


def _find_stale(folder: ResultFolder, names: Sequence[str], keep: Path | None) -> list[str]:
    """Find the pictures and the scene.blend of the earlier set that the new one lacks."""
    old = [f"{PICTURES}/{path.name}" for path in (folder.path / PICTURES).glob("view_*.png")]
    blend = folder.path / BLEND
    if BLEND in folder.list_files() and (keep is None or keep.resolve() != blend.resolve()):
        old.append(BLEND)
    return [name for name in old if name not in names]


def _write_set(folder: Path, result: Result, made: Reconstruction) -> list[str]:
    """Write the files that depend on the inputs only; returns their names."""
    shutil.copyfile(made.files.gaussians, folder / GAUSSIANS)
    shutil.copyfile(made.files.features, folder / FEATURES)
    if made.files.photos is not None:
        shutil.copyfile(made.files.photos, folder / PHOTOS)
    write_text(folder / CAMERAS, add_scene_facts(made.files.cameras, result.scene))
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
    names += [] if made.files.photos is None else [PHOTOS]
    return names + [SELECTION, STILL, PAGE] + [f"{PICTURES}/{path.name}" for path in pictures]


def _write_page(folder: Path, result: Result) -> None:
    """The still and the report.

    Neither contains the date, seconds or the path of the photos, so equal runs give equal files.
    """
    fruit_count, metres_per_unit = result.fruit_count, result.scene.metres_per_unit
    title = headline(fruit_count, ", ".join(result.origin["prompts"]))
    still = draw_count(result.scene, result.gaussians, fruit_count, title=title)
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
