"""Examples that were marked in photos: clicks, boxes and masks → Gaussians of the scene.

Pixels are those of a photo as its file shows it, x right and y down from its upper left corner.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from ...errors import FormatError, SceneError, VocabularyError
from ...scene.camera import Camera, Photo, Scene
from ...scene.photos.lens import source_map
from ...scene.photos.photo import FilePhoto
from ...scene.photos.picture_file import open_picture
from ...scene.photos.resample import look_up, shrink
from ...splatting.gaussians import Gaussians
from ...splatting.rendering.rasterize import accumulate
from ..taught.name import word_name
from ..taught.word import THUMBNAIL
from .lesson import Mark
from .ray_hits import pick_surface
from .region import Ground

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_SPELLED = re.compile(r"(.+):\s*(-?\d+(?:\.\d+)?)\s*,\s*(-?\d+(?:\.\d+)?)")
CENTRAL = 0.6
"""Share of a box that is certainly its object, as an ellipse."""
LEAST_SHARE, LEAST_PIXELS = 0.7, 1.0
"""Share of a Gaussian's pixels in a photo that an area must have, and how many pixels these are at least."""
LYING = tuple(getattr(Image.Transpose, name) for name in ("TRANSPOSE", "ROTATE_90", "ROTATE_270", "TRANSVERSE"))
"""Turns that exchange width and height."""
CUT = 0.08
"""Side of a thumbnail, in longer sides of the photo."""


@dataclass(frozen=True)
class Click:
    """positive: it shows the word; photo: its name; x, y: pixels."""

    positive: bool
    photo: str
    x: float
    y: float

    @classmethod
    def read(cls, text: str, *, positive: bool) -> Click:
        """From "IMG_12.jpg:1034,887".

        Raises:
            VocabularyError: it is not spelled so.
        """
        found = _SPELLED.fullmatch(text.strip())
        if found is None:
            raise VocabularyError(f"'{text}' is not a place in a photo. Write PHOTO:X,Y, as in IMG_12.jpg:1034,887")
        return cls(positive, found[1].strip(), float(found[2]), float(found[3]))

    @property
    def place(self) -> str:
        """As it is written."""
        return f"{self.photo}:{self.x:g},{self.y:g}"


def marks_of_clicks(clicks: Sequence[Click], scene: Scene, gaussians: Gaussians, ground: Ground) -> list[Mark]:
    """The regions around clicks.

    Raises:
        SceneError: a photo is not part of the scene, or a click lies outside it or shows nothing.
    """
    means, scales, quats, opacities = (
        getattr(gaussians, name).detach().cpu().numpy() for name in ("means", "scales", "quats", "opacities")
    )
    marks = []
    for click in clicks:
        view = find_photo(scene, click.photo)
        camera, photo = scene.cameras[view], scene.images[view]
        u, v = locate_pixel(photo, camera, click.x, click.y)
        hit = pick_surface(*ray_through(camera, u, v), means, scales, quats, opacities.reshape(-1))
        if hit is None:
            raise SceneError(f"{click.place} shows nothing that was reconstructed. Click on the tree or on the ground")
        marks.append(Mark(click.positive, click.place, ground.grow_region(hit), _cut_thumbnail(photo.pixels(), u, v)))
    return marks


def find_photo(scene: Scene, name: str) -> int:
    """Find the view of a photo, by its name in the scene or by the name of its file, with or without suffix.

    Raises:
        SceneError: there is none, or more than one.
    """
    if len(scene.images) != len(scene.cameras):
        raise SceneError("The photos of this result are missing. Put them back to where they were counted")
    names = [photo.name for photo in scene.images]
    for known in (names, [PurePosixPath(each).name for each in names], [PurePosixPath(each).stem for each in names]):
        found = [view for view, each in enumerate(known) if each == name]
        if len(found) == 1:
            return found[0]
        if found:
            raise SceneError(f"{len(found)} photos are named '{name}'. Give the name with its folder")
    raise SceneError(f"No photo is named '{name}'. The scene has {names[0]} to {names[-1]}")


