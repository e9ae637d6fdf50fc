"""Simulated crowns of ellipsoids and leaves, rendered by their true depths: tests of counting alone, in seconds.

The six settings are hard cases of counting. The visible surfaces of a crown become Gaussians (see `true_surface`); then
noise, drift, leaves mistaken for fruit and floaters are added.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...engine.compiled.jit import njit
from ...engine.evaluation.true_surface import true_surface
from ...engine.evaluation.truth import Truth
from ...engine.scene.camera import ArrayPhoto, Camera, Scene, look_along
from ...engine.splatting.gaussians import Gaussians

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

WIDTH, HEIGHT, FOCAL = 480, 480, 560.0
DISTANCE = 26.0
"""Distance of the cameras from the trunk; all lengths are in mean fruit diameters."""
CROWN = (9.0, 9.0, 7.0)
"""Half axes of the crown, in whose outer half the fruit hang."""
LEAST_VISIBLE = 0.05
"""A fruit must be counted if its best view shows at least this share of it."""
SHOWN_VIEWS, SHOWN_SHARE, SHOWN_PIXELS = 3, 0.1, 12
"""Requirements of `Truth.visible` for a fruit: number of views, share of its disc and pixels."""
LEAF = (0.75, 0.4, 0.03)
"""Half axes of a leaf."""
WRONG = 60_000
"""Instance numbers from here on are leaves mistaken for fruit."""
FLOATER = 0.06
"""Standard deviation of a floater."""
TILT = 15.0
"""Error of normals in degrees."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What makes a simulated crown hard. Lengths are in mean fruit diameters.

    fruits: fewest and most; least_clump, clump: fewest and most fruit that touch; size_cv: standard deviation of log
    diameter; long: largest elongation of one axis; leaves; wrong: share of the leaves that are mistaken for fruit;
    floaters: share of the Gaussians; noise: least and most standard deviation of positions; views; arc: degrees that
    they go around; drift: offset of what one half of the views shows.
    """

    fruits: tuple[int, int] = (200, 400)
    least_clump: int = 1
    clump: int = 1
    size_cv: float = 0.08
    long: float = 1.1
    leaves: int = 1500
    wrong: float = 0.01
    floaters: float = 0.01
    noise: tuple[float, float] = (0.03, 0.06)
    views: int = 36
    arc: float = 360.0
    drift: float = 0.0


SETTINGS: Mapping[str, Setting] = {
    "sparse": Setting(),
    "clumped": Setting(fruits=(400, 800), clump=12),
    "mixed sizes": Setting(clump=4, size_cv=0.33, long=1.5),
    "heavy occlusion": Setting(clump=4, leaves=9000, wrong=0.005),
    "half ring": Setting(clump=4, views=24, arc=180.0),
    "drift between sides": Setting(clump=4, views=48, drift=0.15),
}
"""By name."""
_EVEN = Setting(fruits=(240, 240))
"""240 fruit are whole clumps of any size below."""
AXES: Mapping[str, Mapping[str, Setting]] = {
    "clump": {f"{size} touch": replace(_EVEN, least_clump=size, clump=size) for size in (2, 3, 4, 6, 8, 12)},
    "spread": {f"spread {cv:g}": replace(_EVEN, clump=4, size_cv=cv) for cv in (0.05, 0.1, 0.2, 0.3, 0.4)},
    "pairs": {"pairs": Setting(fruits=(480, 480), least_clump=2, clump=2, leaves=2000)},
}
"""Settings that vary one condition, by condition and name."""


def sample_setting(seed: int) -> Setting:
    """Sample a setting within and slightly beyond the range of the named ones."""
    rng = np.random.default_rng([seed, 7])

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    fruits, around = round(between(20, 800)), rng.random() < 0.8
    return Setting(
        fruits=(fruits, fruits),
        clump=int(rng.integers(1, 13)),
        size_cv=between(0.05, 0.35),
        long=rng.uniform(1.0, 1.5),
        leaves=round(between(300, 9000)),
        wrong=between(0.002, 0.02),
        floaters=rng.uniform(0.0, 0.02),
        views=int(rng.integers(24, 49)),
        arc=360.0 if around else 180.0,
        drift=rng.uniform(0.0, 0.15) if rng.random() < 0.3 else 0.0,
    )


@dataclass(frozen=True, eq=False)
class Simulation:
    """gaussians with probability (N,) of being fruit; the cameras; truth, in the same frame; shown: (M,) true fruit of
    which three views show a tenth and twelve pixels, a stricter criterion than `truth.visible`."""

    gaussians: Gaussians
    probability: torch.Tensor
    cameras: list[Camera]
    truth: Truth
    shown: NDArray[np.bool_]


def simulate(setting: Setting, seed: int) -> Simulation:
    """Generate a crown, render it, and make Gaussians of its visible surfaces. Seeded."""
    rng = np.random.default_rng(seed)
    fruit, leaves = _make_fruit(setting, rng), _make_leaves(setting, rng)
    bodies = fruit.join(leaves)
    wrong = rng.random(len(leaves)) < setting.wrong
    numbers = np.concatenate([1 + np.arange(len(fruit)), np.where(wrong, WRONG + np.arange(len(leaves)), 0)])
    cameras = _make_cameras(setting)
    depths, instances, fractions, views = [], [], np.zeros(len(fruit)), np.zeros(len(fruit), np.int64)
    for camera in cameras:
        depth, body, whole = _draw_bodies(bodies, camera)
        shown = np.where(body >= 0, numbers[body], 0)
        seen = np.bincount(body[body >= 0], minlength=len(bodies))[: len(fruit)]
        part = seen / np.maximum(whole[: len(fruit)], 1)
        fractions = np.maximum(fractions, part)
        views += (part >= SHOWN_SHARE) & (seen >= SHOWN_PIXELS)
        depths.append(depth)
        instances.append(shown.astype(np.uint16))
    surface = true_surface(_make_scene(_drift(cameras, setting)), depths, instances)
    gaussians, probability = _roughen(surface.gaussians, torch.from_numpy(surface.fruit > 0), setting, rng)
    diameters = 2.0 * np.cbrt(fruit.half_axes.prod(axis=1))
    truth = Truth(
        centers=fruit.centers,
        diameters=diameters,
        visible=fractions >= LEAST_VISIBLE,
        visible_fractions=fractions,
        ids=1 + np.arange(len(fruit)),
    )
    return Simulation(gaussians, probability, cameras, truth, views >= SHOWN_VIEWS)


@dataclass(frozen=True, eq=False)
class _Bodies:
    """M ellipsoids. centers, half_axes: (M, 3); turns: (M, 3, 3) whose columns are the axes."""

    centers: FloatArray
    half_axes: FloatArray
    turns: FloatArray

    def __len__(self) -> int:
        return len(self.centers)

    def join(self, other: _Bodies) -> _Bodies:
        return _Bodies(
            np.concatenate([self.centers, other.centers]),
            np.concatenate([self.half_axes, other.half_axes]),
            np.concatenate([self.turns, other.turns]),
        )


def _make_fruit(setting: Setting, rng: np.random.Generator) -> _Bodies:
    """Make clumps of touching fruit that do not overlap by more than a tenth."""
    count = int(rng.integers(setting.fruits[0], setting.fruits[1] + 1))
    radii = 0.5 * np.exp(rng.normal(0.0, setting.size_cv, count) - 0.5 * setting.size_cv**2)
    centers = np.zeros((count, 3))
    placed = 0
    while placed < count:
        size = int(rng.integers(setting.least_clump, setting.clump + 1))
        for member in range(min(size, count - placed)):
            centers[placed] = _find_free_place(centers[:placed], radii, placed, member, rng)
            placed += 1
    half_axes = np.repeat(radii[:, None], 3, axis=1)
    half_axes[:, 2] *= rng.uniform(1.0, setting.long, count)
    return _Bodies(centers, half_axes, Rotation.random(count, random_state=rng).as_matrix())


def _find_free_place(
    centers: FloatArray, radii: FloatArray, number: int, member: int, rng: np.random.Generator, tries: int = 200
) -> FloatArray:
    """Find a position of fruit `number`: free in the crown, or touching an earlier member of its clump."""
    place = _sample_in_crown(rng)
    for _ in range(tries):
        if member:
            friend = number - 1 - int(rng.integers(member))
            place = centers[friend] + _sample_direction(rng) * (radii[friend] + radii[number]) * rng.uniform(0.98, 1.06)
        else:
            place = _sample_in_crown(rng)
        apart = np.linalg.norm(centers - place, axis=1)
        if (apart > 0.95 * (radii[:number] + radii[number])).all():
            return place
    return place


def _sample_in_crown(rng: np.random.Generator) -> FloatArray:
    place: FloatArray = np.array(CROWN) * _sample_direction(rng) * np.cbrt(rng.uniform(0.15, 1.0))
    return place


def _sample_direction(rng: np.random.Generator) -> FloatArray:
    direction = rng.standard_normal(3)
    unit: FloatArray = direction / np.linalg.norm(direction)
    return unit


def _make_leaves(setting: Setting, rng: np.random.Generator) -> _Bodies:
    centers = np.stack([_sample_in_crown(rng) for _ in range(setting.leaves)])
    sizes = np.array(LEAF) * rng.uniform(0.6, 1.3, (setting.leaves, 1))
    return _Bodies(centers, sizes, Rotation.random(setting.leaves, random_state=rng).as_matrix())


def _make_cameras(setting: Setting) -> list[Camera]:
    """Make cameras around the trunk in a wave, looking at the middle of the crown; z is up."""
    K = np.array([[FOCAL, 0.0, WIDTH / 2.0], [0.0, FOCAL, HEIGHT / 2.0], [0.0, 0.0, 1.0]])
    cameras = []
    for view in range(setting.views):
        turn = np.radians(setting.arc) * (view + 0.5) / setting.views
        height = DISTANCE * 0.35 * np.sin(2.0 * np.pi * 3.0 * view / setting.views)
        center = np.array([DISTANCE * np.cos(turn), DISTANCE * np.sin(turn), height])
        cameras.append(Camera(K, look_along(center, -center, np.array([0.0, 0.0, 1.0])), WIDTH, HEIGHT))
    return cameras


def _drift(cameras: list[Camera], setting: Setting) -> list[Camera]:
    """Return the cameras of a poor reconstruction: one half of the ring is off sideways and in height."""
    drifted = []
    for view, camera in enumerate(cameras):
        pose = camera.world_to_camera.copy()
        if view >= len(cameras) // 2:
            pose[:3, 3] -= pose[:3, :3] @ (setting.drift * np.array([0.6, 0.6, 0.52]))
        drifted.append(Camera(camera.K, pose, camera.width, camera.height))
    return drifted


def _make_scene(cameras: list[Camera]) -> Scene:
    grey = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    return Scene(
        cameras=cameras,
        images=[ArrayPhoto(f"{view:03d}.png", grey) for view in range(len(cameras))],
        points=np.zeros((1, 3)),
        colors=np.zeros((1, 3), np.uint8),
        up=np.array([0.0, 0.0, 1.0]),
    )


def _draw_bodies(bodies: _Bodies, camera: Camera) -> tuple[NDArray[np.float32], IntArray, IntArray]:
    """Draw depths (H, W) along the axis, 0 for nothing, and bodies, -1 for none; (M,) pixels of each with nothing
    before."""
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    # |A (x − c)| = 1 on the surface; x along a pixel's ray from the camera, which stands at 0.
    to_ball = (turn @ bodies.turns / bodies.half_axes[:, None, :]).transpose(0, 2, 1)
    depth, body, whole = np.zeros((HEIGHT, WIDTH)), np.full((HEIGHT, WIDTH), -1), np.zeros(len(bodies), np.int64)
    centers = bodies.centers @ turn.T + shift
    _draw(np.ascontiguousarray(to_ball), centers, bodies.half_axes.max(axis=1), FOCAL, depth, body, whole)
    return depth.astype(np.float32), body, whole


@njit
def _draw(
    to_ball: FloatArray,
    centers: FloatArray,
    reach: FloatArray,
    focal: float,
    depth: FloatArray,
    body: IntArray,
    whole: IntArray,
) -> None:
    height, width = depth.shape
    for m in range(len(centers)):
        x, y, z = centers[m]
        if z <= 2.0 * reach[m]:
            continue
        half = focal * reach[m] / (z - reach[m]) + 1.0
        u, v = focal * x / z + width / 2.0, focal * y / z + height / 2.0
        A = to_ball[m]
        c0 = A[0, 0] * x + A[0, 1] * y + A[0, 2] * z
        c1 = A[1, 0] * x + A[1, 1] * y + A[1, 2] * z
        c2 = A[2, 0] * x + A[2, 1] * y + A[2, 2] * z
        cc = c0 * c0 + c1 * c1 + c2 * c2 - 1.0
        for row in range(max(0, int(v - half)), min(height, int(v + half) + 1)):
            ry = (row + 0.5 - height / 2.0) / focal
            for column in range(max(0, int(u - half)), min(width, int(u + half) + 1)):
                rx = (column + 0.5 - width / 2.0) / focal
                d0 = A[0, 0] * rx + A[0, 1] * ry + A[0, 2]
                d1 = A[1, 0] * rx + A[1, 1] * ry + A[1, 2]
                d2 = A[2, 0] * rx + A[2, 1] * ry + A[2, 2]
                dd, dc = d0 * d0 + d1 * d1 + d2 * d2, d0 * c0 + d1 * c1 + d2 * c2
                root = dc * dc - dd * cc
                if root < 0.0:
                    continue
                whole[m] += 1
                near = (dc - np.sqrt(root)) / dd
                if depth[row, column] == 0.0 or near < depth[row, column]:
                    depth[row, column], body[row, column] = near, m


def _roughen(
    gaussians: Gaussians, fruit: torch.Tensor, setting: Setting, rng: np.random.Generator
) -> tuple[Gaussians, torch.Tensor]:
    """Add noise on positions and normals, and floaters mistaken for fruit."""
    n = len(gaussians)
    noise = rng.uniform(*setting.noise)
    means = gaussians.means.numpy() + rng.normal(0.0, noise, (n, 3))
    turned = Rotation.from_quat(gaussians.quats.numpy()[:, [1, 2, 3, 0]])
    tilts = Rotation.from_rotvec(np.radians(TILT) * rng.normal(0.0, 1.0, (n, 3)))
    quats = (tilts * turned).as_quat()[:, [3, 0, 1, 2]]
    extra = rng.integers(0, n, round(setting.floaters * int(fruit.sum())))
    floating = gaussians.select(torch.from_numpy(extra))
    places = np.stack([_sample_in_crown(rng) for _ in extra]) if len(extra) else np.zeros((0, 3))
    together = Gaussians(
        means=torch.from_numpy(np.concatenate([means, places])).float(),
        log_scales=torch.cat([gaussians.log_scales, torch.full((len(extra), 3), float(np.log(FLOATER)))]),
        quats=torch.cat([torch.from_numpy(quats).float(), floating.quats]),
        opacity_logits=torch.cat([gaussians.opacity_logits, floating.opacity_logits]),
        sh=torch.cat([gaussians.sh, floating.sh]),
        antialiased=gaussians.antialiased,
    )
    return together, torch.cat([fruit, torch.ones(len(extra), dtype=torch.bool)]).float()
