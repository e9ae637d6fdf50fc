"""Photos that are decoded once in a run: their pixels are kept in files, from which any number of readers map them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import OutputError
from ...storage.files import replace_file
from ..camera import Photo, Scene

HEADER = 128
"""Bytes of a .npy file without content."""


@contextmanager
def spool_photos(scene: Scene, folder: Path) -> Iterator[Scene]:
    """Yield the scene with photos that are decoded when they are first read, and from then on mapped from files in
    `folder`.

    The folder is removed at the end. The operating system keeps of the files what fits in memory.
    """
    shutil.rmtree(folder, ignore_errors=True)
    try:
        photos = [SpooledPhoto(photo, folder / f"{view:06d}") for view, photo in enumerate(scene.images)]
        yield replace(scene, images=photos)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@dataclass(frozen=True, eq=False)
class SpooledPhoto:
    """A photo whose pixels and mask are stored in the files `stem`.pixels.npy and `stem`.mask.npy."""

    photo: Photo
    stem: Path

    @property
    def name(self) -> str:
        return self.photo.name

    def pixels(self) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB, not writable; errors as of the photo itself."""
        path = self.stem.with_suffix(".pixels.npy")
        return _map_file(path) if path.is_file() else spool(self.photo.pixels(), path)

    def mask(self) -> NDArray[np.bool_] | None:
        """(H, W) True where the photo may be used; None if every pixel may."""
        path = self.stem.with_suffix(".mask.npy")
        if path.is_file():
            stored = _map_file(path)
        else:
            mask = self.photo.mask()
            stored = spool(np.zeros((0, 0), np.bool_) if mask is None else mask, path)
        return stored if stored.size else None


def spool(array: NDArray[Any], path: Path) -> NDArray[Any]:
    """The array, mapped from the file that it is written to; itself if it cannot be written."""
    with suppress(OutputError):
        with replace_file(path) as temporary:
            np.save(temporary, array)
        return _map_file(path)
    return array


def _map_file(path: Path) -> NDArray[Any]:
    empty = path.stat().st_size <= HEADER  # cannot be mapped
    return np.load(path, mmap_mode=None if empty else "r", allow_pickle=False).view(np.ndarray)
