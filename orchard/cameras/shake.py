"""Camera shake during an exposure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..srgb import from_linear, to_linear

FloatArray = NDArray[np.float64]


def sample_shake(rng: np.random.Generator, mean_length: float) -> FloatArray:
    """Sample the motion (2,) of a picture during its exposure, in pixels of x and y; `mean_length` is the mean over
    pictures."""
    length, turn = mean_length * rng.uniform(0.4, 1.6), rng.uniform(0, 2 * np.pi)
    return length * np.array([np.cos(turn), np.sin(turn)])


def apply_shake(pixels: NDArray[np.uint8], shake: FloatArray) -> NDArray[np.uint8]:
    """Average the picture (H, W, 3), sRGB, in linear light along the shake, centred on the sharp picture."""
    light = to_linear(pixels / 255.0)
    steps = 2 * int(np.ceil(np.linalg.norm(shake))) + 1
    places = np.linspace(-0.5, 0.5, steps)
    mean = np.asarray(sum(_shift(light, shake * s) for s in places)) / steps
    return np.rint(255 * np.clip(from_linear(mean), 0, 1)).astype(np.uint8)


def _shift(light: FloatArray, shift: FloatArray) -> FloatArray:
    """Move the picture by (x, y) pixels, bilinear, with repeated borders."""
    for axis, amount in ((1, shift[0]), (0, shift[1])):
        whole = int(np.floor(amount))
        part = amount - whole
        n = light.shape[axis]
        near = np.take(light, np.clip(np.arange(n) - whole, 0, n - 1), axis=axis)
        far = np.take(light, np.clip(np.arange(n) - whole - 1, 0, n - 1), axis=axis)
        light = (1 - part) * near + part * far
    return light
