"""Simulated fruit surfaces as flat Gaussians, seen from a ring of cameras: what counting is tested on without photos.

Fruit are spheres, alone or in touching clumps; leaves are discs that hide them. Each fruit's surface is cut into flat
Gaussians; the ones no camera sees are left out, as training leaves them out. Wrongly selected leaf sheets and floaters
can be added. Lengths are in mean fruit diameters times `unit`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fruitlangs.engine.counting.evidence.visibility import Visibility, frame_of
from fruitlangs.engine.evaluation.truth import Truth
from fruitlangs.engine.scene.camera import Camera, look_along
from fruitlangs.engine.splatting.gaussians import Gaussians

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One kind of simulated tree; `leaves` are occluding discs a fruit, `sheets` and `floaters` wrongly selected."""

    fruit: int = 60
    clump: int = 1
    spread: float = 0.08
    leaves: float = 2.0
    sheets: int = 4
    floaters: int = 40
    noise: float = 0.04
    patches: int = 120
    views: int = 24
    unit: float = 1.0


SPARSE = Setting()
CLUMPED = Setting(clump=8)
MIXED = Setting(clump=3, spread=0.33)
HEAVY = Setting(clump=4, leaves=9.0)


@dataclass(frozen=True, eq=False)
class Simulation:
    gaussians: Gaussians
    probability: FloatArray
    visibility: Visibility
    cameras: list[Camera]
    truth: Truth


def simulate(setting: Setting, seed: int) -> Simulation:
    """Build one tree. Frame: z up, cameras on two rings around the origin looking at it."""
    rng = np.random.default_rng(seed)
    radii = 0.5 * np.exp(rng.normal(-0.5 * setting.spread**2, setting.spread, setting.fruit))
    centers = _place(rng, radii, setting.clump)
    size = np.linalg.norm(centers, axis=1).max() + 1.0
    cameras = _ring(setting.views, 2.5 * size)
    eyes = np.stack([camera.center for camera in cameras])
    leaves, leaf_normals = _leaves(rng, centers, radii, int(setting.leaves * setting.fruit))

    normals = _directions(rng, setting.fruit * setting.patches)
    owner = np.repeat(np.arange(setting.fruit), setting.patches)
    surface = centers[owner] + radii[owner, None] * normals
    seen = _seen(surface, normals, owner, eyes, centers, radii, leaves, leaf_normals)
    shares = seen.reshape(setting.fruit, setting.patches, -1)
    facing = np.einsum("pvj,pj->pv", eyes[None] - surface[:, None], normals).reshape(shares.shape) > 0
    fraction = (shares.sum(axis=1) / np.maximum(facing.sum(axis=1), 1)).clip(0, 1)
    truth = Truth(centers, 2 * radii, (fraction >= 0.1).sum(axis=1) >= 3, fraction.max(axis=1))

    keep = seen.any(axis=1)
    size_of = radii[owner] * np.sqrt(4.0 / setting.patches)
    parts = [(surface[keep], normals[keep], size_of[keep], seen[keep], rng.uniform(0.7, 1.0, keep.sum()))]
    everywhere = np.ones((len(leaves), len(eyes)), bool)
    parts.append((leaves, leaf_normals, np.full(len(leaves), 0.25), everywhere, np.full(len(leaves), 0.05)))
    for _ in range(setting.sheets):
        parts.append(_sheet(rng, centers, eyes))
    if setting.floaters:
        spots = rng.uniform(-1, 1, (setting.floaters, 3)) * np.abs(centers).max(axis=0)
        views = rng.random((setting.floaters, len(eyes))) < 0.3
        views[:, 0] = True
        facing_out = _directions(rng, setting.floaters)
        parts.append((spots, facing_out, rng.uniform(0.03, 0.2, len(spots)), views, rng.uniform(0.5, 0.9, len(spots))))
    joined = [np.concatenate([part[column] for part in parts]) for column in range(5)]
    return _as_gaussians(rng, setting, truth, cameras, eyes, *joined)


