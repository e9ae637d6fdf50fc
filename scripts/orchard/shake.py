"""A camera that shakes while it takes a picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def shake_of(rng: np.random.Generator, mean_length: float) -> FloatArray:
    """(2,) how far a picture moves while it is taken, in pixels of x and y; `mean_length` is the mean over pictures."""
    length, turn = mean_length * rng.uniform(0.4, 1.6), rng.uniform(0, 2 * np.pi)
    return length * np.array([np.cos(turn), np.sin(turn)])


def shaken(pixels: NDArray[np.uint8], shake: FloatArray) -> NDArray[np.uint8]:
    """The picture (H, W, 3), sRGB, averaged in linear light along the shake, which the sharp picture lies amid."""
    srgb = pixels / 255.0
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    steps = 2 * int(np.ceil(np.linalg.norm(shake))) + 1
    places = np.linspace(-0.5, 0.5, steps)
    mean = sum(_shifted(light, shake * s) for s in places) / steps
    back = np.where(mean <= 0.0031308, 12.92 * mean, 1.055 * np.maximum(mean, 1e-9) ** (1 / 2.4) - 0.055)
    return np.rint(255 * np.clip(back, 0, 1)).astype(np.uint8)


def _shifted(light: FloatArray, shift: FloatArray) -> FloatArray:
    """The picture moved by (x, y) pixels, bilinear, its rim repeated."""
    for axis, amount in ((1, shift[0]), (0, shift[1])):
        whole = int(np.floor(amount))
        part = amount - whole
        n = light.shape[axis]
        near = np.take(light, np.clip(np.arange(n) - whole, 0, n - 1), axis=axis)
        far = np.take(light, np.clip(np.arange(n) - whole - 1, 0, n - 1), axis=axis)
        light = (1 - part) * near + part * far
    return light
