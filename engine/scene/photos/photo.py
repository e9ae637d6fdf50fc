"""Photos on disk: headers are read at once, pixels on demand, then resized and undistorted."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from ...errors import SceneError
from ..camera import Camera, FloatArray, Scene
from ..orientation import up_direction
from .lens import Lens, source_map, view_of
from .picture_file import open_picture
from .resample import WHOLE, look_up, shrink

LEAST_SIDE = 8
"""Photos with fewer pixels a side, after downscaling, are refused."""

DECODE_ERRORS = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, Image.DecompressionBombError)

_UPRIGHT: dict[int, Image.Transpose] = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""Rotation of stored pixels to upright, by EXIF orientation."""

_SKYWARD: dict[int, tuple[float, float]] = {3: (0, 1), 4: (0, 1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
"""Direction of the upright photo's top among the stored pixels (x right, y down), by EXIF orientation; else (0, -1)."""


@dataclass(frozen=True)
class Header:
    """The header of a photo: size in pixels, whether it has an alpha channel, EXIF orientation (1–8)."""

    width: int
    height: int
    has_alpha: bool
    orientation: int


def read_header(path: Path) -> Header:
    """Read a photo's header without decoding it.

    Raises:
        SceneError: the file is missing, is not a picture, or is a RAW file.
    """
    try:
        with open_picture(path) as image:
            orientation = read_exif(image).get(ExifTags.Base.Orientation, 1)
            has_alpha = "A" in image.getbands() or "transparency" in image.info
            return Header(image.width, image.height, has_alpha, orientation if orientation in range(1, 9) else 1)
    except DECODE_ERRORS as error:
        raise SceneError(f"{path} cannot be read as a picture ({error}). Replace the file") from error


def read_exif(image: Image.Image) -> Image.Exif:
    """The EXIF tags of an open picture, empty without any; nothing is decoded for it."""
    exif_is_near = image.format != "PNG" or "exif" in image.info  # otherwise Pillow decodes the PNG to find it
    return image.getexif() if exif_is_near else Image.Exif()


@dataclass(frozen=True)
class FilePhoto:
    """A photo in a file, decoded, resized and undistorted each time it is loaded.

    name: in the model (a cube face of a panorama adds `@face`); header: of the stored file; turn: rotation of the
    stored pixels to the calibrated photo, None without one; width, height: pixels after the resize, before
    undistorting; mask_path: a picture whose black pixels may not be used.
    """

    name: str
    path: Path
    header: Header
    lens: Lens
    width: int
    height: int
    face: str = ""
    turn: Image.Transpose | None = None
    mask_path: Path | None = None

    @property
    def is_as_stored(self) -> bool:
        """True if the pixels of the file are the view: no rotation and no distortion, whatever its size."""
        return self.lens.is_pinhole and self.turn is None

    def pixels(self) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB of the undistorted view; black outside the photo.

        Raises:
            SceneError: the file is gone, truncated or not the one whose header was read.
        """
        image = shrink(_rgb(self._decode(self.path), self.path).astype(np.float32), self.width, self.height)
        if not self.lens.is_pinhole:
            image = look_up(image, source_map(self.lens, self.face, self.width, self.height))
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def mask(self) -> NDArray[np.bool_] | None:
        """(H, W) True where the view may be used: mask file, alpha channel and lens all allow it; None if all may.

        Raises:
            SceneError: as `pixels`, or the mask has another shape than the photo.
        """
        covers = []
        if self.mask_path is not None:
            covers.append(_not_black(self._decode(self.mask_path), self.mask_path))
        if self.header.has_alpha:
            covers.append(np.asarray(self._decode(self.path).convert("RGBA"))[..., 3] >= 128)
        shares = [shrink(cover[..., None].astype(np.float32), self.width, self.height) for cover in covers]
        if self.lens.is_pinhole:
            usable = [share[..., 0] > WHOLE for share in shares]
        else:
            source = source_map(self.lens, self.face, self.width, self.height)
            usable = [source.valid, *(look_up(share, source)[..., 0] > WHOLE for share in shares)]
        everywhere = np.logical_and.reduce(usable) if usable else None
        return None if everywhere is None or everywhere.all() else everywhere

    def _decode(self, path: Path) -> Image.Image:
        try:
            with open_picture(path) as image:
                image.load()
                decoded = image.copy()
        except DECODE_ERRORS as error:
            raise SceneError(f"{path} cannot be decoded ({error}). Replace the file") from error
        if path == self.path and decoded.size != (self.header.width, self.header.height):
            raise SceneError(f"{path} changed its size to {decoded.width}x{decoded.height}. Read the scene again")
        return decoded if self.turn is None else decoded.transpose(self.turn)


def _not_black(image: Image.Image, path: Path) -> NDArray[np.bool_]:
    """(H, W) True where a mask picture of any mode is not black."""
    darkest = 127 if path.suffix.lower() in (".jpg", ".jpeg") else 0  # JPEG blurs black
    if image.mode not in ("1", "L") and not image.mode.startswith("I"):
        return (np.asarray(image.convert("RGB")) > darkest).any(axis=2)
    return np.asarray(image) > darkest


def _rgb(image: Image.Image, path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) 8-bit sRGB of any picture Pillow decodes."""
    if image.mode == "F":
        raise SceneError(f"{path} holds floating-point pixels of unknown range. Save it with 8 or 16 bits a channel")
    if image.mode.startswith("I"):  # 16-bit grey
        grey = np.clip(np.rint(np.asarray(image, dtype=np.float64) / 257.0), 0, 255).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=2)
    if image.mode in ("P", "PA"):
        image = image.convert("RGBA")
    return np.asarray(image.convert("RGB"))


@dataclass(frozen=True, eq=False)
class PosedPhoto:
    """One view of a scene: its camera, its photo and the direction of the photo's top, (3,) in the camera frame."""

    camera: Camera
    photo: FilePhoto
    skyward: FloatArray


def read_posed_photos(
    path: Path,
    *,
    name: str,
    lens: Lens,
    world_to_camera: FloatArray,
    mask_path: Path | None = None,
    downscale: float = 1.0,
    max_side: int = 0,
) -> list[PosedPhoto]:
    """Read the views of one photo: one, or the six cube faces of a panorama. Only headers are read.

    downscale: divide width and height by this; max_side: and by more if a side would still be longer (0: no limit). The
    photo may be a resized copy of the calibrated one (same shape, other number of pixels), or, if only that fits, its
    EXIF orientation is applied; otherwise EXIF orientation is ignored, as COLMAP does.

    Raises:
        SceneError: the photo or mask is not a picture, its shape is not its camera's, or it has too few pixels.
    """
    header = read_header(path)
    turn = None
    width, height = header.width, header.height
    if not same_shape(width, height, lens.width, lens.height):
        if header.orientation < 5 or not same_shape(height, width, lens.width, lens.height):
            raise SceneError(
                f"{path} has {width}x{height} pixels but its camera {lens.width}x{lens.height}, another shape. "
                "Give the photos that the model was made from, whole or evenly resized"
            )
        turn, width, height = _UPRIGHT[header.orientation], height, width
    if mask_path is not None:
        mask = read_header(mask_path)
        if not same_shape(mask.width, mask.height, header.width, header.height):
            raise SceneError(
                f"Mask {mask_path} has {mask.width}x{mask.height} pixels but its photo {header.width}x{header.height}. "
                "Make the mask for this photo"
            )
    skyward = np.array([*_SKYWARD.get(1 if turn is not None else header.orientation, (0.0, -1.0)), 0.0])
    if max_side > 0:
        downscale = max(downscale, max(width, height) / max_side)
    width, height = round(width / downscale), round(height / downscale)
    if min(width, height) < LEAST_SIDE:
        raise SceneError(
            f"{path} is read with {width}x{height} pixels, too few to count on. Give photos, and a"
            f" --scene.downscale, that leave at least {LEAST_SIDE} a side"
        )
    posed = []
    for face in lens.faces:
        view = view_of(lens, face, width, height)
        pose = np.eye(4)
        pose[:3, :3] = view.rotation
        camera = Camera(K=view.K, world_to_camera=pose @ world_to_camera, width=view.width, height=view.height)
        photo = FilePhoto(
            name=f"{name}@{face}" if face else name,
            path=path,
            header=header,
            lens=lens,
            width=width,
            height=height,
            face=face,
            turn=turn,
            mask_path=mask_path,
        )
        posed.append(PosedPhoto(camera=camera, photo=photo, skyward=view.rotation @ skyward))
    return posed


def make_scene(views: Sequence[PosedPhoto], points: FloatArray, colors: NDArray[np.uint8]) -> Scene:
    """A scene of views in the given order, with its up direction estimated from them."""
    cameras = [view.camera for view in views]
    return Scene(
        cameras=cameras,
        images=[view.photo for view in views],
        points=points,
        colors=colors,
        up=up_direction(cameras, [view.skyward for view in views]),
    )


def same_shape(width: int, height: int, other_width: int, other_height: int) -> bool:
    """True when one size is the other, scaled evenly and rounded to whole pixels."""
    return abs(width / other_width - height / other_height) <= 1.0 / other_width + 1.0 / other_height