def locate_pixel(photo: Photo, camera: Camera, x: float, y: float) -> tuple[float, float]:
    """Find where a camera sees a pixel of its photo.

    Raises:
        SceneError: the pixel lies outside the photo, or outside what the camera sees of it.
    """
    if not isinstance(photo, FilePhoto):
        width, height = photo.pixels().shape[1::-1]
        resized = camera.width, camera.height
    else:
        width, height = _shown_size(photo)
        resized = photo.width, photo.height
    if not (0.0 <= x <= width and 0.0 <= y <= height):
        raise SceneError(f"{photo.name} has {width}x{height} pixels, so {x:g},{y:g} lies outside")
    u, v = x * resized[0] / width, y * resized[1] / height
    if not isinstance(photo, FilePhoto) or photo.lens.is_pinhole:
        return u, v
    source = source_map(photo.lens, photo.face, photo.width, photo.height)
    away = np.where(source.valid, np.linalg.norm(source.pixels - np.array([u, v], np.float32), axis=2), np.inf)
    row, column = np.unravel_index(int(away.argmin()), away.shape)
    if away[row, column] > 2.0:
        raise SceneError(f"The camera of {photo.name} does not cover {x:g},{y:g}. Choose a place nearer to its middle")
    return float(column) + 0.5, float(row) + 0.5


def ray_through(camera: Camera, u: float, v: float) -> tuple[FloatArray, FloatArray]:
    """Origin (3,) and unit direction (3,) of the ray through a pixel."""
    direction = np.linalg.inv(camera.K) @ [u, v, 1.0] @ camera.world_to_camera[:3, :3]
    return camera.center, direction / np.linalg.norm(direction)


def marks_of_boxes(file: Path, word: str, scene: Scene, gaussians: Gaussians, ground: Ground) -> list[Mark]:
    """The central parts of boxes. file: a CSV with image, xmin, ymin, xmax, ymax in pixels and, if it has one, label:
    boxes of other labels than the word are negative examples.

    Raises:
        FormatError: the file is missing or cannot be read.
        SceneError: a photo is not part of the scene.
    """
    boxes: dict[int, list[tuple[bool, list[float]]]] = {}
    for row in _rows(file):
        own = not row.get("label") or word_name(row["label"]) == word
        corners = [float(row[name]) for name in ("xmin", "ymin", "xmax", "ymax")]
        boxes.setdefault(find_photo(scene, row["image"]), []).append((own, corners))
    marks = []
    for view, own_boxes in sorted(boxes.items()):
        photo = scene.images[view]
        areas = np.zeros(_shown_size(photo)[::-1], np.int32)
        for number, (_, corners) in enumerate(own_boxes, start=1):
            areas[_ellipse(corners, areas.shape)] = number
        for number, rows in _gaussians_of(areas, view, scene, gaussians, ground).items():
            own, corners = own_boxes[number - 1]
            place = f"{photo.name}:{sum(corners[::2]) / 2:g},{sum(corners[1::2]) / 2:g}"
            marks.append(Mark(own, place, rows))
    if not marks:
        raise SceneError(f"No box of {file} covers anything that was reconstructed. Check its pixels")
    return marks


