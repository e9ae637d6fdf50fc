"""A scene in the generator's layout, drawn in moments: red balls over mottled ground, with masks, depths and truth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from fruitlangs.orchard.cameras.viewpoint import look_at

FloatArray = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL = 128, 96, 140.0
BALLS = np.array([[0.0, 0, 0.5], [0.22, 0.05, 0.55], [-0.3, 0.1, 0.4], [0.05, -0.35, 0.6], [-0.1, 0.3, 0.75]])
DIAMETERS = np.array([0.20, 0.20, 0.22, 0.18, 0.20])
"""The first two all but touch."""


def poses(views: int) -> list[FloatArray]:
    """(4, 4) world to camera of cameras on two rings that look at the balls; z is up."""
    found = []
    for view in range(views):
        turn, height = 2 * np.pi * view / views, (0.7, 1.5)[view % 2]
        place = np.array([2.0 * np.cos(turn), 2.0 * np.sin(turn), height])
        pose = np.eye(4)
        pose[:3] = look_at(place, np.array([0.0, 0.0, 0.5]))
        found.append(pose)
    return found


def row_of_balls(trees: int) -> FloatArray:
    """(5 · trees, 3) the balls of as many trees, two units apart along x."""
    return np.concatenate([BALLS + [2.0 * tree, 0.0, 0.0] for tree in range(trees)])


def row_poses(trees: int, views: int) -> list[FloatArray]:
    """(4, 4) world to camera of a walk past the trees of a row: there at one height, back at another."""
    there = np.linspace(-0.7, 2.0 * (trees - 1) + 0.7, views // 2)
    found = []
    for height, along in ((0.7, there), (1.4, there[::-1])):
        for x in along:
            pose = np.eye(4)
            pose[:3] = look_at(np.array([x, -2.0, height]), np.array([x, 0.0, 0.5]))
            found.append(pose)
    return found


def look(pose: FloatArray, balls: FloatArray = BALLS) -> tuple[NDArray[np.uint8], NDArray[np.uint16], FloatArray]:
    """Photo (H, W, 3), ball numbers from 1 (H, W) and depth along the axis (H, W), 0 for the sky."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1)
    turned, origin = rays @ pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = -origin[2] / turned[..., 2]
    depth = np.where((ground > 0) & (ground < 12), ground, np.inf)
    ids = np.zeros((HEIGHT, WIDTH), np.uint16)
    for number, (center, diameter) in enumerate(zip(balls, np.resize(DIAMETERS, len(balls)), strict=True), start=1):
        towards = origin - center
        a, b = (turned**2).sum(-1), (turned * towards).sum(-1)
        root = b**2 - a * ((towards**2).sum() - diameter**2 / 4)
        hit = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        nearer = (root > 0) & (hit < depth)
        depth, ids = np.where(nearer, hit, depth), np.where(nearer, number, ids).astype(np.uint16)
    points = origin + turned * np.where(np.isfinite(depth), depth, 0.0)[..., None]
    mottle = 0.5 + 0.5 * np.sin(37 * points[..., 0]) * np.sin(41 * points[..., 1]) * np.cos(29 * points[..., 2])
    shade = (0.6 + 0.4 * mottle)[..., None]
    color = np.where((ids > 0)[..., None], [200, 30, 25], [70, 120, 50]) * shade
    color = np.where(np.isfinite(depth)[..., None], color, [150, 190, 230])
    return color.astype(np.uint8), ids, np.where(np.isfinite(depth), depth, 0.0)


def write_scene(
    folder: Path,
    views: int = 16,
    seed: int = 7,
    *,
    balls: FloatArray = BALLS,
    walk: Sequence[FloatArray] | None = None,
) -> Path:
    """Write images/, instances/, depth/, transforms.json with points, truth.json and orchard.json. walk: poses in place
    of rings of `views`."""
    for name in ("images", "instances", "depth"):
        (folder / name).mkdir(parents=True)
    frames, points, colors = [], [], []
    for view, pose in enumerate(walk or poses(views)):
        photo, ids, depth = look(pose, balls)
        Image.fromarray(photo).save(folder / "images" / f"{view:03d}.png")
        Image.fromarray(ids).save(folder / "instances" / f"{view:03d}.png")
        Image.fromarray(np.rint(1000 * depth).astype(np.uint16)).save(folder / "depth" / f"{view:03d}.png")
        opengl = np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{view:03d}.png", "transform_matrix": opengl.tolist()})
        rows, columns = np.nonzero(depth > 0)
        some = slice(view % 7, None, 61)
        z = depth[rows, columns][some]
        rays = np.stack(
            [(columns[some] + 0.5 - WIDTH / 2) / FOCAL, (rows[some] + 0.5 - HEIGHT / 2) / FOCAL, np.ones(len(z))], 1
        )
        points.append((rays * z[:, None] - pose[:3, 3]) @ pose[:3, :3])
        colors.append(photo[rows, columns][some])
    trimesh.PointCloud(np.concatenate(points), np.concatenate(colors)).export(folder / "points.ply")
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    scene = {**lens, "frames": frames, "ply_file_path": "points.ply"}
    (folder / "transforms.json").write_text(json.dumps(scene))
    write_truth(folder, balls)
    config = {"species": "apple", "seed": seed}
    (folder / "orchard.json").write_text(json.dumps({"complete": True, "config": config}))
    return folder


def write_truth(folder: Path, balls: FloatArray = BALLS) -> None:
    """Every ball as a visible apple."""
    common = {"label": "apple", "visible": True, "visible_fraction": 1.0}
    fruits = [
        {"id": number, "center": center.tolist(), "diameter": float(diameter), **common}
        for number, (center, diameter) in enumerate(zip(balls, np.resize(DIAMETERS, len(balls)), strict=True), start=1)
    ]
    (folder / "truth.json").write_text(json.dumps({"fruits": fruits}))
