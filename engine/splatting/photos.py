"""Photos as training reads them: uint8, kept in memory up to a bound, at full or half size."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..errors import SceneError
from ..scene.camera import Camera, Scene


@dataclass(frozen=True, eq=False)
class Picture:
    """A photo at one size: camera of that size; pixels (H, W, 3) uint8; mask (H, W) usable pixels, None for all."""

    camera: Camera
    pixels: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None

    @property
    def bytes(self) -> int:
        return self.pixels.nbytes + (0 if self.mask is None else self.mask.nbytes)


@dataclass(eq=False)
class PhotoShelf:
    """The scene's pictures by view and halvings; what fits under `limit` bytes is decoded once."""

    scene: Scene
    limit: int = 1 << 30
    _kept: dict[tuple[int, int], Picture] = field(default_factory=dict)
    _bytes: int = 0

    def picture(self, view: int, halvings: int = 0) -> Picture:
        """A view's photo with its sides halved `halvings` times.

        Raises:
            SceneError: the photo cannot be read or its size is not its camera's.
        """
        kept = self._kept.get((view, halvings))
        if kept is not None:
            return kept
        picture = halved(self.picture(view, halvings - 1)) if halvings > 0 else self._load(view)
        if self._bytes + picture.bytes <= self.limit:
            self._kept[view, halvings] = picture
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


def halved(picture: Picture) -> Picture:
    """Means of 2×2 pixels (a last odd row or column is left out); usable where all four are."""
    camera = picture.camera
    height, width = camera.height // 2, camera.width // 2
    if height < 1 or width < 1:
        return picture
    parts = picture.pixels[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3)
    pixels = ((parts.sum(axis=(1, 3), dtype=np.uint16) + 2) // 4).astype(np.uint8)
    mask = picture.mask
    if mask is not None:
        mask = mask[: 2 * height, : 2 * width].reshape(height, 2, width, 2).all(axis=(1, 3))
    K = np.diag([0.5, 0.5, 1.0]) @ camera.K
    return Picture(Camera(K=K, world_to_camera=camera.world_to_camera, width=width, height=height), pixels, mask)
