"""The photos of a source, with or without cameras, and the RAW files next to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..config import SceneConfig
from ..errors import SceneError
from ..scene.photos.photo import FilePhoto
from ..scene.sfm.find_cameras import list_photos
from ..scene.source import Source

RAW_SUFFIXES = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".rw2", ".orf", ".raf", ".pef", ".srw"})


@dataclass(frozen=True, kw_only=True)
class PhotoFiles:
    """photos: in name order; raw: RAW files among them; posed: cameras are given."""

    folder: Path
    photos: Sequence[Path]
    raw: Sequence[Path]
    posed: bool


def photo_files(source: Source) -> PhotoFiles:
    """The files to check.

    Raises:
        SceneError: there is neither a photo nor a RAW file, or the model is damaged.
    """
    path = source.path
    folder = source.photos_alone() or next((each for each in (path / "images", path) if _raw_files(each)), None)
    if folder is not None and (source.photos_alone() or not _has_model(source)):
        photos = [file for file in list_photos(folder) if file.suffix.lower() not in RAW_SUFFIXES]
        return PhotoFiles(folder=folder, photos=photos, raw=_raw_files(folder), posed=False)
    if path.is_dir() and not _has_model(source):
        raise SceneError(f"{path} has no photos. Give the folder that contains the photos")
    scene = source.read(SceneConfig())
    posed = sorted({photo.path for photo in scene.images if isinstance(photo, FilePhoto)})
    return PhotoFiles(folder=posed[0].parent if posed else path, photos=posed, raw=(), posed=True)


def _has_model(source: Source) -> bool:
    try:
        source.opened()
    except SceneError:
        return False
    return True


def _raw_files(folder: Path) -> list[Path]:
    """The RAW files directly in a folder, in name order; [] if the folder does not exist."""
    if not folder.is_dir():
        return []
    return sorted(
        file for file in folder.iterdir() if file.suffix.lower() in RAW_SUFFIXES and not file.name.startswith(".")
    )
