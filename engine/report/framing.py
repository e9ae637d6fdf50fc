"""The viewpoint of the still: close to a photo, so that the Gaussians are drawn as training saw them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..counting.fruit import Fruit
from ..scene.camera import Camera, Scene, look_along
from ..splatting.gaussians import Gaussians
from ..splatting.subject.viewpoints import LEAST_OPACITY, find_subject
from .ellipses import HIDDEN_BELOW, measure_visibility

FloatArray = NDArray[np.float64]

VIEW_ANGLE = 40.0
"""Degrees across the shorter side of the picture."""
MARGIN = 0.05
"""Margin at each side, as a share of half the picture."""
TRIED = 10
"""Number of directions to compare, chosen from the photos' to be as different as possible."""
TRIED_WIDTH = 400
"""Width in pixels of the pictures that are compared."""
STEPS_BACK = (0.0, 0.1, 0.25, 0.5, 1.0)
"""How far behind a photo the camera may stand, in distances of the tree."""
WIDEST_ANGLE = 75.0
"""Degrees across the longer side of the picture; a wider lens distorts the tree."""
RISE = 10.0
"""Degrees from above for a tree without photos."""
_AROUND = 1.15
"""Radii of the subject within which Gaussians belong to the tree."""
_MANY, _MOST_OF_FRUIT, _CROWN = 10, 0.9, 1.4
"""Number of fruit that tell where the crown is, share of them around their middle, and radii of these within which
Gaussians belong to the tree: around a whole tree the subject is mostly grass."""
_STEEP = 0.97
"""Cosine to the upward direction beyond which a camera looks straight down, so that up does not define its roll."""
_LEAST = 1e-3
"""Least width of the picture at distance 1: a single point has none."""
_EDGES = 0.002
"""Share of the tree's Gaussians that may lie beyond each edge, so that strays do not make the tree small."""


def frame_tree(
    scene: Scene, gaussians: Gaussians, fruits: Sequence[Fruit], *, width: int = 1600, height: int = 1200
) -> Camera:
    """Return a level camera of (height, width) pixels that shows the tree and all its fruit.

    It stands where a photo was taken, or a little behind if the tree does not fit, and its lens fills the picture. Of
    some photos from different sides, it is the one that shows most unobstructed fruit. Without cameras it looks from a
    side. The same input gives the same camera.
    """
    held, radii = _collect_spheres(gaussians, fruits)
    if scene.cameras:
        chosen = _choose_apart([camera.forward for camera in scene.cameras])
        framed = [_place_at_photo(scene.cameras[index], scene.up, held, radii, width, height) for index in chosen]
    else:
        sides = _sides(scene.up)
        framed = [_fill_picture(sides[index], scene.up, held, radii, width, height) for index in _choose_apart(sides)]
    if len(framed) == 1 or not fruits:
        return framed[0]
    factor = min(TRIED_WIDTH / width, 1.0)
    scores = []
    for camera in framed:
        shares = measure_visibility(gaussians, fruits, camera.scale(factor))
        scores.append((int((shares >= HIDDEN_BELOW).sum()), float(shares.sum())))
    return framed[max(range(len(framed)), key=scores.__getitem__)]


def _collect_spheres(gaussians: Gaussians, fruits: Sequence[Fruit]) -> tuple[FloatArray, FloatArray]:
    """Collect centres (P, 3) and radii (P,) of spheres that must be in the picture: the fruit, and the tree's
    Gaussians."""
    centers = np.array([fruit.center for fruit in fruits], np.float64).reshape(-1, 3)
    radii = np.array([fruit.lengths.max() / 2.0 for fruit in fruits], np.float64)
    if not len(gaussians):
        return (centers, radii) if len(centers) else (np.zeros((1, 3)), np.ones(1))
    subject = find_subject(gaussians)
    means = gaussians.means.detach().double().numpy()
    solid = gaussians.opacities.detach().numpy() >= LEAST_OPACITY
    near = means[solid & (np.linalg.norm(means - subject.center, axis=1) <= _AROUND * subject.radius)]
    if len(centers) >= _MANY:
        middle = np.median(centers, axis=0)
        reach = _CROWN * float(np.quantile(np.linalg.norm(centers - middle, axis=1), _MOST_OF_FRUIT))
        near = near[np.linalg.norm(near - middle, axis=1) <= reach]
    if not len(near):
        return np.vstack([centers, subject.center]), np.append(radii, subject.radius)
    return np.vstack([centers, near]), np.append(radii, np.zeros(len(near)))


