"""Settings that cannot work, named before minutes are spent on them."""

from __future__ import annotations

from .config import OrchardConfig
from .errors import OrchardError
from .species import SPECIES

LEAST = {
    "seed": 0,
    "fruits": 0,
    "fallen": 0,
    "leaves": 0,
    "views": 1,
    "rings": 1,
    "width": 8,
    "height": 8,
    "samples": 1,
    "bounces": 0,
    "points": 1,
}
"""The least value that each setting can have."""


def check(config: OrchardConfig) -> None:
    """Raise OrchardError naming the first setting that makes no sense."""
    if config.species not in SPECIES:
        raise OrchardError(f"species {config.species!r} is not known: use one of {', '.join(SPECIES)}")
    names = [v.name for v in SPECIES[config.species].variants]
    if config.variant and config.variant not in names:
        raise OrchardError(f"{config.species} has no variant {config.variant!r}: use one of {', '.join(names)}")
    for name, low in LEAST.items():
        if getattr(config, name) < low:
            raise OrchardError(f"{name} is {getattr(config, name)}: give {low} or more")
    if config.fruits + config.fallen > 32000:
        raise OrchardError("more than 32000 fruit do not fit into 16-bit masks: ask for fewer")
    if not config.fruit_pixels > 0:
        raise OrchardError(f"fruit_pixels is {config.fruit_pixels}: give a size above 0")
