"""Training batches: crops at random scales with pasted fruit and changed light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from ...engine.language.vocabulary import CONCEPTS, FRUITS
from .pasting import Cutout, paste
from .pictures import Labels, Picture, make_plain_picture, put_object

CROP = 256
"""Side of a training crop, pixels."""
PLAIN, PHOTOS = 0.1, 0.34
"""Shares of plain crops and of crops from photos; the rest are from renders."""
PHOTO_ZOOMS, RENDER_ZOOMS, USUAL_ZOOMS = (0.4, 1.8), (0.8, 3.5), (1.6, 2.5)
"""Range of enlargement of crops; USUAL_ZOOMS are those of renders as the encoder gets them in use."""
USUAL = 0.7
"""Share of the crops from renders with one of USUAL_ZOOMS."""
FOCUS, FOCUS_ON_FRUIT = 0.7, 0.5
"""Share of the crops from renders that are centred on one of their words, because tags and ladders are rare and leaves
are not, and share of these that are centred on fruit."""
OBJECTS = 0.25
"""Share of objects that no word names among what is pasted."""
PASTED = (12, 160)
"""Sizes of pasted fruit that do not keep their own, in pixels."""


@dataclass(frozen=True, eq=False)
class Material:
    """The sources of batches; bank: cutouts by fruit concept; objects: cutouts of what no word names."""

    photos: Sequence[Picture]
    renders: Sequence[Picture]
    bank: Sequence[Sequence[Cutout]]
    objects: Sequence[Cutout] = ()


@dataclass(frozen=True, eq=False)
class Crop:
    """pixels: (CROP, CROP, 3) sRGB; labels: (CROP, CROP); zoom: enlargement relative to its picture."""

    pixels: NDArray[np.uint8]
    labels: Labels
    zoom: float = 1.0


def make_batch(material: Material, size: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """(B, 3, CROP, CROP) in [0, 1] and (B, CROP, CROP) labels: mostly renders, a third photos, some plain."""
    images, labels = [], []
    for _ in range(size):
        kind = rng.random()
        if kind < PLAIN:
            crop = _make_plain(material, rng)
        elif kind < PLAIN + PHOTOS or not material.renders:
            crop = _crop(material.photos[rng.integers(len(material.photos))], rng, PHOTO_ZOOMS)
            _paste_some(crop, material, rng, probability=0.6, native=0.7)
        else:
            zooms = USUAL_ZOOMS if rng.random() < USUAL else RENDER_ZOOMS
            crop = _crop(material.renders[rng.integers(len(material.renders))], rng, zooms, focus=FOCUS)
            _paste_some(crop, material, rng, probability=0.15, native=0.7)
        images.append(change_light(torch.from_numpy(crop.pixels).permute(2, 0, 1).float() / 255.0, rng))
        labels.append(torch.from_numpy(crop.labels))
    return torch.stack(images), torch.stack(labels).long()


def _crop(picture: Picture, rng: np.random.Generator, zooms: tuple[float, float], *, focus: float = 0.0) -> Crop:
    """A window of the picture shown at CROP × CROP, zoomed log-uniformly, slightly stretched, sometimes mirrored.

    focus: probability that it is centred on a pixel of one of the picture's words: of fruit, or of any, all alike.
    """
    height, width = picture.labels.shape
    zoom = float(np.exp(rng.uniform(*np.log(zooms))))
    stretch = float(np.exp(rng.uniform(-0.12, 0.12)))
    w, h = min(width, round(CROP / zoom * stretch)), min(height, round(CROP / zoom / stretch))
    left, top = int(rng.integers(0, width - w + 1)), int(rng.integers(0, height - h + 1))
    if rng.random() < focus:
        words = np.flatnonzero(np.bincount(picture.labels.ravel(), minlength=256)[: len(CONCEPTS)])
        if len(words):
            fruit = words[words < len(FRUITS)]
            chosen = fruit if len(fruit) and rng.random() < FOCUS_ON_FRUIT else words
            places = np.flatnonzero(picture.labels.ravel() == rng.choice(chosen))
            top, left = choose_window_around(places, picture.labels.shape, (h, w), rng)
    region = np.s_[top : top + h, left : left + w]
    shape = (CROP, CROP)
    resampling = Image.Resampling.BILINEAR if rng.random() < 0.5 else Image.Resampling.BICUBIC
    pixels = np.asarray(Image.fromarray(picture.pixels[region]).resize(shape, resampling))
    labels = np.asarray(Image.fromarray(picture.labels[region]).resize(shape, Image.Resampling.NEAREST))
    if rng.random() < 0.5:
        pixels, labels = pixels[:, ::-1], labels[:, ::-1]
    return Crop(pixels.copy(), labels.copy(), CROP / float(np.sqrt(w * h)))


def choose_window_around(
    places: NDArray[np.int64], shape: tuple[int, ...], size: tuple[int, int], rng: np.random.Generator
) -> tuple[int, int]:
    """Choose row and column of the first pixel of a random window of a size that shows one of the places of a picture
    of a shape. places: row · width + column; sizes and shapes: height and width."""
    start = divmod(int(places[rng.integers(len(places))]), shape[1])
    top, left = (
        int(np.clip(at - rng.integers(0, length), 0, whole - length))
        for at, length, whole in zip(start, size, shape, strict=True)
    )
    return top, left


def _make_plain(material: Material, rng: np.random.Generator) -> Crop:
    picture = make_plain_picture(rng, CROP)
    crop = Crop(picture.pixels.copy(), picture.labels.copy())
    for _ in range(rng.integers(0, 3)):
        put_object(crop.pixels, crop.labels, rng)
    _paste_some(crop, material, rng, probability=0.9, native=0.0)
    return crop


def _paste_some(crop: Crop, material: Material, rng: np.random.Generator, *, probability: float, native: float) -> None:
    """native: probability that a fruit keeps about its original size."""
    if rng.random() > probability:
        return
    kinds = [cutouts for cutouts in material.bank if cutouts]
    probabilities = np.sqrt([len(cutouts) for cutouts in kinds])
    for _ in range(rng.integers(1, 6)):
        cutouts = kinds[rng.choice(len(kinds), p=probabilities / probabilities.sum())]
        if material.objects and rng.random() < OBJECTS:
            cutouts = material.objects
        cutout = cutouts[rng.integers(len(cutouts))]
        if rng.random() < native:
            size = max(cutout.labels.shape) * crop.zoom * float(np.exp(rng.normal(0.0, 0.2)))
        else:
            size = float(np.exp(rng.uniform(*np.log(PASTED))))
        paste(crop.pixels, crop.labels, cutout, round(size), rng)


def change_light(image: Tensor, rng: np.random.Generator) -> Tensor:
    """Return the image (3, H, W) with another exposure, contrast, white balance, saturation, blur and noise."""
    grey = image.mean(0, keepdim=True)
    image = grey + (image - grey) * rng.uniform(0.7, 1.3)
    image = image * torch.from_numpy(np.exp(rng.normal(0.0, 0.06, (3, 1, 1)))).float()
    image = image.clamp(1e-4, 1.0) ** float(np.exp(rng.normal(0.0, 0.2))) * float(np.exp(rng.normal(0.0, 0.2)))
    if rng.random() < 0.35:
        image = _blur(image, rng.uniform(0.4, 1.6))
    if rng.random() < 0.5:
        noise = torch.from_numpy(rng.standard_normal(image.shape, dtype=np.float32))
        image = image + noise * float(rng.uniform(0.0, 0.04))
    return image.clamp(0.0, 1.0)


def _blur(image: Tensor, sigma: float) -> Tensor:
    taps = torch.arange(-4.0, 5.0)
    kernel = torch.exp(-0.5 * (taps / sigma) ** 2)
    kernel = kernel / kernel.sum()
    padded = torch.nn.functional.pad(image[:, None], (4, 4, 4, 4), mode="replicate")
    rows = torch.nn.functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    return torch.nn.functional.conv2d(rows, kernel.view(1, 1, -1, 1))[:, 0]
