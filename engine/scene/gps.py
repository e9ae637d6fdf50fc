"""Positions of photos from the GPS tags in their EXIF data, and the scale they give."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import ExifTags

from ..errors import FormatError, SceneError
from .alignment import OUTLIER, Similarity, align
from .camera import Camera, FloatArray, Photo
from .photos.photo import DECODE_ERRORS, FilePhoto, read_exif
from .photos.picture_file import open_picture
from .scale import Scale

LEAST_TAGGED = 4
"""Fewest tagged photos that give a scale."""
LARGEST_ERROR = 0.05
"""Relative standard error of the scale above which GPS is not used."""
LEAST_SPREAD = 0.5
"""Least extent of the tagged positions in metres; less is one position."""
LARGEST_MISFIT = 0.3
"""Median misfit of tags, in the mean distance of the tagged photos from their middle, from which they place no tree."""
_INDEPENDENT = 5
"""Most positions whose errors count as independent."""
_EQUATOR, _FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""WGS84's semi-major axis in metres and its flattening."""


@dataclass(frozen=True)
class GpsTag:
    """A position on WGS84: degrees north, degrees east, metres above the ellipsoid or the sea (None: not tagged)."""

    latitude: float
    longitude: float
    altitude: float | None


@dataclass(frozen=True, kw_only=True)
class GpsScale:
    """The scale from GPS, None if it is not reliable, and messages for the user."""

    scale: Scale | None = None
    notices: Sequence[str] = ()


def read_gps(path: Path) -> GpsTag | None:
    """The position in a photo's EXIF data; None if it has none or the receiver had no fix.

    Raises:
        FormatError: the tags make no sense.
    """
    try:
        with open_picture(path) as image:
            tags = read_exif(image).get_ifd(ExifTags.IFD.GPSInfo)
        if not tags or tags.get(ExifTags.GPS.GPSStatus) == "V":
            return None
        if not {ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLongitude} <= tags.keys():
            return None
        latitude = _degrees(tags[ExifTags.GPS.GPSLatitude], tags.get(ExifTags.GPS.GPSLatitudeRef, "N"), 90.0)
        longitude = _degrees(tags[ExifTags.GPS.GPSLongitude], tags.get(ExifTags.GPS.GPSLongitudeRef, "E"), 180.0)
        altitude = tags.get(ExifTags.GPS.GPSAltitude)
        if altitude is not None:
            below = tags.get(ExifTags.GPS.GPSAltitudeRef, b"\0") in (b"\1", 1, "\1")
            altitude = _finite(-float(altitude) if below else float(altitude))
    except (*DECODE_ERRORS, TypeError, KeyError, AttributeError, ZeroDivisionError) as error:
        raise FormatError(f"The GPS tags of {path} make no sense ({error}). Check them in a viewer") from error
    if latitude == longitude == 0.0:  # what cameras write before they have a fix
        return None
    return GpsTag(latitude, longitude, altitude)


def _degrees(parts: Sequence[float], reference: str, largest: float) -> float:
    """Degrees, minutes and seconds as degrees; south and west are negative."""
    degrees, minutes, seconds = map(float, parts)
    angle = _finite(degrees + minutes / 60.0 + seconds / 3600.0)
    if not 0.0 <= angle <= largest or reference.strip("\0 ") not in ("N", "S", "E", "W"):
        raise ValueError(f"{angle:g} degrees {reference!r}")
    return -angle if reference.strip("\0 ") in ("S", "W") else angle


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f"{value} is not a number")
    return value


def local_metres(tags: Sequence[GpsTag]) -> FloatArray:
    """(N, 3) metres to the east, to the north and up of the tags' mean place.

    By way of WGS84's geocentric coordinates: with φ, λ, h and N(φ) = a / √(1 - e² sin² φ), x = (N + h) cos φ cos λ,
    y = (N + h) cos φ sin λ, z = (N (1 - e²) + h) sin φ (Hofmann-Wellenhof, Lichtenegger & Wasle, GNSS, 2008). A tag
    without altitude has that of the ellipsoid.
    """
    latitude, longitude, altitude = np.array([(t.latitude, t.longitude, t.altitude or 0.0) for t in tags]).T
    phi, lam = np.radians(latitude), np.radians(longitude)
    squared = _FLATTENING * (2.0 - _FLATTENING)
    normal = _EQUATOR / np.sqrt(1.0 - squared * np.sin(phi) ** 2)
    flat = (normal + altitude) * np.cos(phi)
    places = np.stack([flat * np.cos(lam), flat * np.sin(lam), (normal * (1.0 - squared) + altitude) * np.sin(phi)], 1)
    middle = places.mean(0)
    lam0 = np.arctan2(middle[1], middle[0])
    phi0 = phi.mean()
    east = np.array([-np.sin(lam0), np.cos(lam0), 0.0])
    up = np.array([np.cos(phi0) * np.cos(lam0), np.cos(phi0) * np.sin(lam0), np.sin(phi0)])
    return (places - middle) @ np.stack([east, np.cross(up, east), up], 1)