def _as_gaussians(rng, setting, truth, cameras, eyes, spots, normals, sizes, seen, probability) -> Simulation:
    # Trained Gaussians lie below the surface that they draw, so that their outlines are the fruit's.
    spots = spots - 3.0 * 0.25 * sizes[:, None] * normals + rng.normal(0, setting.noise, spots.shape)
    tilted = normals + rng.normal(0, 0.25, normals.shape)
    count, unit = len(spots), setting.unit
    scales = np.stack([sizes * rng.uniform(0.6, 1.3, count), sizes * rng.uniform(0.6, 1.3, count), 0.25 * sizes], 1)
    towards = eyes[None] - spots[:, None]
    towards /= np.linalg.norm(towards, axis=2, keepdims=True)
    weights = seen.sum(axis=1).astype(float)
    directions = (towards * seen[:, :, None]).sum(axis=1) / np.maximum(weights, 1)[:, None]
    gaussians = Gaussians(
        means=torch.tensor(spots * unit, dtype=torch.float32),
        log_scales=torch.tensor(np.log(scales * unit), dtype=torch.float32),
        quats=torch.tensor(quats_along_z(tilted), dtype=torch.float32),
        opacity_logits=torch.tensor(rng.normal(2.0, 0.5, count), dtype=torch.float32),
        sh=torch.tensor(rng.normal(0, 0.3, (count, 1, 3)), dtype=torch.float32),
    )
    truth = Truth(truth.centers * unit, truth.diameters * unit, truth.visible, truth.visible_fractions)
    moved = [_moved(camera, unit) for camera in cameras]
    seen_by = Visibility(weights, seen.sum(axis=1), directions, frame_of(moved))
    return Simulation(gaussians, probability, seen_by, moved, truth)


def quats_along_z(axes: FloatArray) -> FloatArray:
    """(N, 4) rotations w, x, y, z that turn z onto each axis (N, 3)."""
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    quats = np.stack([1 + axes[:, 2], -axes[:, 1], axes[:, 0], np.zeros(len(axes))], axis=1)
    quats[axes[:, 2] < -0.999999] = [0.0, 1.0, 0.0, 0.0]
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def look_at(eye: FloatArray, target: FloatArray, width: int = 360, height: int = 270, focal: float = 300.0) -> Camera:
    """A camera at `eye` looking at `target`, z up."""
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(K, look_along(eye, target - eye, np.array([0.0, 0.0, 1.0])), width, height)


def _ring(views: int, distance: float) -> list[Camera]:
    turns = np.arange(views) * 2 * np.pi / views
    heights = np.where(np.arange(views) % 2, 0.35, -0.1)
    eyes = distance * np.stack([np.cos(turns), np.sin(turns), heights], axis=1)
    return [look_at(eye, np.zeros(3)) for eye in eyes]


def _moved(camera: Camera, unit: float) -> Camera:
    pose = camera.world_to_camera.copy()
    pose[:3, 3] *= unit
    return Camera(camera.K, pose, camera.width, camera.height)


def _place(rng: np.random.Generator, radii: FloatArray, clump: int) -> FloatArray:
    """Centres of fruit in clumps of up to `clump` that touch but do not overlap."""
    extent = 1.3 * len(radii) ** (1 / 3)
    centers = np.zeros((0, 3))
    left = 0
    anchor: list[int] = []
    while len(centers) < len(radii):
        index = len(centers)
        if left == 0 or not anchor:
            spot = rng.uniform(-extent, extent, 3)
            fits = clear(spot, radii[index] + 0.15, centers, radii)
        else:
            onto = anchor[rng.integers(len(anchor))]
            step = _directions(rng, 1)[0] * (radii[index] + radii[onto]) * rng.uniform(1.0, 1.05)
            spot = centers[onto] + step
            fits = clear(spot, radii[index] - 0.001, centers, radii)
        if not fits:
            continue
        if left == 0:
            left, anchor = int(rng.integers(1, clump + 1)), []
        centers = np.vstack([centers, spot])
        anchor.append(index)
        left -= 1
        if left == 0:
            anchor = []
    return centers


