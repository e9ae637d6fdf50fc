"""The colour words of a pixel, by its colour."""

from __future__ import annotations

import torch
from torch import Tensor

from .vocabulary import COLOURS

_PROTOTYPES = {
    "red": (190, 30, 40, 110, 20, 25, 150, 50, 45),
    "orange": (240, 140, 30, 205, 100, 25, 235, 155, 80),
    "yellow": (245, 220, 50, 190, 165, 30, 235, 215, 120),
    "green": (60, 140, 40, 35, 75, 20, 150, 180, 60),
    "blue": (40, 80, 190, 110, 160, 230, 20, 35, 100, 195, 240, 250),
    "purple": (100, 30, 110, 60, 20, 65, 140, 90, 170),
    "pink": (240, 160, 175, 230, 110, 140, 245, 195, 190),
    "brown": (115, 75, 45, 70, 45, 28, 150, 110, 80),
    "white": (250, 250, 250, 225, 225, 225, 240, 240, 230),
    "grey": (128, 128, 128, 85, 85, 85, 175, 175, 175),
    "black": (12, 12, 12, 30, 30, 30, 40, 32, 30),
}
"""sRGB examples of a word: typical, dark, pale."""
_SPREAD = 14.0
"""Standard deviation of a colour word about an example, in CIELAB units."""
_LIGHTNESS = 0.6
"""Weight of a difference in lightness, which shade changes, against one in hue and chroma."""


def colour_words(image: Tensor) -> Tensor:
    """(…, 3) sRGB in [0, 1] → (…, len(COLOURS)) shares that sum to 1.

    Each example has a Gaussian weight in CIELAB; a word has the weight of its nearest example.
    """
    weight = torch.tensor([_LIGHTNESS, 1.0, 1.0])
    colours = (_lab(image) * weight).reshape(-1, 3)
    examples = (torch.tensor(_PROTOTYPES[word]).reshape(-1, 3) / 255.0 for word in COLOURS)
    nearest = torch.stack([torch.cdist(colours, _lab(own) * weight).amin(-1) for own in examples], dim=-1)
    return torch.softmax(-0.5 * (nearest / _SPREAD) ** 2, dim=-1).reshape(*image.shape[:-1], len(COLOURS))


def _lab(image: Tensor) -> Tensor:
    """(…, 3) sRGB in [0, 1] → CIELAB under D65."""
    linear = torch.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055).clamp_min(0.0) ** 2.4)
    matrix = torch.tensor(
        [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
    )
    xyz = linear @ matrix.T / torch.tensor([0.95047, 1.0, 1.08883])
    root = torch.where(xyz > 0.008856, xyz.clamp_min(1e-8) ** (1.0 / 3.0), 7.787 * xyz + 16.0 / 116.0)
    x, y, z = root.unbind(-1)
    return torch.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], dim=-1)