def _sides(up: FloatArray) -> list[FloatArray]:
    """Eight directions around a tree, a little downward."""
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    ahead = np.cross(up, side)
    rise = math.radians(RISE)
    turns = [2.0 * math.pi * index / 8 for index in range(8)]
    return [math.cos(rise) * (math.cos(turn) * side + math.sin(turn) * ahead) - math.sin(rise) * up for turn in turns]


def _choose_apart(directions: Sequence[FloatArray]) -> list[int]:
    """Choose the indices of at most TRIED of the directions: the first, then always the one farthest from those
    chosen."""
    rows = np.stack(directions)
    taken = [0]
    nearest = rows @ rows[0]
    while len(taken) < min(TRIED, len(rows)):
        taken.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, rows @ rows[taken[-1]])
    return taken


def _place_at_photo(
    photo: Camera, up: FloatArray, centers: FloatArray, radii: FloatArray, width: int, height: int
) -> Camera:
    """Place the camera at the position of a photo, or as little behind as needed, whose lens shows all the spheres."""
    turn = _rotate_to_level(photo.forward, up)
    distance = float(np.median((centers - photo.center) @ photo.forward))
    for step in STEPS_BACK:
        place = photo.center - step * max(distance, 0.0) * photo.forward
        points = (centers - place) @ turn.T
        if (points[:, 2] <= radii).any():
            continue
        rays = points[:, :2] / points[:, 2:]
        reach = (radii / points[:, 2])[:, None] * np.sqrt(1.0 + rays**2)
        low = [-_edge(-rays[:, axis] + reach[:, axis], radii) for axis in (0, 1)]
        high = [_edge(rays[:, axis] + reach[:, axis], radii) for axis in (0, 1)]
        across, upward = max(high[0] - low[0], _LEAST), max(high[1] - low[1], _LEAST)
        focal = (1.0 - MARGIN) * min(width / across, height / upward)
        if 2.0 * math.degrees(math.atan(0.5 * max(width, height) / focal)) > WIDEST_ANGLE:
            continue
        cx, cy = 0.5 * (width - focal * (low[0] + high[0])), 0.5 * (height - focal * (low[1] + high[1]))
        K = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ place
        return Camera(K=K, world_to_camera=pose, width=width, height=height)
    return _fill_picture(photo.forward, up, centers, radii, width, height)


def _rotate_to_level(direction: FloatArray, up: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from the scene into a level camera that looks in `direction`."""
    level = up if abs(float(direction @ up)) < _STEEP else np.eye(3)[np.argmin(np.abs(direction))]
    return look_along(np.zeros(3), direction, level)[:3, :3]


def _fill_picture(
    direction: FloatArray, up: FloatArray, centers: FloatArray, radii: FloatArray, width: int, height: int
) -> Camera:
    """Return the camera that looks in `direction` from as near as all the spheres allow."""
    turn = _rotate_to_level(direction, up)
    focal = 0.5 * min(width, height) / math.tan(math.radians(VIEW_ANGLE) / 2.0)
    points = centers @ turn.T
    x, width_depth = _fit_wedge(points[:, 0], points[:, 2], radii, (1.0 - MARGIN) * width / 2.0 / focal)
    y, height_depth = _fit_wedge(points[:, 1], points[:, 2], radii, (1.0 - MARGIN) * height / 2.0 / focal)
    place = np.array([x, y, min(width_depth, height_depth)]) @ turn
    K = np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ place
    return Camera(K=K, world_to_camera=pose, width=width, height=height)


def _fit_wedge(across: FloatArray, depths: FloatArray, radii: FloatArray, slope: float) -> tuple[float, float]:
    """Return the edge (a, d), d as large as possible, of a wedge |across - a| ≤ slope · (depth - d) that contains all
    spheres.

    A sphere lies behind a side of the wedge if its centre does by radius · √(1 + slope²).
    """
    thick = radii * math.hypot(1.0, slope)
    right = _edge(across - slope * depths + thick, radii)
    left = _edge(-across - slope * depths + thick, radii)
    return (right - left) / 2.0, -(right + left) / (2.0 * slope)


def _edge(reaches: FloatArray, radii: FloatArray) -> float:
    """The farthest extent of all fruit and of all but a few of the tree's Gaussians, which have no radius."""
    fruit, tree = reaches[radii > 0.0], reaches[radii <= 0.0]
    return float(max([*fruit, *([np.quantile(tree, 1.0 - _EDGES)] if len(tree) else [])]))
