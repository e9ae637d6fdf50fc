"""The picture of a count: the tree with every fruit outlined and numbered, for a page or a printed sheet."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ..counting.fruit import Fruit
from ..progress import Progress, silent
from ..scene.camera import Camera
from ..splatting.gaussians import Gaussians
from ..splatting.rendering.rasterize import render
from ..storage.files import replace_file
from .ellipses import Ellipse, ellipses
from .labels import Label, place_labels, round_length
from .meshes import id_color
from .words import format_three_digits, length_unit

FloatArray = NDArray[np.float64]

_PAPER = (255, 255, 255)
_INK = (32, 36, 40)
_FINE = 2
"""Pixels of the overlay per pixel of the picture, for smooth lines."""
_DASH = 9.0
"""Pixels of a dash, in a picture 1,000 high; a gap is as long."""
_FADED = 150
"""Opacity (of 255) of the outlines of hidden fruit."""
_BAR_SHARE = 0.22
"""Largest share of the picture's width for the scale bar."""
_JPEG_QUALITY = 85


def draw_still(
    gaussians: Gaussians,
    fruits: Sequence[Fruit],
    camera: Camera,
    *,
    metres_per_unit: float | None,
    title: str = "",
    progress: Progress = silent,
) -> Image.Image:
    """The view of `camera` with fruit outlined and numbered by id, hidden ones fainter and dashed; RGB.

    The picture has the camera's size, and with a `title` a band above it. White where nothing is rendered. If the scale
    is known, a bar shows it at the depth of the fruit. A number without a free place is left out, and a line says how
    many are.

    Raises:
        SceneError: the camera has distortion.
    """
    progress(0.0, "Drawing the tree")
    drawn = render(gaussians, camera, background=torch.ones(3)).color.detach().clamp(0.0, 1.0).numpy()
    picture = Image.fromarray(np.round(drawn * 255.0).astype(np.uint8))
    progress(0.5, "outlining fruit")
    outlines = ellipses(gaussians, fruits, camera)
    progress(0.8, "numbering fruit")
    overlay = _Overlay(picture)
    overlay.outline(outlines)
    taken = overlay.scale_bar(camera, _middle_depth(outlines, fruits, camera), metres_per_unit)
    overlay.number(outlines, taken)
    progress(1.0, "drawn")
    return add_title(overlay.composite(picture), title)


