"""Reads every kind of scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from ..config import SceneConfig
from ..errors import SceneError
from ..progress import Progress, silent
from .camera import Scene
from .formats.colmap import open_colmap
from .formats.layout import find_model
from .formats.transforms import TRANSFORMS, open_transforms
from .photos.picture_file import RAW_SUFFIXES
from .sfm.find_cameras import PHOTO_SUFFIXES, list_photos
from .video.frames import VIDEO_SUFFIXES

_READ_TODAY = (
    "what is read: a folder of photos, a video, a COLMAP model's folder, a folder with transforms.json, an earlier"
    " result's folder, or a .ply of Gaussians or coloured points"
)
_CLOUDS = {".ply", ".spz", ".las", ".laz", ".pcd", ".splat", ".e57"}


class SceneFiles(Protocol):
    """A model or transforms.json that was read and checked; the headers of its photos are read with the scene."""

    @property
    def notices(self) -> Sequence[str]: ...

    def files(self) -> list[Path]: ...

    def scene(self, config: SceneConfig, progress: Progress = silent) -> Scene: ...


def open_scene(
    path: Path, *, images: Path | None = None, masks: Path | None = None, progress: Progress = silent
) -> SceneFiles:
    """Open a COLMAP model's folder or a `transforms.json` (the file or its folder); a model is preferred if both exist.

    images, masks: folders of a COLMAP model whose photos or masks are elsewhere (see `read_colmap`).

    Raises:
        SceneError: there is nothing there, it is another kind of scene, or it is damaged.
    """
    if _is_transforms(path):
        return open_transforms(path)
    return open_colmap(path, images=images, masks=masks, progress=progress)


def read_scene(
    path: Path,
    config: SceneConfig = SceneConfig(),  # noqa: B008 (frozen)
    *,
    opened: SceneFiles | None = None,
    progress: Progress = silent,
) -> Scene:
    """Read a scene, or the one that was `opened`; `config.up` replaces the estimated up direction.

    Raises:
        SceneError: as `open_scene`, or a photo does not fit its camera.
    """
    scene = (opened or open_scene(Path(path), progress=progress)).scene(config, progress)
    return scene if config.up is None else replace(scene, up=np.asarray(config.up) / np.linalg.norm(config.up))


def _is_transforms(path: Path) -> bool:
    """True for a transforms.json or its folder, False for a COLMAP model's folder.

    Raises:
        SceneError: neither.
    """
    if not path.exists():
        raise SceneError(f"{path} does not exist; {_READ_TODAY}")
    if path.is_file():
        if path.suffix.lower() == ".json":
            return True
        raise SceneError(f"{path} is {_kind(path)}; {_READ_TODAY}")
    if find_model(path) is not None:
        return False
    if (path / TRANSFORMS).is_file():
        return True
    photos = len(list_photos(path)) + len(list_photos(path / "images"))
    if photos:
        raise SceneError(f"{path} has {photos} photos but no model of where they were taken; {_READ_TODAY}")
    raise SceneError(f"{path} holds no model in sparse/0, sparse, itself or colmap/sparse/0; {_READ_TODAY}")


def _kind(file: Path) -> str:
    suffix = file.suffix.lower()
    for suffixes, kind in (
        (VIDEO_SUFFIXES, "a video without cameras"),
        (RAW_SUFFIXES, "a single RAW file"),
        (_CLOUDS, "a point cloud or splat"),
        (PHOTO_SUFFIXES, "a single photo"),
    ):
        if suffix in suffixes:
            return kind
    return "a file, not a folder"
