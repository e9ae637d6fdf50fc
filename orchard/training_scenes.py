"""The scenes that the encoder is trained on: random by seed, small, as varied as possible."""

from __future__ import annotations

import numpy as np

from .config import FIRST_TRAINING_SEED, FORMS, OrchardConfig
from .species import SPECIES, UNNAMED

WALK_EVERY = 15
"""Every n-th scene is a whole tree, reserved for calibration on many views."""
AROUND = 0.6
"""Share of the other scenes with views from around the tree; the rest are close-ups."""
WALK_VIEWS = 36
"""Pictures of such a tree."""
SPINDLES = 0.55
"""Share of training scenes with the most common form; the other forms share the rest."""
ROUNDS, HELD_OUT_ROUND = 11, 9
"""Of this many rounds through all species, one is held out (the first round is 0). Every variety has its turn: no
species has eleven."""
_LEARNT = tuple(species for name, species in SPECIES.items() if name not in UNNAMED)


def is_held_out(seed: int) -> bool:
    """Whether this seed's scene is reserved for measurement, in any set of scenes."""
    return (seed - FIRST_TRAINING_SEED) // len(_LEARNT) % ROUNDS == HELD_OUT_ROUND


def training_config(seed: int) -> OrchardConfig:
    """A small scene for training the encoder: species and varieties take turns, the rest is random by seed."""
    rng = np.random.default_rng([seed, 99])
    number = seed - FIRST_TRAINING_SEED
    species = _LEARNT[number % len(_LEARNT)]
    variant = species.variants[number // len(_LEARNT) % len(species.variants)]
    # The number of leaves that covers the crown of this tree as 3600 leaves cover that of the apple.
    cover = (species.tree_height / 2.1) ** 2 * (0.078 * 0.046) / (species.leaf_length * species.leaf_width)
    fruits, fallen = int(rng.integers(25, 90)), int(rng.integers(0, 8))
    leaves = int(rng.integers(1600, 4200) * cover)
    close_ups = bool(rng.random() >= AROUND)
    fruit_pixels = float(np.exp(rng.uniform(*np.log((11.0, 26.0)))))
    form = "spindle" if rng.random() < SPINDLES else str(rng.choice(FORMS[1:]))
    distractors = bool(rng.random() < 0.5)
    things = int(rng.integers(1, 5)) if rng.random() < 0.7 else 0
    objects = int(rng.integers(10, 50)) if rng.random() < 0.6 else 0
    if number % WALK_EVERY == WALK_EVERY - 1:
        return OrchardConfig(
            species=species.name,
            variant=variant.name,
            seed=seed,
            fruits=100,
            leaves=round(3400 * cover),
            views=WALK_VIEWS,
            path="wave",
            width=300,
            height=225,
            fruit_pixels=14.0,
            samples=8,
            light_variety=1.0,
        )
    return OrchardConfig(
        species=species.name,
        variant=variant.name,
        seed=seed,
        form=form,
        fruits=fruits if close_ups else 2 * fruits,
        fallen=fallen,
        leaves=leaves,
        tags=int(rng.integers(2, 9)) if distractors else 0,
        flowers=int(rng.integers(4, 25)) if distractors else 0,
        things=things,
        objects=objects,
        views=6 if close_ups else 8,
        width=320 if close_ups else 480,
        height=320 if close_ups else 360,
        fruit_pixels=fruit_pixels,
        exposure_drift=0.15,
        white_balance_drift=0.06,
        samples=6 if close_ups else 8,
        bounces=3,
        points=500,
        close_ups=close_ups,
        light_variety=1.0,
    )
