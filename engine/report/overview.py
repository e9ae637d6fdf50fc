"""The picture of a whole count from viewpoints that are found: one of a tree, or one of each tree of a row."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from ..counting.fruit import Fruit, FruitCount
from ..counting.regions.row import nearest_tree
from ..progress import Progress, part, silent
from ..scene.camera import Camera, Scene
from ..splatting.gaussians import Gaussians
from .framing import frame_tree
from .still import add_title, draw_still
from .words import headline

COLUMNS = 2
"""Pictures of trees side by side."""
MOST = 60
"""Trees that have a picture, the first of a row: a sheet of these is 20,000 pixels high."""
TRIED = 20
"""Photos among which the viewpoint of a tree is chosen: those that look at it most directly."""


def draw_count(
    scene: Scene,
    gaussians: Gaussians,
    fruit_count: FruitCount,
    *,
    title: str,
    width: int = 1600,
    progress: Progress = silent,
) -> Image.Image:
    """The tree with its fruit outlined and numbered, from the viewpoint of a photo; of a row a picture of each tree.

    title: of the picture; width: pixels. The same input gives the same picture.
    """
    if len(fruit_count.trees) > 1:
        pictures = _trees(scene, gaussians, fruit_count, width // COLUMNS, progress)
        shown = f", trees 1–{MOST} of {len(fruit_count.trees)}" if len(fruit_count.trees) > MOST else ""
        return add_title(_sheet(pictures), title + shown)
    progress(0.0, "looking for the best view")
    camera = _framing(scene, gaussians, fruit_count.fruits, width)
    drawing = part(progress, 0.5, 1.0)
    scale = scene.metres_per_unit
    return draw_still(gaussians, fruit_count.fruits, camera, metres_per_unit=scale, title=title, progress=drawing)


def _trees(
    scene: Scene, gaussians: Gaussians, fruit_count: FruitCount, width: int, progress: Progress
) -> list[Image.Image]:
    """A picture of each tree of a row, up to `MOST`, this wide, with its count as title."""
    places = np.array([tree.position for tree in fruit_count.trees])
    owners = torch.from_numpy(nearest_tree(gaussians.means.detach().double().numpy(), places, scene.up))
    pictures = []
    drawn = fruit_count.trees[:MOST]
    for index, tree in enumerate(drawn):
        progress(index / len(drawn), f"drawing tree {index + 1} of {len(drawn)}")
        fruits = [fruit for fruit in fruit_count.fruits if fruit.tree == tree.number]
        looking = dataclasses.replace(scene, cameras=_select_looking_at(tree.position, scene.cameras))
        own = gaussians.select(owners == index)
        camera = _framing(looking, own if len(own) else gaussians, fruits, width)
        text, scale = headline(tree, f"tree {tree.number}"), scene.metres_per_unit
        pictures.append(draw_still(gaussians, fruits, camera, metres_per_unit=scale, title=text))
    return pictures


def _framing(scene: Scene, gaussians: Gaussians, fruits: Sequence[Fruit], width: int) -> Camera:
    return frame_tree(scene, gaussians, fruits, width=width, height=round(0.75 * width))


def _select_looking_at(place: NDArray[np.float64], cameras: Sequence[Camera]) -> list[Camera]:
    """Select those of the cameras that look most directly at a place (3,)."""
    rays = place - np.array([camera.center for camera in cameras]).reshape(-1, 3)
    ahead = np.einsum("vi,vi->v", rays, np.array([camera.forward for camera in cameras]).reshape(-1, 3))
    off = np.argsort(-ahead / np.maximum(np.linalg.norm(rays, axis=1), 1e-12), kind="stable")
    return [cameras[view] for view in np.sort(off[:TRIED])]


def _sheet(pictures: Sequence[Image.Image]) -> Image.Image:
    """Pictures of one size, row by row."""
    width, height = pictures[0].size
    rows = math.ceil(len(pictures) / COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * width, rows * height), "white")
    for number, picture in enumerate(pictures):
        sheet.paste(picture, (number % COLUMNS * width, number // COLUMNS * height))
    return sheet
