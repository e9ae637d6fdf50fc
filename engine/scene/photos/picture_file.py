"""Opening picture files of every kind that is read."""

from __future__ import annotations

import functools
from collections.abc import Collection
from pathlib import Path

from PIL import Image

from ...errors import SceneError

HEIF_SUFFIXES = frozenset({".heic", ".heif"})
RAW_SUFFIXES = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".rw2", ".orf", ".raf", ".pef", ".srw"})


def open_picture(path: Path) -> Image.Image:
    """The picture in a file, as `Image.open`; HEIC and HEIF are upright, because their reader applies the rotation.

    Raises:
        SceneError: it is a RAW file, or the package for HEIC is not installed.
        OSError and others: it is not a picture.
    """
    suffix = path.suffix.lower()
    if suffix in RAW_SUFFIXES:
        raise SceneError(explain_raw_refusal(path))
    if suffix in HEIF_SUFFIXES:
        _read_heif()
    return Image.open(path)


def convert_to_rgb(image: Image.Image) -> Image.Image:
    """Convert any picture to 8-bit RGB; 16-bit grey is scaled, not clipped."""
    if image.mode.startswith("I"):
        image = image.convert("F").point(lambda value: value / 257.0).convert("L")
    return image.convert("RGB")


def list_files(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """List what has one of these suffixes directly in a folder, in name order; [] if the folder does not exist."""
    if not folder.is_dir():
        return []
    return sorted(
        (file for file in folder.iterdir() if file.suffix.lower() in suffixes and not file.name.startswith(".")),
        key=lambda file: file.name,
    )


def explain_raw_refusal(path: Path) -> str:
    """Say why a RAW file is refused, for the user."""
    return (
        f"{path} is a RAW file, which is not read. Convert the photos to JPEG with the camera's program, darktable or"
        " RawTherapee"
    )


@functools.cache
def _read_heif() -> None:
    """Let Pillow open HEIC and HEIF."""
    try:
        import pillow_heif
    except ImportError as error:
        raise SceneError(
            f"HEIC photos need the package pillow-heif ({error}). Run: python -m pip install pillow-heif"
        ) from error
    pillow_heif.register_heif_opener()
