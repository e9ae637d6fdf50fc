"""Photos for training: uint8, at full or reduced size, cached up to a limit, decoded ahead of time."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import SceneError
from ...scene.camera import Camera, Scene
from ...scene.photos.resample import shrink, shrink_mask

KEPT = 1 << 30
"""Bytes of decoded photos in the cache."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A photo: its camera; pixels (H, W, 3) uint8, stored plane by plane; mask (H, W) usable pixels, None for all;
    view: its index in the scene."""

    camera: Camera
    pixels: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None
    view: int

    @property
    def bytes(self) -> int:
        return self.pixels.nbytes + (0 if self.mask is None else self.mask.nbytes)


class PhotoShelf:
    """The scene's photos by view; those that fit into `limit` bytes are decoded once."""

    def __init__(self, scene: Scene, limit: int | None = None) -> None:
        self.scene = scene
        self.limit = KEPT if limit is None else limit
        self._kept: dict[tuple[int, int], Picture] = {}
        self._bytes = 0
        self._ahead: dict[tuple[int, int], Future[Picture]] = {}
        self._decoder = ThreadPoolExecutor(1, thread_name_prefix="photos")

    def picture(self, view: int, smaller: int = 1) -> Picture:
        """The photo of a view, its width and height divided by `smaller`.

        Raises:
            SceneError: the photo cannot be read or its size is not its camera's.
        """
        kept = self._kept.get((view, smaller))
        if kept is not None:
            return kept
        ahead = self._ahead.pop((view, smaller), None)
        picture = self._load(view, smaller) if ahead is None else ahead.result()
        if self._bytes + picture.bytes <= self.limit:
            self._kept[view, smaller] = picture
            self._bytes += picture.bytes
        return picture

    def expect(self, view: int, smaller: int = 1) -> None:
        """Start to decode a photo that `picture` will request next."""
        place = (view, smaller)
        if place not in self._kept and place not in self._ahead:
            self._ahead[place] = self._decoder.submit(self._load, view, smaller)

    def close(self) -> None:
        """Stop decoding."""
        self._decoder.shutdown(wait=True, cancel_futures=True)

    def _load(self, view: int, smaller: int) -> Picture:
        camera, photo = self.scene.cameras[view], self.scene.images[view]
        pixels, mask = photo.pixels(), photo.mask()
        if pixels.shape != (camera.height, camera.width, 3):
            raise SceneError(
                f"Photo {photo.name} has {pixels.shape[1]}×{pixels.shape[0]} pixels but its camera"
                f" {camera.width}×{camera.height}. Use the photos the model was made from"
            )
        if smaller > 1:
            camera = camera.scale(1.0 / smaller)
            pixels = np.rint(shrink(pixels.astype(np.float32), camera.width, camera.height)).astype(np.uint8)
            if mask is not None:
                mask = shrink_mask(mask, camera.width, camera.height)
        if mask is not None and mask.all():
            mask = None
        planes = np.ascontiguousarray(pixels.transpose(2, 0, 1))
        return Picture(camera, planes.transpose(1, 2, 0), mask, view)
