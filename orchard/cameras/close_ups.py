"""Single views from a short distance, for training the encoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..config import OrchardConfig
from ..shapes.body import Body
from ..shapes.branch import to_unit
from ..species import Species
from .viewpoint import Viewpoint, look_at

FloatArray = NDArray[np.float64]


def plan_close_ups(
    rng: np.random.Generator,
    config: OrchardConfig,
    species: Species,
    crown: FloatArray,
    fruits: Sequence[Body],
    things: FloatArray,
) -> list[Viewpoint]:
    """Plan views from varying distances, each aimed at a fruit; fruit span about 10 to 90 pixels; one focal length.

    With objects at places (T, 3), every third view is aimed at one of them, from a tree's width away.
    """
    size = species.tree_height / 2.3
    middle = crown.mean(axis=0)
    focal = 1.15 * max(config.width, config.height)
    spans = np.geomspace(12.0, 80.0, config.views) * np.exp(rng.normal(0.0, 0.12, config.views))
    views = []
    for i, span in enumerate(spans):
        target = fruits[rng.integers(len(fruits))].center if fruits else middle
        outward = to_unit(np.array([*(target - middle)[:2], 0.0]) + rng.normal(0.0, 0.25, 3) * [1, 1, 0] * size + 1e-6)
        rise = np.tan(np.radians(rng.uniform(-22, 32)))
        distance = max(focal * species.diameter / span, 2.2 * species.diameter)
        if len(things) and i % 3 == 1:
            target, distance = things[rng.integers(len(things))], size * rng.uniform(0.8, 2.2)
        place = target + to_unit(outward + [0, 0, rise]) * distance
        place[2] = max(place[2], 0.15 * size)
        aim = target + rng.normal(0.0, 0.25, 3) * species.diameter
        view = Viewpoint(
            name=f"{i + 1:03d}.jpg",
            focal=focal,
            width=config.width,
            height=config.height,
            world_to_camera=look_at(place, aim, rng.normal(0, 0.06)),
        )
        views.append(replace(view, nearest=_choose_near_clip(view, 0.55 * distance, fruits)))
    return views


def _choose_near_clip(view: Viewpoint, wanted: float, fruits: Sequence[Body]) -> float:
    """Choose the near clipping distance, at most `wanted`, so that leaves in front do not hide everything.

    Neither the ground nor a fruit is cut.
    """
    corners = np.array([[x, y] for x in (0.0, view.width) for y in (0.0, view.height)])
    drops = (view.position - view.unproject(corners, np.ones(4)))[:, 2]
    ground = [0.75 * view.position[2] / drop for drop in drops if drop > 1e-6]
    nearest = min([wanted, *ground])
    depths = view.project(np.array([f.center for f in fruits]).reshape(-1, 3))[1]
    for depth, body in sorted(zip(depths, fruits, strict=True), key=lambda pair: -pair[0]):
        if abs(depth - nearest) < 1.1 * body.reach:
            nearest = depth - 1.1 * body.reach
    return float(max(nearest, 0.02))