def clear(spot: FloatArray, radius: float, centers: FloatArray, radii: FloatArray) -> bool:
    return len(centers) == 0 or bool((np.linalg.norm(centers - spot, axis=1) >= radius + radii[: len(centers)]).all())


def _leaves(
    rng: np.random.Generator, centers: FloatArray, radii: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    onto = rng.integers(len(centers), size=count)
    spots = centers[onto] + _directions(rng, count) * (radii[onto] + rng.uniform(0.25, 1.0, count))[:, None]
    return spots, _directions(rng, count)


def _seen(points, normals, owner, eyes, centers, radii, leaves, leaf_normals) -> NDArray[np.bool_]:
    """(P, V) whether camera v sees point p: faced, and neither fruit nor leaf (a disc of radius 0.4) in between."""
    seen = np.zeros((len(points), len(eyes)), bool)
    for view, eye in enumerate(eyes):
        ray = points - eye
        length = np.linalg.norm(ray, axis=1)
        ray /= length[:, None]
        free = np.einsum("pj,pj->p", ray, normals) < -0.1
        for other, (center, radius) in enumerate(zip(centers, radii, strict=True)):
            along = ray @ (center - eye)
            miss = np.linalg.norm((center - eye) - along[:, None] * ray, axis=1)
            free &= ~((miss < radius) & (along < length - 0.01) & (owner != other))
        for center, normal in zip(leaves, leaf_normals, strict=True):
            along = ((center - eye) @ normal) / (ray @ normal)
            hit = np.linalg.norm(eye + along[:, None] * ray - center, axis=1) < 0.4
            free &= ~(hit & (along > 0) & (along < length - 0.01))
        seen[:, view] = free
    return seen


def _sheet(rng: np.random.Generator, centers: FloatArray, eyes: FloatArray) -> tuple[FloatArray, ...]:
    """A wrongly selected leaf: a flat patch about two diameters across next to a fruit."""
    normal = _directions(rng, 1)[0]
    side = np.cross(normal, _directions(rng, 1)[0])
    side /= np.linalg.norm(side)
    middle = centers[rng.integers(len(centers))] + 1.5 * _directions(rng, 1)[0]
    spots = middle + rng.uniform(-1, 1, (60, 1)) * side + rng.uniform(-0.5, 0.5, (60, 1)) * np.cross(normal, side)
    seen = np.tile((eyes - middle) @ normal > 0, (60, 1))
    return spots, np.tile(normal, (60, 1)), np.full(60, 0.1), seen, rng.uniform(0.5, 0.8, 60)


def _directions(rng: np.random.Generator, count: int) -> FloatArray:
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def moved_by(tree: Simulation, turn: np.ndarray, shift: np.ndarray, scale: float) -> Simulation:
    """The same tree under x → scale · turn x + shift."""
    turned = Rotation.from_matrix(turn) * Rotation.from_quat(tree.gaussians.quats.numpy(), scalar_first=True)
    gaussians = replace(
        tree.gaussians,
        means=torch.tensor(scale * tree.gaussians.means.double().numpy() @ turn.T + shift, dtype=torch.float32),
        log_scales=tree.gaussians.log_scales + float(np.log(scale)),
        quats=torch.from_numpy(turned.as_quat(scalar_first=True)).float(),
    )
    cameras = []
    for camera in tree.cameras:
        pose = camera.world_to_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ turn.T
        pose[:3, 3] = scale * pose[:3, 3] - pose[:3, :3] @ shift
        cameras.append(Camera(camera.K, pose, camera.width, camera.height))
    directions = tree.visibility.directions @ turn.T
    seen = replace(tree.visibility, directions=directions, frame=frame_of(cameras))
    return replace(tree, gaussians=gaussians, cameras=cameras, visibility=seen)
