"""Imported reconstructions: read, prepared for the rest of the pipeline, and cached under a hash of their inputs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...config import SceneConfig
from ...errors import FormatError, SceneError
from ...scene.camera import FloatArray, Scene
from ...scene.formats.cameras_json import dump_cameras
from ...storage.files import file_hash, write_text
from ...storage.keys import stage_key
from ..gaussians import Gaussians
from ..ply import write_ply
from .frame_check import Fit, measure_fit
from .read_ply import ImportedPly, read_imported_ply
from .rendered_photos import render_photos, scene_around

PLACED = "placed"
"""Entry in the record of a reconstruction without cameras: they were placed around it."""
LEAST_COVERED = 0.02
"""Share of the photos below which the reconstruction is practically out of view."""
_UPS = {"gaussians": np.array([0.0, -1.0, 0.0]), "points": np.array([0.0, 0.0, 1.0])}
"""Up if no ground defines it: 3DGS files mostly keep COLMAP's axes, clouds those of a scanner."""


@dataclass(frozen=True)
class ImportedGaussians:
    """A reconstruction of another program, with cameras, in the files gaussians.ply and cameras.json of `folder`.

    key: hash of all inputs; record: its entry in the provenance (file, sha256, kind, cameras); notices: messages for
    the user; reused: it was in the cache.
    """

    folder: Path
    key: str
    record: dict[str, Any]
    notices: Sequence[str]
    reused: bool


def import_gaussians(
    file: Path, scene: Scene | None, inputs: str, config: SceneConfig, cache: Path
) -> ImportedGaussians:
    """Read `file` into a folder of `cache`, unless it is there.

    scene: photos and cameras in the frame of the file, with the hash `inputs`; without it cameras are placed around the
    subject, and renders replace the photos.

    Raises:
        FormatError: the file cannot be used (see `read_imported_ply`).
        SceneError: the cameras see next to nothing of it, or their photos show something else.
    """
    sha256 = _hash(file)
    key = stage_key(("scene", "splatting", "compiled"), inputs, sha256, config)
    folder = cache / f"imported-{key}"
    record_file = folder / "imported.json"
    reused = record_file.is_file()
    if not reused:
        imported = read_imported_ply(file)
        notices = list(imported.notices)
        if scene is not None:
            _check_fit(measure_fit(imported.gaussians, scene), file)
        used = scene or _scene_around(imported, file, config.up, notices)
        write_ply(folder / "gaussians.ply", imported.gaussians)
        write_text(folder / "cameras.json", dump_cameras(used))
        write_text(record_file, json.dumps({"kind": imported.kind, "notices": notices}))
    kept = json.loads(record_file.read_text(encoding="utf-8"))
    cameras = PLACED if scene is None else "given"
    record = {"file": file.name, "sha256": sha256, "kind": kept["kind"], "cameras": cameras}
    return ImportedGaussians(folder, key, record, kept["notices"], reused)


def render_again(gaussians: Gaussians, stored: Scene) -> Scene:
    """Return the cached scene of placed cameras, with renders as photos."""
    return replace(stored, images=render_photos(gaussians, stored.cameras))


def _hash(file: Path) -> str:
    try:
        return file_hash(file)
    except FileNotFoundError as error:
        raise FormatError(f"{file} is not there. Give a .ply of Gaussians or coloured points") from error
    except OSError as error:
        raise FormatError(f"{file} cannot be read ({error.strerror}). Give a .ply file") from error


def _scene_around(imported: ImportedPly, file: Path, up: Sequence[float] | None, notices: list[str]) -> Scene:
    """Cameras and renders around it; adds messages for the user to `notices`."""
    guess: FloatArray = _UPS[imported.kind]
    drawn = scene_around(imported.gaussians, up, guess)
    notices.append(f"{len(drawn.scene.cameras)} cameras were placed around {file.name}. Their pictures serve as photos")
    if not drawn.up_is_known:
        axis = "-y" if guess[1] else "+z"
        notices.append(f"no ground tells which way is up, so {axis} was taken; --scene.up X Y Z sets it")
    return drawn.scene


def _check_fit(fit: Fit, file: Path) -> None:
    """Raise if cameras and reconstruction have different frames."""
    if fit.covered < LEAST_COVERED:
        raise SceneError(
            f"The cameras see next to nothing of {file} ({fit.covered:.1%} of their photos): their frames differ."
            " Export it in the frame of the scene's cameras, or give it alone as SCENE"
        )
    if fit.own <= fit.other:
        raise SceneError(
            f"{file} looks no more like the photos of its cameras than like others (correlation {fit.own:.2f} against"
            f" {fit.other:.2f}): their frames differ. Export it in the frame of the scene's cameras, or give it alone"
        )
