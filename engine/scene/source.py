"""Prepares what the user gives as a scene: photos without cameras get them first."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from ..cache import stage_key
from ..config import PhotosConfig, SceneConfig
from ..errors import OutputError, SceneError
from ..files import files_hash, require_writable
from ..progress import Progress, silent
from .camera import Scene
from .formats.layout import find_model
from .formats.transforms import TRANSFORMS
from .read import read_scene, scene_hash
from .sfm.find_cameras import LEAST_PHOTOS, find_poses, list_photos


@dataclass(frozen=True, kw_only=True)
class Source:
    """Paths of a scene's model, photos and masks for `read_scene`.

    notices: messages for the user; reused: the model was in the cache.
    """

    path: Path
    images: Path | None = None
    masks: Path | None = None
    notices: Sequence[str] = ()
    reused: bool = False

    def read(self, config: SceneConfig, progress: Progress = silent) -> Scene:
        return read_scene(self.path, config, images=self.images, masks=self.masks, progress=progress)

    def hash(self) -> str:
        return scene_hash(self.path, images=self.images, masks=self.masks)


def photos_alone(path: Path) -> Path | None:
    """The folder of a scene's photos (`path`/images or `path`) if they have no cameras; else None.

    Raises:
        SceneError: a model is there and is damaged.
    """
    if not path.is_dir() or (path / TRANSFORMS).is_file() or find_model(path) is not None:
        return None
    return next((folder for folder in (path / "images", path) if list_photos(folder)), None)


def pose_photos(photos: Path, cache: Path, config: PhotosConfig, *, progress: Progress = silent) -> Source:
    """Estimate the cameras of photos (see `find_poses`), or take them from `cache`, where they are stored by content.

    Masks are in `masks` next to the photos' folder or inside it.

    Raises:
        SceneError: as `find_poses`.
        OutputError: `cache` cannot be written.
        Cancelled: `progress` asked for it.
    """
    source = _source(photos, cache, config)
    if len(list_photos(photos)) >= LEAST_PHOTOS:
        require_writable(cache)
    found = find_poses(photos, source.path.parent, config, progress=progress)
    return replace(source, path=found.model, notices=found.notices, reused=found.reused)


def posed_before(photos: Path, earlier: Path, cache: Path, config: PhotosConfig) -> Source:
    """The photos with the cameras of an earlier run in the cache `earlier`; they are copied to `cache`.

    Raises:
        SceneError: they are not there, or the photos have changed.
        OutputError: `cache` cannot be written.
    """
    source, kept = _source(photos, earlier, config), _source(photos, cache, config)
    if not source.path.is_dir():
        raise SceneError(f"The cameras of {photos} are no longer in {earlier}. Count again from the photos")
    if not kept.path.is_dir():
        staging = kept.path.with_name(f".model.{os.getpid()}")
        try:
            shutil.copytree(source.path, staging)
            os.replace(staging, kept.path)
        except OSError as error:
            raise OutputError(f"{cache} cannot be written ({error.strerror or error})") from error
    return kept


def _source(photos: Path, cache: Path, config: PhotosConfig) -> Source:
    """Folder of the model of photos and settings, whether it exists or not."""
    try:
        library = version("pycolmap")
        content = files_hash(list_photos(photos), photos)
    except PackageNotFoundError as error:
        raise SceneError("The package pycolmap is missing. Run: python -m pip install pycolmap") from error
    except OSError as error:
        raise SceneError(f"{error.filename} cannot be read ({error.strerror}). Check its permissions") from error
    key = stage_key(("scene",), content, config, library)
    # Otherwise they are where `read_scene` expects them.
    masks = photos / "masks" if (photos / "masks").is_dir() else None
    return Source(path=cache / f"photos-{key}" / "model", images=photos, masks=masks)
