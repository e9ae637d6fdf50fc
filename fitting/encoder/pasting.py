"""Fruit and objects cut out of one picture and pasted into another, so that the network learns the fruit and not its
tree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from ...engine.language.vocabulary import CONCEPTS, FRUITS
from .pictures import IGNORED, Box, Labels, Picture

ALPHA_SHARE = 0.92
LABEL_SHARE = 0.78
TURNS = (None, Image.Transpose.FLIP_LEFT_RIGHT, Image.Transpose.ROTATE_90, Image.Transpose.ROTATE_180)
"""Share of a photo's box whose ellipse is pasted, and share of that which is certainly fruit."""


@dataclass(frozen=True, eq=False)
class Cutout:
    """pixels: (h, w, 4) sRGB and opacity; labels: (h, w) the index of its word where certain, else IGNORED."""

    pixels: NDArray[np.uint8]
    labels: Labels
    concept: int
    source: str


def cut_fruit(pictures: Sequence[Picture], *, smallest: int = 14) -> list[list[Cutout]]:
    """Fully visible fruit by concept: whole instances of renders, ellipses in the boxes of photos."""
    bank: list[list[Cutout]] = [[] for _ in FRUITS]
    for picture in pictures:
        found = _cut_from_boxes(picture, smallest) if picture.instances is None else _cut_from_masks(picture, smallest)
        for cutout in found:
            bank[cutout.concept].append(cutout)
    return bank


def _cut_from_boxes(picture: Picture, smallest: int) -> list[Cutout]:
    height, width = picture.labels.shape
    cutouts = []
    for box in picture.boxes:
        left, top, right, bottom = round(box.left), round(box.top), round(box.right), round(box.bottom)
        if min(left, top) < 2 or right > width - 2 or bottom > height - 2 or min(right - left, bottom - top) < smallest:
            continue
        concept = CONCEPTS.index(box.label)
        y, x = np.ogrid[: bottom - top, : right - left]
        u, v = (x + 0.5) / ((right - left) / 2.0) - 1.0, (y + 0.5) / ((bottom - top) / 2.0) - 1.0
        radius = np.sqrt(u * u + v * v)
        alpha = np.clip((ALPHA_SHARE - radius) * min(right - left, bottom - top) / 3.0 + 0.5, 0.0, 1.0)
        labels = np.where(radius < LABEL_SHARE, concept, IGNORED).astype(np.uint8)
        colors = picture.pixels[top:bottom, left:right]
        pixels = np.concatenate([colors, (alpha * 255.0).astype(np.uint8)[..., None]], axis=-1)
        cutouts.append(Cutout(pixels, labels, concept, picture.source))
    return cutouts


def _cut_from_masks(picture: Picture, smallest: int) -> list[Cutout]:
    assert picture.instances is not None
    found = _cut_regions(picture, picture.instances, smallest, fullest=0.8 * np.pi / 4.0)
    return [cutout for cutout in found if cutout.concept < len(FRUITS)]


def cut_objects(pictures: Sequence[Picture], *, smallest: int = 14) -> list[Cutout]:
    """What is visible of the objects in renders that no word names."""
    word = CONCEPTS.index("object")
    renders = (picture for picture in pictures if picture.instances is not None)
    return [
        cutout
        for picture in renders
        for cutout in _cut_regions(picture, ndimage.label(picture.labels == word)[0], smallest, fullest=0.3)
    ]


def _cut_regions(picture: Picture, ids: NDArray[np.integer], smallest: int, *, fullest: float) -> list[Cutout]:
    """Cut out every region (H, W) of one id above 0 that is not cut off, not small, and fills this share of its box."""
    height, width = picture.labels.shape
    cutouts = []
    for number, box in enumerate(ndimage.find_objects(ids.astype(np.int32)), start=1):
        if box is None:
            continue
        inside = ids[box] == number
        cut = min(box[0].start, box[1].start) == 0 or box[0].stop == height or box[1].stop == width
        if cut or min(inside.shape) < smallest or inside.mean() < fullest:
            continue
        concept = int(np.bincount(picture.labels[box][inside]).argmax())
        pixels = np.concatenate([picture.pixels[box], (inside * np.uint8(255))[..., None]], axis=-1)
        labels = np.where(inside, concept, IGNORED).astype(np.uint8)
        cutouts.append(Cutout(pixels, labels, concept, picture.source))
    return cutouts


def paste(
    pixels: NDArray[np.uint8],
    labels: Labels,
    cutout: Cutout,
    size: int,
    rng: np.random.Generator,
    *,
    occlude: bool = True,
) -> Box | None:
    """Paste in place, `size` pixels on the longer side, flipped and rotated, sometimes half covered by the background.

    Returns the pasted region, None if the cutout does not fit.
    """
    image, marks = Image.fromarray(cutout.pixels), Image.fromarray(cutout.labels)
    turn = TURNS[rng.integers(len(TURNS))]
    if turn is not None:
        image, marks = image.transpose(turn), marks.transpose(turn)
    scale = size / max(image.size)
    shape = (max(3, round(image.width * scale)), max(3, round(image.height * scale)))
    if shape[0] >= labels.shape[1] or shape[1] >= labels.shape[0]:
        return None
    source = np.asarray(image.resize(shape, Image.Resampling.BILINEAR)).astype(np.float32)
    mark = np.asarray(marks.resize(shape, Image.Resampling.NEAREST))
    left = int(rng.integers(0, labels.shape[1] - shape[0]))
    top = int(rng.integers(0, labels.shape[0] - shape[1]))
    region = np.s_[top : top + shape[1], left : left + shape[0]]
    alpha = source[..., 3:] / 255.0
    if occlude and rng.random() < 0.35:
        alpha = alpha * _make_cover(shape, rng)[..., None]
    gain = rng.uniform(0.75, 1.25)
    pixels[region] = (np.clip(source[..., :3] * gain, 0, 255) * alpha + pixels[region] * (1.0 - alpha)).astype(np.uint8)
    opaque = alpha[..., 0]
    edge = np.where(opaque < 0.05, labels[region], IGNORED)
    labels[region] = np.where((opaque > 0.5) & (mark != IGNORED), mark, np.where(opaque < 0.5, edge, IGNORED))
    return Box(CONCEPTS[cutout.concept], left, top, left + shape[0], top + shape[1])


def _make_cover(shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float32]:
    """Make (h, w): 0 behind a leaf-like ellipse at the rim, else 1."""
    width, height = shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    angle = rng.uniform(0, 2 * np.pi)
    off = rng.uniform(0.25, 0.5)
    u = (x - width / 2) / width - off * np.cos(angle)
    v = (y - height / 2) / height - off * np.sin(angle)
    turn = rng.uniform(0, np.pi)
    along, across = u * np.cos(turn) + v * np.sin(turn), v * np.cos(turn) - u * np.sin(turn)
    return ((along / rng.uniform(0.3, 0.7)) ** 2 + (across / rng.uniform(0.12, 0.3)) ** 2 > 1.0).astype(np.float32)
