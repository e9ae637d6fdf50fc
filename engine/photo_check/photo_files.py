"""The photos of a source, with or without cameras, and the RAW files next to them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..config import SceneConfig
from ..errors import SceneError
from ..scene.formats.layout import find_model
from ..scene.formats.transforms import TRANSFORMS
from ..scene.photos.photo import FilePhoto
from ..scene.photos.picture_file import RAW_SUFFIXES, list_files
from ..scene.sfm.find_cameras import list_photos
from ..scene.source import Source


@dataclass(frozen=True, kw_only=True)
class PhotoFiles:
    """photos: in name order; raw: RAW files among them; folder: that contains all of them; posed: cameras are given."""

    folder: Path
    photos: Sequence[Path]
    raw: Sequence[Path]
    posed: bool

    def name(self, photo: Path) -> str:
        """The name of a photo in the folder; 'left/1.jpg' if the photos of several cameras have their own folders."""
        return photo.relative_to(self.folder).as_posix()


def list_photo_files(source: Source) -> PhotoFiles:
    """List the files to check.

    Raises:
        SceneError: there is neither a photo nor a RAW file, or the model of the cameras is damaged.
    """
    path = source.path
    if not path.is_dir() or (path / TRANSFORMS).is_file() or find_model(path) is not None:
        return _list_posed(source)
    folder = source.photos_alone() or next((each for each in (path / "images", path) if _list_raw(each)), None)
    if folder is None:
        raise SceneError(f"{path} has no photos. Give the folder that contains the photos")
    return PhotoFiles(folder=folder, photos=list_photos(folder), raw=_list_raw(folder), posed=False)


def is_video(source: Source) -> bool:
    """Whether stills of a video are checked; errors as of `Source.video`, but RAW files are a finding of the check."""
    raw = any(_list_raw(folder) for folder in (source.path / "images", source.path))
    return not raw and source.video() is not None


def _list_posed(source: Source) -> PhotoFiles:
    """List the photos of a model or transforms.json."""
    images = source.read(SceneConfig()).images
    photos = sorted({photo.path for photo in images if isinstance(photo, FilePhoto)})
    folder = Path(os.path.commonpath([photo.parent for photo in photos])) if photos else source.path
    return PhotoFiles(folder=folder, photos=photos, raw=(), posed=True)


def _list_raw(folder: Path) -> list[Path]:
    """List the RAW files directly in a folder, in name order; [] if the folder does not exist."""
    return list_files(folder, RAW_SUFFIXES)
