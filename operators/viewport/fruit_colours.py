"""Colours of fruit: by label, by tree, or by probability."""

from __future__ import annotations

import colorsys
import zlib
from typing import Any, Literal

import bpy
import numpy as np
from numpy.typing import NDArray

from ..blender_data import find_owned_objects, linear_from_srgb
from .gaussian_nodes import PROBABILITY_RAMP
from .viewport import redraw_viewports

FruitColours = Literal["LABEL", "TREE", "PROBABILITY"]

LABEL_HUES = {
    "apple": 0.0,
    "cherry": 0.96,
    "fruit": 0.06,
    "lemon": 0.15,
    "mango": 0.11,
    "orange": 0.08,
    "peach": 0.05,
    "pear": 0.19,
    "plum": 0.80,
}
GOLDEN = 0.6180339887
"""Steps of the golden ratio spread any number of neighbours evenly."""
NO_TREE_COLOUR = (0.5, 0.5, 0.5)


def label_colour(label: str, number: int) -> NDArray[np.float64]:
    """(3,) sRGB: the hue of the label, with a brightness by id so that touching fruit can be distinguished."""
    hue = LABEL_HUES.get(label)
    if hue is None:
        hue = zlib.crc32(label.encode()) % 1000 / 1000
    return np.array(colorsys.hsv_to_rgb(hue, 0.75, 0.6 + 0.4 * (number * GOLDEN % 1.0)))


def tree_colour(number: int) -> NDArray[np.float64]:
    """(3,) sRGB: another hue for each tree."""
    return np.array(colorsys.hsv_to_rgb(number * GOLDEN % 1.0, 0.7, 0.9))


def probability_colours(probabilities: NDArray[Any]) -> NDArray[np.float64]:
    """(N, 3) sRGB on the ramp of the Gaussians' highlight."""
    places, ramp = [stop[0] for stop in PROBABILITY_RAMP], np.array([stop[1] for stop in PROBABILITY_RAMP])
    return np.stack([np.interp(probabilities, places, ramp[:, channel]) for channel in range(3)], axis=-1)


def colour_fruit(item: bpy.types.Object) -> None:
    """Give a fruit object the colour that its Blender scene's panel asks for; that of its label without a panel."""
    settings = next((getattr(scene, "fruitlangs", None) for scene in item.users_scene), None)
    colours: FruitColours = "LABEL" if settings is None else settings.look.fruit
    if colours == "TREE":
        rgb = tree_colour(item["tree"]) if "tree" in item else np.array(NO_TREE_COLOUR)
    elif colours == "PROBABILITY":
        rgb = probability_colours(np.array(item.get("probability", 1.0)))
    else:
        rgb = label_colour(item["label"], item["id"])
    item.color = (*(float(value) for value in linear_from_srgb(rgb)), 1.0)


def apply_fruit_colors(look: Any, _context: Any = None) -> None:
    """Called when the colours were chosen in the panel."""
    if look.id_data.library is None:
        for item in find_owned_objects(look.id_data, "fruit"):
            colour_fruit(item)
        redraw_viewports()
