"""Training batches: crops at random scales with pasted fruit and changed light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from .pasting import Cutout, paste
from .pictures import Labels, Picture, plain_picture, put_thing

CROP = 256
"""Side of a training crop, pixels."""


@dataclass(frozen=True, eq=False)
class Material:
    """What batches are cut from; `bank` holds cutouts by fruit concept."""

    photos: Sequence[Picture]
    renders: Sequence[Picture]
    bank: Sequence[Sequence[Cutout]]


def make_batch(material: Material, size: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """(B, 3, CROP, CROP) in [0, 1] and (B, CROP, CROP) labels: mostly renders, a third photos, some plain."""
    images, labels = [], []
    for _ in range(size):
        kind = rng.random()
        if kind < 0.1:
            crop = _plain(material, rng)
        elif kind < 0.44 or not material.renders:
            crop = _crop(material.photos[rng.integers(len(material.photos))], rng, (0.3, 1.6))
            _paste_some(crop, material, rng, chance=0.5, sizes=(12, 100))
        else:
            crop = _crop(material.renders[rng.integers(len(material.renders))], rng, (0.8, 3.5))
            _paste_some(crop, material, rng, chance=0.25, sizes=(12, 120))
        images.append(changed_light(torch.from_numpy(crop[0]).permute(2, 0, 1).float() / 255.0, rng))
        labels.append(torch.from_numpy(crop[1]))
    return torch.stack(images), torch.stack(labels).long()


def _crop(picture: Picture, rng: np.random.Generator, zooms: tuple[float, float]) -> tuple[NDArray[np.uint8], Labels]:
    """A window of the picture shown at CROP × CROP, zoomed log-uniformly, a little stretched, perhaps mirrored."""
    height, width = picture.labels.shape
    side = CROP / float(np.exp(rng.uniform(*np.log(zooms))))
    stretch = float(np.exp(rng.uniform(-0.12, 0.12)))
    w, h = min(width, round(side * stretch)), min(height, round(side / stretch))
    left, top = int(rng.integers(0, width - w + 1)), int(rng.integers(0, height - h + 1))
    region = np.s_[top : top + h, left : left + w]
    shape = (CROP, CROP)
    resampling = Image.Resampling.BILINEAR if rng.random() < 0.5 else Image.Resampling.BICUBIC
    pixels = np.asarray(Image.fromarray(picture.pixels[region]).resize(shape, resampling))
    labels = np.asarray(Image.fromarray(picture.labels[region]).resize(shape, Image.Resampling.NEAREST))
    if rng.random() < 0.5:
        pixels, labels = pixels[:, ::-1], labels[:, ::-1]
    return pixels.copy(), labels.copy()


def _plain(material: Material, rng: np.random.Generator) -> tuple[NDArray[np.uint8], Labels]:
    picture = plain_picture(rng, CROP)
    crop = (picture.pixels.copy(), picture.labels.copy())
    for _ in range(rng.integers(0, 3)):
        put_thing(crop[0], rng)
    _paste_some(crop, material, rng, chance=0.9, sizes=(20, 230))
    return crop


def _paste_some(
    crop: tuple[NDArray[np.uint8], Labels],
    material: Material,
    rng: np.random.Generator,
    *,
    chance: float,
    sizes: tuple[int, int],
) -> None:
    if rng.random() > chance:
        return
    kinds = [cutouts for cutouts in material.bank if cutouts]
    chances = np.sqrt([len(cutouts) for cutouts in kinds])
    for _ in range(rng.integers(1, 6)):
        cutouts = kinds[rng.choice(len(kinds), p=chances / chances.sum())]
        size = float(np.exp(rng.uniform(*np.log(sizes))))
        paste(*crop, cutouts[rng.integers(len(cutouts))], round(size), rng)


def changed_light(image: Tensor, rng: np.random.Generator) -> Tensor:
    """(3, H, W) with another exposure, contrast, white balance, saturation, blur and noise."""
    grey = image.mean(0, keepdim=True)
    image = grey + (image - grey) * rng.uniform(0.7, 1.3)
    image = image * torch.from_numpy(np.exp(rng.normal(0.0, 0.06, (3, 1, 1)))).float()
    image = image.clamp(1e-4, 1.0) ** float(np.exp(rng.normal(0.0, 0.2))) * float(np.exp(rng.normal(0.0, 0.2)))
    if rng.random() < 0.35:
        image = _blurred(image, rng.uniform(0.4, 1.6))
    if rng.random() < 0.5:
        noise = torch.from_numpy(rng.standard_normal(image.shape, dtype=np.float32))
        image = image + noise * float(rng.uniform(0.0, 0.04))
    return image.clamp(0.0, 1.0)


def _blurred(image: Tensor, sigma: float) -> Tensor:
    taps = torch.arange(-4.0, 5.0)
    kernel = torch.exp(-0.5 * (taps / sigma) ** 2)
    kernel = kernel / kernel.sum()
    padded = torch.nn.functional.pad(image[:, None], (4, 4, 4, 4), mode="replicate")
    rows = torch.nn.functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    return torch.nn.functional.conv2d(rows, kernel.view(1, 1, -1, 1))[:, 0]
