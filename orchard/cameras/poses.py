"""Inaccurate poses, similar to those of structure from motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .viewpoint import FloatArray, Viewpoint


def disturb(
    rng: np.random.Generator, views: Sequence[Viewpoint], *, degrees: float, distance: float
) -> list[Viewpoint]:
    """Return the views with rotations wrong by `degrees` about each axis and centres wrong by the same angle ×
    `distance`.

    Both are standard deviations. With the distance (metres) to the target, a wrong rotation and a wrong centre move the
    picture there by equally many pixels.
    """
    sigma = np.radians(degrees)
    noisy = []
    for view in views:
        turn = _rotation(rng.normal(0.0, sigma, 3)) @ view.world_to_camera[:, :3]
        center = view.position + rng.normal(0.0, sigma * distance, 3)
        noisy.append(replace(view, world_to_camera=np.hstack([turn, (-turn @ center)[:, None]])))
    return noisy


def _rotation(vector: FloatArray) -> FloatArray:
    """(3, 3) rotation about a vector by its length in radians (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: FloatArray = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turn
