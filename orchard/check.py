"""Checks of settings before a long run."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import get_type_hints

from .config import AIMS, ALONG, FORMS, PATHS, OrchardConfig
from .errors import OrchardError
from .species import SPECIES

BOUNDS: dict[str, tuple[float, float]] = {
    "seed": (0, math.inf),
    "tree_height": (0, 20),
    "trees": (1, 50),
    "fruits": (0, math.inf),
    "load_variety": (0, 1),
    "clump": (0, 12),
    "spread": (-math.inf, 0.6),
    "fallen": (0, math.inf),
    "leaves": (0, math.inf),
    "neighbours": (0, 100),
    "tags": (0, 10_000),
    "flowers": (0, 10_000),
    "things": (0, 1000),
    "objects": (0, 1000),
    "posts": (-1, 1000),
    "views": (1, 9999),
    "rings": (1, math.inf),
    "width": (8, 16384),
    "height": (8, 16384),
    "exposure_drift": (0, 4),
    "white_balance_drift": (0, 2),
    "motion_blur": (0, 200),
    "leaf_motion": (0, 90),
    "pose_noise": (0, 45),
    "samples": (1, math.inf),
    "bounces": (0, math.inf),
    "points": (1, math.inf),
    "light_variety": (0, 1),
}
"""Range of each setting."""
CHOICES = {"species": tuple(SPECIES), "form": FORMS, "path": PATHS, "aim": AIMS}
"""Choices of each setting."""
MOST_FRUIT = 32000


def check(config: OrchardConfig) -> None:
    """Raise OrchardError naming the first invalid setting."""
    for name, words in CHOICES.items():
        if getattr(config, name) not in words:
            raise OrchardError(f"{name} {getattr(config, name)!r} is not known: use one of {', '.join(words)}")
    names = [v.name for v in SPECIES[config.species].variants]
    if config.variant and config.variant not in names:
        raise OrchardError(f"{config.species} has no variant {config.variant!r}: use one of {', '.join(names)}")
    for name, (low, high) in BOUNDS.items():
        value = getattr(config, name)
        if not low <= value <= high:
            limits = f"{low:g} or more" if math.isinf(high) else f"from {low:g} to {high:g}"
            raise OrchardError(f"{name} is {value}: give {'at most ' + format(high, 'g') if low < -99 else limits}")
    _check_together(config)


def _check_together(config: OrchardConfig) -> None:
    if not 0 < config.fruit_pixels < math.inf:
        raise OrchardError(f"fruit_pixels is {config.fruit_pixels}: give a size above 0")
    if 0 < config.clump < 1:
        raise OrchardError(f"clump is {config.clump}: give a mean of 1 or more, or 0 for the species' own")
    if 0 < config.tree_height < 0.5:
        raise OrchardError(f"tree_height is {config.tree_height}: give 0.5 m or more, or 0 for the species' own")
    if (config.trees + config.neighbours) * (max(config.fruits, config.hanging) + config.fallen) > MOST_FRUIT:
        raise OrchardError(f"more than {MOST_FRUIT} fruit do not fit into 16-bit masks: ask for fewer")
    if config.aim == "part" and (config.path in ALONG or config.trees > 1):
        raise OrchardError("aim part looks at one tree: use path ring, wave or half-ring and one tree, or aim tree")


def check_types(values: dict[str, object], where: str) -> None:
    """Raise OrchardError naming the first unknown key, or the first value of a wrong type.

    `where` is named in the error. A whole number is valid for a setting with a fraction.
    """
    kinds = get_type_hints(OrchardConfig)
    words = {int: "a whole number", float: "a number", str: "a text in quotes", bool: "true or false"}
    for name, value in values.items():
        if name not in kinds:
            known = ", ".join(f.name for f in fields(OrchardConfig))
            raise OrchardError(f"{where}: {name} is no setting: use one of {known}")
        kind = kinds[name]
        fits = type(value) is kind or (kind is float and type(value) is int)
        if not fits:
            raise OrchardError(f"{where}: {name} is {value!r}: give {words[kind]}")
