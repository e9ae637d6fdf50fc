"""Reads every kind of scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..config import SceneConfig
from ..errors import SceneError
from ..files import files_hash, text_hash
from ..progress import Progress, silent
from .camera import Scene
from .formats.colmap import colmap_files, read_colmap
from .formats.layout import find_model
from .formats.transforms import TRANSFORMS, read_transforms, transforms_files
from .sfm.find_cameras import PHOTO_SUFFIXES, list_photos

_READ_TODAY = (
    "what is read: a COLMAP model's folder, a folder with transforms.json, an earlier result's folder; a .ply of"
    " Gaussians or coloured points is counted in as it is"
)
_VIDEOS = {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts"}
_CLOUDS = {".ply", ".spz", ".las", ".laz", ".pcd", ".splat", ".e57"}


def read_scene(
    path: Path,
    config: SceneConfig = SceneConfig(),  # noqa: B008 (frozen)
    *,
    images: Path | None = None,
    masks: Path | None = None,
    progress: Progress = silent,
) -> Scene:
    """Read a COLMAP model's folder or a `transforms.json` (the file or its folder); a model is preferred if both exist.

    `config.up` replaces the estimated up direction. images, masks: folders of a COLMAP model whose photos or masks are
    elsewhere (see `read_colmap`).

    Raises:
        SceneError: there is nothing there, it is another kind of scene, or it is damaged.
    """
    path = Path(path)
    if _is_transforms(path):
        scene = read_transforms(path, config, progress=progress)
    else:
        scene = read_colmap(path, config, images=images, masks=masks, progress=progress)
    return scene if config.up is None else replace(scene, up=np.asarray(config.up) / np.linalg.norm(config.up))


def scene_files(path: Path, *, images: Path | None = None, masks: Path | None = None) -> list[Path]:
    """Every file that `read_scene` and its photos read: the model's or transforms.json, photos, masks, points.

    Raises:
        SceneError: as `read_scene`.
    """
    path = Path(path)
    if _is_transforms(path):
        return transforms_files(path)
    return colmap_files(path, images=images, masks=masks)


def scene_hash(path: Path, *, images: Path | None = None, masks: Path | None = None) -> str:
    """SHA-256 over the names and bytes of `scene_files`; independent of how `path` is written and where it is.

    Names are relative to `path`'s folder, or to `images` and `masks` where these are given.

    Raises:
        SceneError: as `read_scene`, or a file cannot be read.
    """
    path = Path(path)
    # A link to a transforms.json names photos next to the link: only its folder is resolved.
    root = (path if path.is_dir() else path.parent).resolve()
    source = root if path.is_dir() else root / path.name
    images, masks = (None if folder is None else folder.resolve() for folder in (images, masks))
    apart = [folder for folder in (masks, images) if folder is not None]
    try:
        files = scene_files(source, images=images, masks=masks)
        parts = [files_hash(group, folder) for folder, group in _by_folder(files, apart, root)]
        return parts[0] if not apart else text_hash(*parts)
    except OSError as error:
        raise SceneError(f"{error.filename} cannot be read ({error.strerror}). Check its permissions") from error


def _by_folder(files: list[Path], apart: list[Path], root: Path) -> list[tuple[Path, list[Path]]]:
    """Files relative to the first folder of `apart` that contains them, else to `root`."""
    groups: dict[Path, list[Path]] = {root: [], **{folder: [] for folder in apart}}
    for file in files:
        groups[next((folder for folder in apart if file.is_relative_to(folder)), root)].append(file)
    return list(groups.items())


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
        (_VIDEOS, "a video"),
        (_CLOUDS, "a point cloud or splat"),
        (PHOTO_SUFFIXES, "a single photo"),
    ):
        if suffix in suffixes:
            return kind
    return "a file, not a folder"
