"""What a synthetic orchard is made of, as one value."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass

import numpy as np

from .species import SPECIES

GENERATOR_VERSION = "2"
"""Raised whenever the same configuration would give another scene."""


@dataclass(frozen=True, kw_only=True)
class OrchardConfig:
    """One scene: a tree, its fruit, its light and the walk around it. Lengths in metres."""

    species: str = "apple"
    """Kind of fruit: apple, pear, cherry, plum, lemon, orange, peach or mango."""

    variant: str = ""
    """Colour variety of the species, such as red or green; empty: drawn by the seed."""

    seed: int = 1
    """Seed of everything that is random. Seeds of 1000 and above are kept for training the encoder."""

    fruits: int = 120
    """Number of fruit hanging on the tree."""

    fallen: int = 4
    """Number of fruit lying on the ground."""

    leaves: int = 3600
    """Number of leaves on the tree."""

    views: int = 60
    """Number of pictures."""

    rings: int = 2
    """Number of heights from which the tree is walked around."""

    width: int = 480
    """Width of a picture in pixels."""

    height: int = 360
    """Height of a picture in pixels."""

    fruit_pixels: float = 17.0
    """Mean fruit diameter in a picture, in pixels, at the tree's axis."""

    samples: int = 12
    """Cycles samples a pixel; the pictures are denoised after."""

    bounces: int = 3
    """Light bounces."""

    points: int = 16000
    """Number of points of the sparse cloud."""

    close_ups: bool = False
    """Views at scattered distances, aimed at single places of the crown, instead of the walk around the tree."""

    light_variety: float = 0.25
    """How much sun, sky and exposure vary between seeds, from 0 to 1."""

    def digest(self) -> str:
        """A short hash of every setting and of the generator's version."""
        text = json.dumps({"generator": GENERATOR_VERSION, **asdict(self)}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


FIRST_TRAINING_SEED = 1000


WALKS = 0.4
"""Share of training scenes that are seen as users walk around a tree; the others are close-ups."""


def training_config(seed: int) -> OrchardConfig:
    """A small scene for training the encoder: species and varieties take turns, the rest is drawn by seed."""
    rng = np.random.default_rng([seed, 99])
    number = seed - FIRST_TRAINING_SEED
    species = list(SPECIES.values())[number % len(SPECIES)]
    variant = species.variants[number // len(SPECIES) % len(species.variants)]
    # Leaves to cover the crown of this tree as 3600 leaves of the apple cover its own.
    cover = (species.tree_height / 2.1) ** 2 * (0.078 * 0.046) / (species.leaf_length * species.leaf_width)
    fruits, fallen = int(rng.integers(25, 90)), int(rng.integers(0, 8))
    leaves = int(rng.integers(1600, 4200) * cover)
    close_ups = bool(rng.random() >= WALKS)
    return OrchardConfig(
        species=species.name,
        variant=variant.name,
        seed=seed,
        fruits=fruits if close_ups else 2 * fruits,
        fallen=fallen,
        leaves=leaves,
        views=6 if close_ups else 8,
        width=320 if close_ups else 480,
        height=320 if close_ups else 360,
        fruit_pixels=float(np.exp(rng.uniform(*np.log((11.0, 26.0))))),
        samples=6 if close_ups else 8,
        bounces=3,
        points=500,
        close_ups=close_ups,
        light_variety=1.0,
    )
