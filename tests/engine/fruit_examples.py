"""Small counts to write files of."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from fruitlangs.engine.counting.fruit import AuditEntry, Fruit, FruitCount


def fruit(number: int, x: float, **changes: Any) -> Fruit:
    """A fruit at (x, 0.5, -1), 0.16 long along z, 0.08 wide along x and 0.04 thick along y."""
    plain = Fruit(
        id=number,
        label="red apple",
        center=np.array([x, 0.5, -1.0]),
        diameter=0.08,
        diameter_sd=0.004,
        volume=0.08**3 * np.pi / 6,
        axes=np.array([[0.0, 0.0, 0.08], [0.04, 0.0, 0.0], [0.0, 0.02, 0.0]]),
        probability=0.9,
        visible_fraction=0.75,
        views=12,
        color=np.array([180, 40, 30], np.uint8),
        kind="single",
        members=np.array([1, 2]),
    )
    return dataclasses.replace(plain, **changes)


def count_of(*fruits: Fruit, **changes: Any) -> FruitCount:
    plain = FruitCount(
        fruits=fruits,
        audit=[AuditEntry(1, "kept", "fits a sphere", (0.0, 0.5, -1.0), 40, (1,))],
        max_probability=0.97,
        mean_diameter=float(np.mean([each.diameter for each in fruits])) if fruits else None,
    )
    return dataclasses.replace(plain, **changes)


NO_FRUIT = count_of(
    audit=[AuditEntry(0, "dropped", "highest probability .31 is below .50", (0.0, 0.0, 0.0), 0)], max_probability=0.31
)