def _rows(file: Path) -> list[dict[str, str]]:
    """Raises FormatError."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as opened:
            rows = list(csv.DictReader(opened))
        for number, row in enumerate(rows, start=2):
            missing = [name for name in ("image", "xmin", "ymin", "xmax", "ymax") if not row.get(name)]
            if missing:
                raise ValueError(f"line {number} has no {missing[0]}")
            if not all(np.isfinite(float(row[name])) for name in ("xmin", "ymin", "xmax", "ymax")):
                raise ValueError(f"line {number} has a corner that is not a number")
            if float(row["xmax"]) <= float(row["xmin"]) or float(row["ymax"]) <= float(row["ymin"]):
                raise ValueError(f"the box of line {number} has no area")
            if row.get("label"):
                word_name(row["label"])
        if not rows:
            raise ValueError("it lists no box")
    except (OSError, ValueError, csv.Error, VocabularyError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FormatError(
            f"{file} cannot be read ({reason}). Give a table with the columns image, xmin, ymin, xmax, ymax"
        ) from error
    return rows


def marks_of_masks(folder: Path, scene: Scene, gaussians: Gaussians, ground: Ground) -> list[Mark]:
    """The white parts of mask pictures, each named as its photo, with any suffix, and of its size.

    Raises:
        FormatError: there is none, or one cannot be read or has another size.
        SceneError: a picture belongs to no photo.
    """
    pictures = sorted(
        path for path in folder.glob("*") if path.suffix.lower() in (".png", ".jpg", ".jpeg", ".tif", ".tiff")
    )
    if not pictures:
        raise FormatError(f"{folder} has no mask pictures. Give a folder with a .png a photo, white on the fruit")
    marks = []
    for picture in pictures:
        view = find_photo(scene, picture.stem)
        photo = scene.images[view]
        try:
            with open_picture(picture) as image:
                white = np.asarray(image.convert("L")) > 127
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise FormatError(f"{picture} cannot be read as a picture ({error}). Replace it") from error
        if white.shape != _shown_size(photo)[::-1]:
            raise FormatError(f"{picture} has another size than {photo.name}. Save it in the size of the photo")
        areas, _ = ndimage.label(white)
        for number, rows in _gaussians_of(areas.astype(np.int32), view, scene, gaussians, ground).items():
            marks.append(Mark(True, f"{picture.name}, area {number}", rows))
    if not marks:
        raise SceneError(f"No white area of {folder} covers anything that was reconstructed. Check the pictures")
    return marks


def _gaussians_of(
    areas: NDArray[np.int32], view: int, scene: Scene, gaussians: Gaussians, ground: Ground
) -> Mapping[int, IntArray]:
    """Of each numbered area of a photo the Gaussians that show little else, as places in `ground.rows`."""
    camera, photo = scene.cameras[view], scene.images[view]
    covered = _warp_to_view((areas > 0)[..., None].astype(np.float32), photo, camera)
    target = torch.from_numpy(np.ascontiguousarray(covered))
    drawn = accumulate(gaussians, camera, target)
    inside, whole = drawn.sums[:, 0].numpy()[ground.rows], drawn.weights.numpy()[ground.rows]
    chosen = np.flatnonzero((inside >= LEAST_SHARE * whole) & (inside >= LEAST_PIXELS))
    points = ground.means[chosen] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = points @ camera.K.T
    columns, rows = np.floor(pixels[:, :2] / np.maximum(pixels[:, 2:], 1e-12)).astype(np.int64).T
    numbers = _warp_numbers(areas, photo, camera)
    fits = (columns >= 0) & (rows >= 0) & (columns < camera.width) & (rows < camera.height)
    found = numbers[rows[fits], columns[fits]]
    return {int(number): chosen[fits][found == number] for number in np.unique(found[found > 0])}


def _warp_to_view(values: NDArray[np.float32], photo: Photo, camera: Camera) -> NDArray[np.float32]:
    """Warp (H, W, C) of a photo as its file shows it to the view of its camera."""
    if not isinstance(photo, FilePhoto):
        return shrink(values, camera.width, camera.height)
    resized = shrink(values, photo.width, photo.height)
    if photo.lens.is_pinhole:
        return resized
    return look_up(resized, source_map(photo.lens, photo.face, photo.width, photo.height))


def _warp_numbers(areas: NDArray[np.int32], photo: Photo, camera: Camera) -> NDArray[np.int32]:
    """Find the number of the area at each pixel of the view: the nearest."""
    height, width = areas.shape
    if isinstance(photo, FilePhoto) and not photo.lens.is_pinhole:
        source = source_map(photo.lens, photo.face, photo.width, photo.height)
        places = source.pixels * [width / photo.width, height / photo.height]
        columns = np.clip(places[..., 0].astype(int), 0, width - 1)
        rows = np.clip(places[..., 1].astype(int), 0, height - 1)
        return np.where(source.valid, areas[rows, columns], 0).astype(np.int32)
    rows = ((np.arange(camera.height) + 0.5) * height / camera.height).astype(int)
    columns = ((np.arange(camera.width) + 0.5) * width / camera.width).astype(int)
    return areas[rows[:, None], columns]


def _shown_size(photo: Photo) -> tuple[int, int]:
    """Width and height of a photo as its file shows it, turned as its camera model wants it."""
    if not isinstance(photo, FilePhoto):
        height, width = photo.pixels().shape[:2]
        return width, height
    stored = photo.header.width, photo.header.height
    return (stored[1], stored[0]) if photo.turn in LYING else stored


def _ellipse(corners: Sequence[float], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """(H, W) the central part of a box: left, top, right, bottom."""
    left, top, right, bottom = corners
    y, x = np.ogrid[: shape[0], : shape[1]]
    across = (x + 0.5 - (left + right) / 2) / max(CENTRAL * (right - left) / 2, 0.5)
    down = (y + 0.5 - (top + bottom) / 2) / max(CENTRAL * (bottom - top) / 2, 0.5)
    inside: NDArray[np.bool_] = across**2 + down**2 <= 1.0
    return inside


def _cut_thumbnail(pixels: NDArray[np.uint8], u: float, v: float) -> Tensor:
    """Cut out the surroundings of a pixel of a view, (THUMBNAIL, THUMBNAIL, 3) uint8."""
    half = max(8, round(CUT * max(pixels.shape[:2]) / 2))
    padded = np.pad(pixels, ((half, half), (half, half), (0, 0)), mode="edge")
    part = torch.from_numpy(padded[int(v) : int(v) + 2 * half, int(u) : int(u) + 2 * half].copy())
    image = part.permute(2, 0, 1)[None].float()
    small = functional.interpolate(image, (THUMBNAIL, THUMBNAIL), mode="bilinear", antialias=True)
    return small[0].permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8)
