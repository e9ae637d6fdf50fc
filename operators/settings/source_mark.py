"""Recognises a source whose folder was moved, and distinguishes it from another in a folder of the same name.

Folders are often called `photos` or `images`, so the name is not enough: a mark is one file of the source with a hash
of its size and beginning, which no two photos share.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

BEGINNING = 1 << 20
"""Bytes that are hashed: more than a photo's header and enough of its pixels, little of a large cloud."""
MODELS = ("transforms.json", "images.bin", "images.txt")
"""Files that distinguish models whose photos are elsewhere."""


def source_mark(source: Path) -> str:
    """'images/IMG_1.jpg 5f3a…' of the source; empty if it is missing or has no such file."""
    with suppress(OSError):
        file = _choose_marked_file(source)
        if file is not None:
            return f"{file.relative_to(source).as_posix()} {_hash(file)}"
    return ""


def has_mark(source: Path, mark: str) -> bool:
    """Whether the source is the one that a mark was made from; False for an empty mark."""
    name, _, content = mark.rpartition(" ")
    with suppress(OSError):
        return _hash(source / name) == content
    return False


def _choose_marked_file(source: Path) -> Path | None:
    """Return the source itself if it is a file, else its first photo, else its model or first video."""
    from ...engine.scene.sfm.find_cameras import PHOTO_SUFFIXES, list_photos
    from ...engine.scene.video.frames import VIDEO_SUFFIXES

    if source.is_file():
        return source
    photos = list_photos(source / "images") or list_photos(source)
    if not photos:  # the photos of several cameras are in separate folders
        below = (source / "images").rglob("*")
        photos = sorted(file for file in below if file.suffix.lower() in PHOTO_SUFFIXES)
    models = (source / name for name in MODELS)
    videos = sorted(file for file in source.iterdir() if file.suffix.lower() in VIDEO_SUFFIXES)
    return next((file for file in (*photos, *models, *videos) if file.is_file()), None)


def _hash(file: Path) -> str:
    """Hash of the size and beginning of a file."""
    with file.open("rb") as opened:
        beginning = opened.read(BEGINNING)
    return hashlib.sha256(f"{file.stat().st_size} ".encode() + beginning).hexdigest()