def save_still(path: Path, still: Image.Image) -> None:
    """Write it as JPEG, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    with replace_file(path) as temporary:
        temporary.write_bytes(jpeg(still))


def jpeg(picture: Image.Image) -> bytes:
    """The picture as a JPEG file; the same picture gives the same bytes."""
    content = io.BytesIO()
    picture.convert("RGB").save(content, "JPEG", quality=_JPEG_QUALITY, optimize=True)
    return content.getvalue()


def _middle_depth(outlines: Sequence[Ellipse], fruits: Sequence[Fruit], camera: Camera) -> float | None:
    """The depth of the scale bar: the median of the outlined fruit, else of all fruit in front of the camera."""
    depths = [outline.depth for outline in outlines]
    if not depths:
        depths = [depth for fruit in fruits if (depth := float(camera.project(fruit.center)[1])) > 0.0]
    return float(np.median(depths)) if depths else None


def add_title(picture: Image.Image, title: str) -> Image.Image:
    """Put the picture below a white band with the title, as large as fits."""
    if not title:
        return picture
    title = title.replace("–", "-")  # Pillow's own font has no en dash
    high = min(picture.height, round(0.75 * picture.width))  # a sheet of many pictures is higher
    band, margin = round(0.075 * high), round(0.02 * high)
    size = 0.6 * band
    while size > 8 and ImageFont.load_default(size).getlength(title) > picture.width - 2 * margin:
        size *= 0.9
    sheet = Image.new("RGB", (picture.width, picture.height + band), _PAPER)
    sheet.paste(picture, (0, band))
    ImageDraw.Draw(sheet).text((margin, band / 2), title, fill=_INK, font=ImageFont.load_default(size), anchor="lm")
    return sheet


class _Overlay:
    """Lines and numbers, drawn larger than the picture and then scaled down onto it.

    All positions are pixels of the picture; `unit` is a thousandth of its height.
    """

    def __init__(self, picture: Image.Image) -> None:
        self.width, self.height = picture.size
        self.unit = min(picture.size) / 1000.0
        self.layer = Image.new("RGBA", (self.width * _FINE, self.height * _FINE), (255, 255, 255, 0))
        self.canvas = ImageDraw.Draw(self.layer)
        self.font = ImageFont.load_default(max(17.0 * self.unit, 7.0) * _FINE)

    def composite(self, picture: Image.Image) -> Image.Image:
        small = self.layer.resize(picture.size, Image.Resampling.BOX)
        return Image.alpha_composite(picture.convert("RGBA"), small).convert("RGB")

    def outline(self, outlines: Sequence[Ellipse]) -> None:
        """Draw the hidden fruit first, then the others from the back to the front."""
        for outline in sorted(outlines, key=lambda each: (not each.hidden, -each.depth)):
            color = id_color(outline.id)
            points = outline.outline(96)
            if outline.hidden:
                self._draw_dashed(points, (*color, _FADED), 2.0)
            else:
                self._line([*points, *points[:2]], (*_INK, 150), 4.6)
                self._line([*points, *points[:2]], (*color, 255), 2.8)

    def number(self, outlines: Sequence[Ellipse], taken: FloatArray) -> None:
        """Number the visible fruit, nearest first, then the hidden ones."""
        ordered = sorted(outlines, key=lambda each: (each.hidden, each.depth))
        texts = [str(outline.id) for outline in ordered]
        pad = 4.0 * self.unit
        high = self._size("0123456789")[1] + 2 * pad
        sizes = np.array([[self._size(text)[0] + 2.4 * pad, high] for text in texts]).reshape(-1, 2)
        labels = place_labels(
            np.array([outline.center for outline in ordered]).reshape(-1, 2),
            np.array([outline.reach for outline in ordered]).reshape(-1, 2) + 2.0 * self.unit,
            sizes,
            width=self.width,
            height=self.height,
            taken=taken,
        )
        for label in labels:
            if label.tied:
                self._leader(label, ordered[label.index])
        for label in labels:
            self._plate(label, texts[label.index], ordered[label.index])
        if len(labels) < len(ordered):
            self._note(f"{len(ordered) - len(labels)} numbers left out for lack of space")

    def scale_bar(self, camera: Camera, depth: float | None, metres_per_unit: float | None) -> FloatArray:
        """Draw it at the lower left; returns its (1, 4) box, (0, 4) if there is none."""
        if depth is None or metres_per_unit is None:
            return np.zeros((0, 4))
        unit, of_scene = length_unit(metres_per_unit)
        pixels = float(camera.K[0, 0]) / depth / of_scene  # of one unit at that depth
        length = round_length(_BAR_SHARE * self.width / pixels)
        text = f"{format_three_digits(length)} {unit}"
        margin, thick = 24.0 * self.unit, 5.0 * self.unit
        wide = max(length * pixels, self._size(text)[0])
        box = np.array([margin, self.height - margin - 44.0 * self.unit, margin * 2 + wide, self.height - margin])
        self._draw_rounded(box, (*_PAPER, 215), None)
        left, bottom = box[0] + margin / 2, box[3] - 10.0 * self.unit
        self._rectangle([left, bottom - thick, left + length * pixels, bottom], _INK)
        self.canvas.text(
            (left * _FINE, (box[1] + 6.0 * self.unit) * _FINE), text, fill=(*_INK, 255), font=self.font, anchor="lt"
        )
        return box[None]

    def _plate(self, label: Label, text: str, outline: Ellipse) -> None:
        faint = 150 if outline.hidden else 235
        self._draw_rounded(label.box, (*_PAPER, faint), (*id_color(outline.id), _FADED if outline.hidden else 255))
        self.canvas.text(
            tuple(label.middle * _FINE), text, fill=(*_INK, 170 if outline.hidden else 255), font=self.font, anchor="mm"
        )

    def _leader(self, label: Label, outline: Ellipse) -> None:
        points = outline.outline(32)
        edge = points[np.linalg.norm(points - label.middle, axis=1).argmin()]
        shade = _FADED if outline.hidden else 230
        self._line([edge, label.middle], (*_PAPER, shade), 3.2)
        self._line([edge, label.middle], (*id_color(outline.id), shade), 1.6)

    def _note(self, text: str) -> None:
        wide, high = self._size(text)
        margin = 24.0 * self.unit
        box = np.array([self.width - 2 * margin - wide, self.height - 2 * margin - high])
        box = np.array([*box, self.width - margin, self.height - margin])
        self._draw_rounded(box, (*_PAPER, 215), None)
        self.canvas.text(tuple((box[:2] + box[2:]) / 2 * _FINE), text, fill=(*_INK, 255), font=self.font, anchor="mm")

    def _draw_dashed(self, points: FloatArray, color: tuple[int, ...], thick: float) -> None:
        closed = np.vstack([points, points[:1]])
        steps = np.linalg.norm(np.diff(closed, axis=0), axis=1)
        dashes = max(4, round(float(steps.sum()) / (2.0 * _DASH * self.unit)))
        along = np.concatenate([[0.0], np.cumsum(steps)]) / max(float(steps.sum()), 1e-9)
        for dash in range(dashes):
            shares = (dash + np.linspace(0.0, 0.5, 6)) / dashes
            self._line(np.stack([np.interp(shares, along, closed[:, axis]) for axis in range(2)], axis=1), color, thick)

    def _line(self, points: FloatArray | Sequence[FloatArray], color: tuple[int, ...], thick: float) -> None:
        pixels = max(1, round(thick * self.unit * _FINE))
        self.canvas.line([tuple(point * _FINE) for point in points], fill=color, width=pixels, joint="curve")

    def _draw_rounded(self, box: FloatArray, fill: tuple[int, ...], edge: tuple[int, ...] | None) -> None:
        radius, thick = 5.0 * self.unit * _FINE, max(1, round(1.6 * self.unit * _FINE))
        self.canvas.rounded_rectangle([*(box * _FINE)], radius, fill=fill, outline=edge, width=thick if edge else 0)

    def _rectangle(self, box: Sequence[float], color: tuple[int, ...]) -> None:
        self.canvas.rectangle([side * _FINE for side in box], fill=(*color, 255))

    def _size(self, text: str) -> tuple[float, float]:
        left, top, right, bottom = self.font.getbbox(text)
        return (right - left) / _FINE, math.ceil(bottom - top) / _FINE
