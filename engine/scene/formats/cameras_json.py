"""The cameras file of a result folder, so that another prompt needs no photos."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FormatError, OutputError
from ..camera import Camera, Scene

SCHEMA = "fruitlangs.cameras/1"


def dump_cameras(scene: Scene) -> str:
    """JSON text of a scene's cameras (world to camera, COLMAP's axes, pixels), up direction and unit."""
    document = {
        "schema": SCHEMA,
        "up": scene.up.tolist(),
        "metres_per_unit": scene.metres_per_unit,
        "cameras": [
            {
                "name": photo.name,
                "width": camera.width,
                "height": camera.height,
                "K": camera.K.tolist(),
                "world_to_camera": camera.world_to_camera.tolist(),
            }
            for camera, photo in zip(scene.cameras, scene.images, strict=True)
        ],
    }
    return json.dumps(document, indent=1) + "\n"


def add_scene_facts(path: Path, scene: Scene) -> str:
    """Return the JSON text of a cameras file with the unit and up direction of the scene instead of its own.

    Raises:
        OutputError, FormatError: as `read_cameras`.
    """
    facts = {"up": scene.up.tolist(), "metres_per_unit": scene.metres_per_unit}
    return json.dumps({**_read(path), **facts}, indent=1) + "\n"


def camera_names(path: Path) -> list[str]:
    """Names of the photos of the cameras in a cameras file, in order.

    Raises:
        OutputError, FormatError: as `read_cameras`.
    """
    try:
        return [entry["name"] for entry in _read(path)["cameras"]]
    except (KeyError, TypeError) as error:
        raise FormatError(f"{path} is not a cameras file ({error}). Count again from the photos") from error


def read_cameras(path: Path) -> Scene:
    """A scene with cameras but without photos and sparse points.

    Raises:
        OutputError: the file is missing.
        FormatError: it is not a cameras file of this version.
    """
    document = _read(path)
    try:
        cameras = [
            Camera(
                K=np.asarray(entry["K"], dtype=np.float64).reshape(3, 3),
                world_to_camera=np.asarray(entry["world_to_camera"], dtype=np.float64).reshape(4, 4),
                width=int(entry["width"]),
                height=int(entry["height"]),
            )
            for entry in document["cameras"]
        ]
        return Scene(
            cameras=cameras,
            images=[],
            points=np.zeros((0, 3)),
            colors=np.zeros((0, 3), np.uint8),
            up=np.asarray(document["up"], dtype=np.float64).reshape(3),
            metres_per_unit=document["metres_per_unit"],
        )
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path} is not a cameras file ({error}). Count again from the photos") from error


def _read(path: Path) -> dict[str, Any]:
    """The content of a cameras file of this version."""
    if not path.is_file():
        raise OutputError(f"{path} is missing. Give the folder of the photos as SCENE instead of this result folder")
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        schema = document["schema"]
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path} is not a cameras file ({error}). Count again from the photos") from error
    if schema != SCHEMA:
        raise FormatError(f"{path} has schema {schema!r}. This version reads {SCHEMA!r}")
    return document
