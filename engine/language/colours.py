"""The colour words of a pixel by its colour, and of the fruit that it shows."""

from __future__ import annotations

from collections.abc import Collection

import torch
from torch import Tensor

from .vocabulary import COLOURS, FRUIT_COLOURS

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
_HUES = {"red": 0.0, "orange": 44.0, "yellow": 75.0, "green": 114.0, "blue": 200.0, "purple": 300.0, "pink": 340.0}
"""Hue in CIELAB at which the colours of fruit begin, degrees; each ends where the next begins."""
_OF_APPLES = {"orange": 62.0, "yellow": 62.0, "green": 84.0}
"""The same for apples, where it differs: their cheeks are called red, never orange, and greenish yellow ones green."""
_SOFT = 3.0
"""Logistic width of these borders, degrees."""
_DARKEST = 5.0
"""Added to the lightness that a and b are divided by, because dark pixels are noisy."""
_TREE_LIGHT = (-0.05, 0.15)
"""a / L and b / L of something white among leaves, which the light through and from them colours."""
_LEAST = 1e-3
"""Weight of a pixel without any colour."""


def colour_words(image: Tensor) -> Tensor:
    """(…, 3) sRGB in [0, 1] → (…, len(COLOURS)) shares that sum to 1.

    Each example has a Gaussian weight in CIELAB; a word has the weight of its nearest example.
    """
    weight = torch.tensor([_LIGHTNESS, 1.0, 1.0])
    examples = [cielab(torch.tensor(_PROTOTYPES[word]).reshape(-1, 3) / 255.0) * weight for word in COLOURS]
    all_examples, colours = torch.cat(examples), (cielab(image) * weight).reshape(-1, 3)
    # |c - e|² less |c|², which the softmax does not need.
    squares = torch.addmm(all_examples.square().sum(-1), colours, all_examples.T, alpha=-2.0)
    nearest = torch.stack([of.amin(-1) for of in squares.split([len(own) for own in examples], dim=-1)], dim=-1)
    return torch.softmax(-0.5 * nearest / _SPREAD**2, dim=-1).reshape(*image.shape[:-1], len(COLOURS))


def fruit_colours(pixels: Tensor, kinds: Collection[str] = ()) -> Tensor:
    """(…, 3) sRGB in [0, 1] → (…, len(FRUIT_COLOURS)) how much a pixel says for each colour of the fruit it shows.
    kinds: what the fruit may be.

    Shade changes lightness, but neither hue nor chroma / lightness. A pixel speaks for the colour of its hue, the more
    the more colourful and the brighter it is: gloss, haze and deep shade say little.
    """
    lightness, a, b = cielab(pixels).unbind(-1)
    a, b = (each / (lightness + _DARKEST) - white for each, white in zip((a, b), _TREE_LIGHT, strict=True))
    weight = (torch.hypot(a, b) * lightness.clamp_min(0.0).sqrt()).clamp_min(_LEAST)
    hues = {**_HUES, **_OF_APPLES} if set(kinds) == {"apple"} else _HUES
    first = torch.tensor([hues[word] for word in FRUIT_COLOURS])
    width = (first.roll(-1) - first) % 360.0
    off = (torch.atan2(b, a).rad2deg()[..., None] - first - width / 2.0 + 180.0) % 360.0 - 180.0
    own = ((width / 2.0 - off.abs()) / _SOFT).sigmoid() * (width > 0.0)
    return weight[..., None] * own / own.sum(-1, keepdim=True)


def cielab(image: Tensor) -> Tensor:
    """(…, 3) sRGB in [0, 1] → CIELAB under D65."""
    linear = torch.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055).clamp_min(0.0) ** 2.4)
    matrix = torch.tensor(
        [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
    )
    xyz = linear @ matrix.T / torch.tensor([0.95047, 1.0, 1.08883])
    root = torch.where(xyz > 0.008856, xyz.clamp_min(1e-8) ** (1.0 / 3.0), 7.787 * xyz + 16.0 / 116.0)
    x, y, z = root.unbind(-1)
    return torch.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], dim=-1)
