"""Photos as training reads them: uint8, kept in memory up to a bound."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..errors import SceneError
from ..scene.camera import Camera, Scene


@dataclass(frozen=True, eq=False)
class Picture:
    """A photo: its camera; pixels (H, W, 3) uint8; mask (H, W) usable pixels, None for all."""

    camera: Camera
    pixels: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None

    @property
    def bytes(self) -> int:
        return self.pixels.nbytes + (0 if self.mask is None else self.mask.nbytes)


@dataclass(eq=False)
class PhotoShelf:
    """The scene's pictures by view; what fits under `limit` bytes is decoded once."""

    scene: Scene
    limit: int = 1 << 30
    _kept: dict[int, Picture] = field(default_factory=dict)
    _bytes: int = 0

    def picture(self, view: int) -> Picture:
        """A view's photo.

        Raises:
            SceneError: the photo cannot be read or its size is not its camera's.
        """
        kept = self._kept.get(view)
        if kept is not None:
            return kept
        picture = self._load(view)
        if self._bytes + picture.bytes <= self.limit:
            self._kept[view] = picture
            self._bytes += picture.bytes
        return picture

    def _load(self, view: int) -> Picture:
        camera, photo = self.scene.cameras[view], self.scene.images[view]
        pixels, mask = photo.pixels(), photo.mask()
        if pixels.shape != (camera.height, camera.width, 3):
            raise SceneError(
                f"photo {photo.name} has {pixels.shape[1]}×{pixels.shape[0]} pixels but its camera"
                f" {camera.width}×{camera.height}; use the photos the model was made from"
            )
        if mask is not None and mask.all():
            mask = None
        return Picture(camera, pixels, mask)
