"""The settings of a synthetic orchard."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass

GENERATOR_VERSION = "4"
"""Increased whenever the same configuration would give another scene."""

FIRST_TRAINING_SEED = 1000
"""Seeds from here on are reserved for training the encoder."""

LOADS = 5
"""With load_variety, this many consecutive seeds bear different numbers of fruit, evenly spread."""

FORMS = ("spindle", "wall", "vase", "bush")
"""Training systems of the tree."""
PATHS = ("ring", "wave", "half-ring", "row", "flight")
"""Camera paths."""
ALONG = ("row", "flight")
"""Those along the row, which keep the distance of a single tree."""
AIMS = ("auto", "tree", "part")
"""Targets of the camera."""


@dataclass(frozen=True, kw_only=True)
class OrchardConfig:
    """One scene: trees, their fruit, what stands around them, the light, and the way of the camera. Metres."""

    species: str = "apple"
    """Kind of fruit: apple, pear, cherry, plum, lemon, orange, peach or mango."""

    variant: str = ""
    """Colour variety of the species, such as red or green; empty: drawn by the seed."""

    seed: int = 1
    """Seed of everything that is random. Seeds of 1000 and above are kept for training the encoder."""

    form: str = "spindle"
    """How the tree is trained: spindle (a leader with limbs around it), wall (limbs in the plane of the row), vase
    (steep limbs around an open centre) or bush (several low stems)."""

    tree_height: float = 0.0
    """Height of a tree; 0: the species' own."""

    trees: int = 1
    """Trees of the row, along x, each with its own fruit."""

    fruits: int = 120
    """Number of fruit hanging on each tree."""

    load_variety: float = 0.0
    """How much the number of hanging fruit varies between seeds, relative to fruits, from 0 to 1. At 0.5, trees of any
    five consecutive seeds bear 0.5, 0.75, 1, 1.25 and 1.5 times as many."""

    clump: float = 0.0
    """Mean number of fruit in a clump, at least 1; 0: as the species clumps."""

    spread: float = -1.0
    """Standard deviation of the fruit's diameter over its mean; below 0: the species' own."""

    fallen: int = 4
    """Number of fruit lying on the ground under each tree."""

    leaves: int = 3600
    """Number of leaves on each tree."""

    neighbours: int = 0
    """Trees of the rows behind and in front, with fruit that do not belong to the count."""

    tags: int = 0
    """Small coloured tags on the twigs of each tree."""

    flowers: int = 0
    """Fruit-coloured flowers, half of them in the crown of each tree and half in the grass below."""

    things: int = 0
    """Buckets, crates, ladders, stones and walls about each tree, which take turns."""

    objects: int = 0
    """Objects of no known word about each tree, of random shape, pattern and colour."""

    posts: int = -1
    """Stakes and posts; -1: drawn by the seed, from none to two."""

    path: str = "ring"
    """Way of the camera: ring, wave (once around, up and down as with a phone in the hand), half-ring (the side of
    negative y), row (along x on that side, to and fro) or flight (as a drone, along x and obliquely from above, to on
    that side and back on the other)."""

    aim: str = "auto"
    """What is looked at: tree, part (a fruitful part of the crown, where the fruit then gather), or auto: a part where
    the pictures are too narrow for the tree."""

    views: int = 60
    """Number of pictures."""

    rings: int = 2
    """Number of heights from which pictures are taken."""

    width: int = 480
    """Width of a picture in pixels."""

    height: int = 360
    """Height of a picture in pixels."""

    fruit_pixels: float = 17.0
    """Mean fruit diameter in a picture, in pixels, at what the camera looks at."""

    exposure_drift: float = 0.0
    """Standard deviation of the exposure from view to view, in stops."""

    white_balance_drift: float = 0.0
    """Standard deviation from view to view of the natural logarithm of red over blue."""

    motion_blur: float = 0.0
    """Mean length of the camera's shake during a picture, in pixels; masks and depth stay sharp."""

    leaf_motion: float = 0.0
    """Standard deviation of the angle by which wind turns a leaf about its stalk in each view, in degrees."""

    pose_noise: float = 0.0
    """Standard deviation of the written rotations about each axis, in degrees; camera centres move by the same angle
    times the distance to what is looked at, along each axis. The true cameras stand in truth.json."""

    samples: int = 12
    """Cycles samples a pixel; the pictures are denoised after."""

    bounces: int = 3
    """Light bounces."""

    points: int = 16000
    """Number of points of the sparse cloud."""

    close_ups: bool = False
    """Views at scattered distances, aimed at single places of the crown, instead of the way around the tree."""

    light_variety: float = 0.25
    """How much sun, sky and exposure vary between seeds, from 0 to 1."""

    @property
    def hanging(self) -> int:
        """Number of fruit hanging on each tree of this seed."""
        step = self.seed % LOADS - LOADS // 2
        return round(self.fruits * (1.0 + self.load_variety * step / (LOADS // 2)))

    def digest(self) -> str:
        """A short hash of the generator's version and every setting that is not the default.

        So a new setting leaves old scenes as they are; another default asks for another version.
        """
        own, usual = asdict(self), asdict(OrchardConfig())
        changed = {name: value for name, value in own.items() if value != usual[name]}
        text = json.dumps({"generator": GENERATOR_VERSION, **changed}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]
