"""What the check keeps of each photo: read once, at a reduced size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageFilter, ImageOps

from ..errors import SceneError
from ..scene.photos.photo import DECODE_ERRORS, read_exif
from ..scene.photos.picture_file import convert_to_rgb, open_picture
from .features import Features, find_features
from .sharpness import sharpness

DETAIL_SIDE = 1280
"""Longer side in pixels of the copy whose sharpness is measured."""
FEATURE_SIDE = 640
"""Longer side in pixels of the copy whose features are matched."""
THUMBNAIL_SIDE = 240
_COLOUR_BLUR = 3
"""Radius in pixels over which colours are averaged before photos are compared."""


@dataclass(frozen=True, kw_only=True)
class CameraTags:
    """The camera of a photo by its EXIF data: model, empty if unknown, and focal length in mm, 0 if unknown."""

    model: str = ""
    focal: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Examined:
    """A photo: its upright size in pixels, camera, sharpness, brightness in [0, 1] (median, linear), features with
    the (N, 3) linear colours around them, and a small picture."""

    path: Path
    width: int
    height: int
    camera: CameraTags
    sharpness: float
    brightness: float
    features: Features
    colors: NDArray[np.float32]
    thumbnail: Image.Image


def examine(path: Path) -> Examined:
    """Read a photo.

    Raises:
        SceneError: it cannot be decoded.
    """
    picture, size, camera = _open(path, DETAIL_SIDE)
    width, height = sorted(size, reverse=picture.width >= picture.height)
    detail, small = _reduce(picture, DETAIL_SIDE), _reduce(picture, FEATURE_SIDE)
    features = find_features(np.asarray(small.convert("L")))
    linear = _linear(np.asarray(small.filter(ImageFilter.BoxBlur(_COLOUR_BLUR))))
    columns, rows = np.clip(features.points, 0, [small.width - 1, small.height - 1]).astype(np.intp).T
    return Examined(
        path=path,
        width=width,
        height=height,
        camera=camera,
        sharpness=sharpness(np.asarray(detail.convert("L"), dtype=np.float32)),
        brightness=float(np.median(linear.mean(axis=2))),
        features=features,
        colors=linear[rows, columns],
        thumbnail=_reduce(small, THUMBNAIL_SIDE),
    )


def read_reduced(path: Path, side_of: Callable[[float], float]) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB of a photo whose longer side is changed by `side_of`, pixels.

    Raises:
        SceneError: it cannot be decoded.
    """
    picture, size, _ = _open(path)
    return np.asarray(_reduce(picture, max(round(side_of(max(size))), 1)))


def _open(path: Path, enough: int | None = None) -> tuple[Image.Image, tuple[int, int], CameraTags]:
    """Open a photo: the picture, upright, its size in the file and its camera. enough: longer side in pixels that may
    be read instead."""
    try:
        with open_picture(path) as opened:
            size, camera = opened.size, _camera_tags(opened)
            if enough is not None:
                opened.draft("RGB", (enough, enough))  # JPEG decodes faster at a reduced size
            turned = ImageOps.exif_transpose(opened)
            return convert_to_rgb(turned if turned is not None else opened), size, camera
    except DECODE_ERRORS as error:
        raise SceneError(f"{path} cannot be decoded ({error}). Replace it, or save it as JPEG") from error


def _reduce(picture: Image.Image, side: int) -> Image.Image:
    """Reduce the picture to sides of at most this many pixels."""
    share = side / max(picture.size)
    if share >= 1.0:
        return picture
    size = max(round(picture.width * share), 1), max(round(picture.height * share), 1)
    return picture.resize(size, Image.Resampling.BOX if share < 0.25 else Image.Resampling.BICUBIC)


def _linear(srgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Linear values in [0, 1] of sRGB bytes (IEC 61966-2-1)."""
    share = np.arange(256) / 255.0
    table = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[srgb]


def _camera_tags(picture: Image.Image) -> CameraTags:
    """Unreadable tags are left out."""
    try:
        exif = read_exif(picture)
        tags: Any = exif.get_ifd(ExifTags.IFD.Exif)
        focal = float(tags.get(ExifTags.Base.FocalLengthIn35mmFilm) or tags.get(ExifTags.Base.FocalLength) or 0.0)
        return CameraTags(model=str(exif.get(ExifTags.Base.Model, "")).strip("\0 "), focal=round(focal, 1))
    except (*DECODE_ERRORS, TypeError, KeyError, ZeroDivisionError):
        return CameraTags()