def degrees_of(points: FloatArray, centers: FloatArray, tags: Sequence[GpsTag], up: FloatArray) -> FloatArray | None:
    """(P, 2) latitude and longitude of points (P, 3) of a scene in which photos with these tags were taken at centers
    (N, 3); None if the tags are too inaccurate for the length of the way, or all of one place.

    On the level, north and east are a turned, scaled and moved copy of the scene, fitted by least squares: that takes
    two places, and those of a flight may lie on one line. up: (3,) unit, away from the ground.
    """
    axes = np.linalg.svd(np.asarray(up)[None])[2][1:]
    axes[1] = np.cross(up, axes[0])
    scene, asked = ((each @ axes.T) @ [1.0, 1.0j] for each in (centers, points))
    places = local_metres(tags)[:, :2] @ [1.0, 1.0j]
    used = np.ones(len(tags), bool)
    for _ in range(2):
        middle, mean = scene[used].mean(), places[used].mean()
        spread = float(np.linalg.norm(scene[used] - middle))
        if spread == 0.0:
            return None
        turn = np.vdot(scene[used] - middle, places[used] - mean) / spread**2
        misfits = np.abs(places - mean - turn * (scene - middle))
        used = misfits <= max(OUTLIER * float(np.median(misfits)), 1e-9)
    if float(np.median(misfits)) > LARGEST_MISFIT * float(np.abs(turn)) * spread / np.sqrt(used.sum()):
        return None
    latitude = np.radians(np.mean([tag.latitude for tag in tags]))
    squared = _FLATTENING * (2.0 - _FLATTENING)
    shrink = 1.0 - squared * np.sin(latitude) ** 2
    metres = mean + turn * (asked - middle)
    north = np.degrees(metres.imag * shrink**1.5 / (_EQUATOR * (1.0 - squared)))
    east = np.degrees(metres.real * shrink**0.5 / (_EQUATOR * np.cos(latitude)))
    origin = [np.mean([tag.latitude for tag in tags]), np.mean([tag.longitude for tag in tags])]
    return np.stack([north, east], axis=1) + origin


def scale_by_gps(cameras: Sequence[Camera], photos: Sequence[Photo]) -> GpsScale:
    """The scale of the similarity that maps the cameras best to the positions in their photos' EXIF data (see `align`).

    Photos without altitude are left out if others have one; if none has, all are assumed to be at one height. Without
    any tag there is neither scale nor notice; fewer than 4 tags, a single position or an error above 5 % gives a
    notice.

    cameras and photos: one each per view, in the order of capture.
    """
    tagged = _collect_tags(cameras, photos)
    if not tagged.tags:
        return GpsScale(notices=tagged.notices)
    refusal = f"the GPS tags of {len(tagged.tags)} photos tell no scale"
    try:
        places = _spread_places(tagged.tags)
        found = align(tagged.centers, places)
    except SceneError as failure:
        return GpsScale(notices=[*tagged.notices, f"{refusal}: {failure}"])
    error = _standard_error(found, tagged.centers, places)
    if error > LARGEST_ERROR * found.scale:
        misfit = f"{refusal}: its standard error would be {error / found.scale:.0%}; --units.length gives it"
        return GpsScale(notices=[*tagged.notices, misfit])
    of = f"the GPS tags of {len(tagged.tags)} photos"
    scale = Scale(metres_per_unit=found.scale, measure="gps", of=of, standard_error=error)
    return GpsScale(scale=scale, notices=tagged.notices)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Tagged:
    """Photos with a position: (N, 3) centres of their cameras, and N tags."""

    centers: FloatArray
    tags: Sequence[GpsTag]
    notices: Sequence[str]


def _collect_tags(cameras: Sequence[Camera], photos: Sequence[Photo]) -> _Tagged:
    """Collect one entry per file: the faces of a panorama are one measurement."""
    centers: dict[Path, FloatArray] = {}
    tags: dict[Path, GpsTag] = {}
    senseless = []
    for camera, photo in zip(cameras, photos, strict=True):
        if not isinstance(photo, FilePhoto) or photo.path in centers:
            continue
        centers[photo.path] = camera.center
        try:
            tag = read_gps(photo.path)
        except FormatError as error:
            senseless.append(str(error))
            continue
        if tag is not None:
            tags[photo.path] = tag
    if any(tag.altitude is not None for tag in tags.values()):
        tags = {path: tag for path, tag in tags.items() if tag.altitude is not None}
    return _Tagged(
        centers=np.array([centers[path] for path in tags]).reshape(-1, 3),
        tags=list(tags.values()),
        notices=[f"{senseless[0]} (photos left out of the scale: {len(senseless)})"] if senseless else [],
    )


def _spread_places(tags: Sequence[GpsTag]) -> FloatArray:
    """(N, 3) metres, after checking that they are enough and apart from each other.

    Raises:
        SceneError: there are not.
    """
    if len(tags) < LEAST_TAGGED:
        raise SceneError(f"at least {LEAST_TAGGED} are needed")
    places = local_metres(tags)
    if np.linalg.norm(places - places.mean(0), axis=1).max() < LEAST_SPREAD:
        raise SceneError("all are of one place")
    return places


def _standard_error(similarity: Similarity, centers: FloatArray, places: FloatArray) -> float:
    """Standard error of the scale s of the similarity: √(Σ|r|² / Σ|x|² / (3m - 7)), with misfits r and centres x about
    their mean.

    With m independent positions of three numbers each, this is the error of least squares with seven unknowns. The
    errors of a receiver drift, and consecutive photos share them, so m is at most 5. A misfit beyond five times the
    median, which `align` leaves out, counts as five times the median.
    """
    misfits = np.linalg.norm(similarity.apply(centers) - places, axis=1)
    misfits = np.minimum(misfits, OUTLIER * np.median(misfits))
    independent = min(len(centers), _INDEPENDENT)
    spread = np.square(centers - centers.mean(0)).sum()
    return float(np.sqrt(np.square(misfits).sum() / spread / (3 * independent - 7)))
