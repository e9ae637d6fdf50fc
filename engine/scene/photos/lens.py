"""Lenses: the distortion of each of COLMAP's camera models, and how to undo it.

Every pixel of an ideal pinhole camera takes the colour of the pixel where the real lens saw the same ray
(`source_map`). The pinhole keeps focal length, principal point and size of the lens, so the middle of the photo keeps
its resolution. A 360° panorama has no such pinhole: it becomes the six faces of a cube.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...errors import SceneError
from ..camera import FloatArray
from ..pycolmap_import import colmap_library

_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
_PANORAMA = "EQUIRECTANGULAR"

_CUBE_AXES = {
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}
"""Each cube face's x (right), y (down) and z (forward) axes in the panorama's own frame."""


@dataclass(frozen=True)
class Lens:
    """One calibrated lens: COLMAP's model name and parameters, for photos of width × height pixels."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise SceneError(f"camera {self.model} has a size of {self.width}x{self.height}. Calibrate it again")
        if not np.isfinite(self.params).all():
            raise SceneError(f"camera {self.model} has parameters that are not finite numbers. Calibrate it again")
        if not self.is_panorama and min(self.K[0, 0], self.K[1, 1]) <= 0.0:
            raise SceneError(f"camera {self.model} has a focal length that is not above 0. Calibrate it again")

    @property
    def is_panorama(self) -> bool:
        return self.model == _PANORAMA

    @property
    def is_pinhole(self) -> bool:
        """True if photos of this lens need no undistortion."""
        return self.model in _PINHOLES

    @property
    def K(self) -> FloatArray:
        """(3, 3) intrinsics of the pinhole with the same focal length and principal point, in pixels."""
        return np.asarray(self._colmap().calibration_matrix(), dtype=np.float64)

    @property
    def faces(self) -> tuple[str, ...]:
        """Names of the pinhole views of the lens: six faces for a panorama, else one, unnamed."""
        return tuple(_CUBE_AXES) if self.is_panorama else ("",)

    def project(self, rays: FloatArray) -> FloatArray:
        """(N, 2) pixels where rays (N, 3) in the camera frame meet the photo; NaN outside the field of view."""
        return np.asarray(self._colmap().img_from_cam(np.ascontiguousarray(rays, dtype=np.float64)))

    def _colmap(self) -> Any:
        """The `pycolmap.Camera`; pycolmap is imported when first needed."""
        pycolmap = colmap_library()

        known = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
        if self.model not in known:
            raise SceneError(f"camera model {self.model} is not known. pycolmap reads {', '.join(known)}")
        camera = pycolmap.Camera(
            camera_id=1, model=self.model, width=self.width, height=self.height, params=list(self.params)
        )
        if not camera.verify_params():
            raise SceneError(f"camera {self.model} has {len(self.params)} parameters, it takes {camera.params_info}")
        return camera


@dataclass(frozen=True, eq=False)
class View:
    """An ideal pinhole view onto what a lens saw.

    K: (3, 3) in pixels of the view; rotation: (3, 3) from the lens's frame to the view's; size in pixels.
    """

    K: FloatArray
    rotation: FloatArray
    width: int
    height: int


def view_of(lens: Lens, face: str, width: int, height: int) -> View:
    """The pinhole view `face` of a photo that was resized to width × height pixels (K follows the resize exactly)."""
    if lens.is_panorama:
        side = max(round(width / np.pi), 1)  # 90° at the panorama's own resolution in its middle
        K = np.array([[side / 2, 0.0, side / 2], [0.0, side / 2, side / 2], [0.0, 0.0, 1.0]])
        return View(K=K, rotation=np.array(_CUBE_AXES[face], dtype=np.float64), width=side, height=side)
    resize = np.diag([width / lens.width, height / lens.height, 1.0])
    return View(K=resize @ lens.K, rotation=np.eye(3), width=width, height=height)


@dataclass(frozen=True, eq=False)
class SourceMap:
    """The origin of each pixel of a view.

    pixels: (H, W, 2) float32 x, y in the resized photo (pixel centres at +0.5); valid: (H, W) False where the photo
    does not show that ray.
    """

    pixels: NDArray[np.float32]
    valid: NDArray[np.bool_]


@lru_cache(maxsize=2)
def source_map(lens: Lens, face: str, width: int, height: int) -> SourceMap:
    """Map the pixels of `view_of(lens, face, width, height)` to those of the photo resized to width × height.

    Polynomial lenses fold back far outside the calibrated field: only the part connected to the principal point without
    a fold is valid.
    """
    view = view_of(lens, face, width, height)
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1) @ np.linalg.inv(view.K).T
    seen = lens.project(rays @ view.rotation)  # rows are rays: r_lens = Rᵀ r_view
    pixels = seen.reshape(view.height, view.width, 2) * [width / lens.width, height / lens.height]
    with np.errstate(invalid="ignore"):
        valid = ((pixels >= 0.0) & (pixels <= [width, height])).all(axis=2)
        if not lens.is_panorama:
            valid &= _find_unfolded(pixels, view)
    return SourceMap(pixels=np.where(valid[..., None], pixels, 0.0).astype(np.float32), valid=valid)


def _find_unfolded(pixels: FloatArray, view: View) -> NDArray[np.bool_]:
    """Mark (H, W) True where the map keeps its orientation all the way from the principal point."""
    if min(pixels.shape[:2]) < 2:
        return np.isfinite(pixels).all(axis=2)
    dy, dx = np.gradient(pixels, axis=(0, 1))
    upright = dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0] > 0.0
    if upright.all():
        return upright
    labels, _ = ndimage.label(upright)
    column = int(np.clip(view.K[0, 2], 0, view.width - 1))
    row = int(np.clip(view.K[1, 2], 0, view.height - 1))
    return upright & (labels == labels[row, column])
