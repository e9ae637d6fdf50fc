"""The focal length of a photo by its EXIF data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from PIL import ExifTags

from ...errors import SceneError
from .photo import DECODE_ERRORS, read_exif
from .picture_file import open_picture

_DIAGONAL = math.hypot(36.0, 24.0)
"""Of a 35 mm film frame, in mm; equivalent focal lengths refer to it."""
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""{FocalPlaneResolutionUnit: mm}."""


def exif_focal(path: Path) -> float | None:
    """The focal length over the longer side of the picture; None if EXIF does not give it, or gives no sense.

    From the focal length that is equivalent on 35 mm film, by the diagonals of the film and of the picture as in
    COLMAP, else from the focal length and the pixels of the sensor.
    """
    try:
        with open_picture(path) as image:
            width, height = image.size
            tags = read_exif(image).get_ifd(ExifTags.IFD.Exif)
        share = _by_film(tags, width, height) or _by_sensor(tags)
    except (*DECODE_ERRORS, SceneError, TypeError, ZeroDivisionError):
        return None
    return share if share is not None and math.isfinite(share) and share > 0.0 else None


def _by_film(tags: Mapping[int, Any], width: int, height: int) -> float | None:
    equivalent = float(tags.get(ExifTags.Base.FocalLengthIn35mmFilm) or 0.0)
    return equivalent / _DIAGONAL * math.hypot(width, height) / max(width, height) or None


def _by_sensor(tags: Mapping[int, Any]) -> float | None:
    """From the size of the sensor's pixels; the picture may have been resized since."""
    names = ExifTags.Base
    if not {names.FocalLength, names.FocalPlaneXResolution, names.ExifImageWidth} <= tags.keys():
        return None
    unit = _UNITS.get(int(tags.get(names.FocalPlaneResolutionUnit) or 2), 25.4)
    pixels = float(tags[names.FocalLength]) * float(tags[names.FocalPlaneXResolution]) / unit
    return pixels / max(float(tags[names.ExifImageWidth]), float(tags.get(names.ExifImageHeight) or 0.0))
