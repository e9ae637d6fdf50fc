"""PatchMatch stereo adds points on surfaces where SIFT finds none and photos agree.

Training starts from all points; where there are none, it leaves out what the photos show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from ...progress import Progress
from .job import Job
from .kernels.planes import match_stereo
from .placing import LEAST_ANGLE
from .views import Observations, Pictures, Views, read_picture, stack_pictures

_PIXELS = 270_000
"""Pixels of the pictures that are compared."""
_SPACING, _STEP = 8, 2
"""Distance between the pixels whose surface is searched, and between the samples of a patch around them."""
_MARGIN = 8
"""Pixels from the border of a picture to the first searched one."""
_NEAR_PHOTOS = 6
"""Photos that each one is compared with."""
_LEAST_SHARED = 5
"""Points that two photos must both see to be compared."""
_ENOUGH_ANGLE = 8.0
"""Angle in degrees between the rays of two photos above which depths hardly become more accurate."""
_KNOWN, _RANDOM = 8, 6
"""Initial depths per pixel: those of the nearest points in the photo, and random ones among all its depths."""
_NOISE = 0.02
"""Relative deviation that is added to known depths."""
_ITERATIONS = 2
_LEAST_LIKENESS = 0.6
"""Correlation of a surface with other photos, below which it is unknown."""
_SAME_DEPTH = 0.01
"""Relative difference of depth up to which two photos agree."""
_LEAST_AGREEING = 1
"""Other photos that must agree with a point. Fruit between leaves are often seen by two photos only."""
_APART = 6.0
"""Least distance of a new point from others, in pixels."""
_MOST = 40_000
"""Most new points: training has room for 70,000 Gaussians, and splits them where it needs more."""


@dataclass(frozen=True, eq=False)
class _View:
    """One photo, made smaller.

    name: of its copy; camera: of the copy, SIMPLE_RADIAL; rotation (3, 3) and translation (3,) of its pose; scale:
    pixels per pixel of the copy; columns (W,), rows (H,): of the searched pixels; rays: (H, W, 2) of them; near:
    positions of the photos that it is compared with.
    """

    name: str
    camera: Any
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    scale: float
    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    rays: NDArray[np.float64]
    near: NDArray[np.int64]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return int(self.scale * self.camera.height), int(self.scale * self.camera.width)

    @property
    def lens(self) -> NDArray[np.float64]:
        """(4,) focal length, principal point and radial distortion, in pixels."""
        return np.array(self.camera.params) * [self.scale, self.scale, self.scale, 1.0]

    def picture(self, job: Job) -> Image.Image:
        height, width = self.size
        box = (0.0, 0.0, width / self.scale, height / self.scale)
        return read_picture(job, self.name).resize((width, height), Image.Resampling.BOX, box)

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) in the frame of the camera."""
        result: NDArray[np.float64] = points @ self.rotation.T + self.translation
        return result

    def world(self, rays: NDArray[np.float64], inverse: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) at inverse depths (N,) along rays (N, 2)."""
        result: NDArray[np.float64] = (_homogeneous(rays) / inverse[:, None] - self.translation) @ self.rotation
        return result

    def pixels(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) pixels of points (N, 3) in the frame of the camera."""
        result: NDArray[np.float64] = self.scale * np.asarray(self.camera.img_from_cam(local)).reshape(-1, 2)
        return result


@dataclass(frozen=True, eq=False)
class _Surface:
    """What a photo shows at its searched pixels: planes (H, W, 3) and likeness (H, W), of `match_stereo`."""

    planes: NDArray[np.float64]
    likeness: NDArray[np.float64]


def add_surfaces(job: Job, model: Any, report: Progress) -> Any:
    """Return a model with the same cameras and points, and with points of surfaces where it has none.

    model: of the copies, with refined cameras; photos without a pose are dropped.
    """
    placed = Views.of(job, model)
    seen = placed.observations()
    if not len(seen.xyz):
        return model
    views = _views(placed, seen)
    pictures = stack_pictures((view.picture(job) for view in views), [view.size for view in views])
    surfaces = []
    for number, view in enumerate(views):
        report(0.9 * number / len(views), f"comparing surfaces: photo {number + 1} of {len(views)}")
        known = seen.view == number
        guesses = _guesses(view, seen.xyz[seen.point[known]], seen.pixel[known], [job.config.seed, number])
        surfaces.append(_surface(views, pictures, number, guesses, job.config.seed))
    report(0.9, "comparing surfaces")
    parts = [_fuse(views, surfaces, number) for number in range(len(views))]
    found = _Found(
        Observations.concatenate([each.seen for each in parts]),
        likeness=np.concatenate([each.likeness for each in parts]),
        size=np.concatenate([each.size for each in parts]),
    )
    new = found.seen.select(_select_in_gaps(seen.xyz, found))
    return placed.make_model(Observations.concatenate([seen, new]))


def _views(placed: Views, seen: Observations) -> list[_View]:
    """The photos with the pixels that are searched."""
    shared = _find_near(placed, seen)
    views = []
    for number, image in enumerate(placed.images):
        camera = placed.model.cameras[image.camera_id]
        scale = min((_PIXELS / (camera.width * camera.height)) ** 0.5, 1.0)
        columns, rows = (
            np.arange(_MARGIN, int(scale * side) - _MARGIN, _SPACING) for side in (camera.width, camera.height)
        )
        grid = _grid(columns, rows)
        views.append(
            _View(
                name=image.name,
                camera=camera,
                rotation=placed.rotations[number],
                translation=placed.translations[number],
                scale=scale,
                columns=columns,
                rows=rows,
                rays=np.asarray(camera.cam_from_img(grid.reshape(-1, 2) / scale)).reshape(grid.shape),
                near=shared[number],
            )
        )
    return views


def _grid(columns: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """(H, W, 2) the middles of the pixels at these columns (W,) and rows (H,)."""
    return np.stack(np.meshgrid(columns + 0.5, rows + 0.5), axis=-1)


def _find_near(placed: Views, seen: Observations) -> list[NDArray[np.int64]]:
    """Find, per photo, the positions of those that it is compared with: they share many points, seen from other
    places."""
    common = seen.count_shared(len(placed.images))
    near = []
    for number, center in enumerate(placed.centers):
        own = seen.select_shown(number)
        middle = np.median(own, axis=0) if len(own) else center
        rays = placed.centers - middle
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles = np.degrees(np.arccos(np.clip(rays @ rays[number], -1.0, 1.0)))
        usefulness = common[number] * np.minimum(angles / _ENOUGH_ANGLE, 1.0)
        common[number, angles < LEAST_ANGLE] = 0.0
        ranked = np.argsort(-usefulness, kind="stable")[:_NEAR_PHOTOS]
        near.append(ranked[common[number, ranked] >= _LEAST_SHARED])
    return near


def _guesses(
    view: _View, points: NDArray[np.float64], pixels: NDArray[np.float64], seed: Sequence[int]
) -> NDArray[np.float64]:
    """(H, W, G) inverse depths that the search of a photo begins with; G = 0 if it sees too few points.

    points (N, 3), pixels (N, 2): the points that it sees, and where, in pixels of the copy.
    """
    shape = view.rays.shape[:2]
    if len(points) < _KNOWN:
        return np.zeros((*shape, 0))
    random = np.random.default_rng(seed)
    inverse = 1.0 / view.local(points)[:, 2]
    grid = _grid(view.columns, view.rows).reshape(-1, 2)
    nearest = cKDTree(pixels * view.scale).query(grid, k=_KNOWN)[1]
    known = inverse[nearest] * (1.0 + _NOISE * random.normal(size=nearest.shape))
    far, near = np.quantile(inverse, [0.01, 0.99])
    others = random.uniform(0.8 * far, 1.1 * near, (len(grid), _RANDOM))
    return np.ascontiguousarray(np.concatenate([known, others], axis=1).reshape(*shape, -1))


def _surface(
    views: Sequence[_View], pictures: Pictures, number: int, guesses: NDArray[np.float64], seed: int
) -> _Surface:
    """What the photo at a position shows; nothing if there are no photos or depths to compare."""
    view, others = views[number], [views[other] for other in views[number].near]
    planes, likeness = np.zeros((*view.rays.shape[:2], 3)), np.full(view.rays.shape[:2], -1.0)
    if others and guesses.size:
        turns = np.stack([other.rotation @ view.rotation.T for other in others])
        moves = np.stack([other.translation for other in others]) - turns @ view.translation
        match_stereo(
            pictures, number, view.columns, view.rows, _STEP, view.rays, guesses, view.near, turns, moves,
            np.stack([other.lens for other in others]), view.lens[0], _ITERATIONS, seed * len(views) + number, planes,
            likeness,
        )  # fmt: skip
    return _Surface(planes, likeness)


@dataclass(frozen=True, eq=False)
class _Found:
    """Points of photos that others agree with, and where they are seen; likeness (N,); size: (N,) of a pixel there, in
    units of the model."""

    seen: Observations
    likeness: NDArray[np.float64]
    size: NDArray[np.float64]


def _fuse(views: Sequence[_View], surfaces: Sequence[_Surface], number: int) -> _Found:
    """Keep the points of one photo that enough others agree with, at the mean of what these photos estimate."""
    view, surface = views[number], surfaces[number]
    row, column = np.nonzero(surface.likeness > _LEAST_LIKENESS)
    rays = view.rays[row, column]
    inverse = np.einsum("ni,ni->n", surface.planes[row, column], _homogeneous(rays))
    own = view.world(rays, inverse)
    point, where, places = [np.arange(len(own))], [np.full(len(own), number)], [own]
    for other in view.near:
        same, xyz = _find_consistent(views[other], surfaces[other], own)
        point.append(same)
        where.append(np.full(len(same), other))
        places.append(xyz)
    points, numbers = np.concatenate(point), np.concatenate(where)
    count = np.bincount(points, minlength=len(own))
    sums = np.zeros_like(own)
    np.add.at(sums, points, np.concatenate(places))
    agreed = np.flatnonzero(count > _LEAST_AGREEING)
    everything = Observations(sums / count[:, None], point=points, view=numbers, pixel=np.empty((len(points), 2)))
    seen = everything.select(agreed)
    for other in (number, *view.near):
        shown = seen.view == other
        seen.pixel[shown] = views[other].pixels(views[other].local(seen.xyz[seen.point[shown]])) / views[other].scale
    return _Found(seen, surface.likeness[row, column][agreed], 1.0 / (view.lens[0] * inverse[agreed]))


def _find_consistent(
    view: _View, surface: _Surface, xyz: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find which of the points a photo shows at the same depth, and the positions (M, 3) that it estimates."""
    local = view.local(xyz)
    front = np.flatnonzero(local[:, 2] > 1e-9)
    cell = np.rint((view.pixels(local[front]) - 0.5 - _MARGIN) / _SPACING)
    inside = ((cell >= 0) & (cell < [len(view.columns), len(view.rows)])).all(1)
    front, (column, row) = front[inside], cell[inside].astype(np.int64).T
    rays = local[front, :2] / local[front, 2:]
    inverse = np.einsum("ni,ni->n", surface.planes[row, column], _homogeneous(rays))
    same = np.abs(inverse * local[front, 2] - 1.0) < _SAME_DEPTH
    same &= surface.likeness[row, column] > _LEAST_LIKENESS
    return front[same], view.world(rays[same], inverse[same])


def _homogeneous(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) rays (N, 2) with a third component of 1."""
    return np.column_stack([rays, np.ones(len(rays))])


def _select_in_gaps(known: NDArray[np.float64], found: _Found) -> NDArray[np.int64]:
    """Select found points that are apart from known ones and from each other, the most certain first; of too many,
    those that are farther apart."""
    xyz, apart = found.seen.xyz, _APART * found.size
    tree, free = cKDTree(xyz), cKDTree(known).query(xyz)[0]
    order = np.argsort(-found.likeness, kind="stable")
    while True:
        taken, kept = free <= apart, []
        for number in order:
            if not taken[number]:
                taken[tree.query_ball_point(xyz[number], apart[number])] = True
                kept.append(number)
        if len(kept) <= _MOST:
            return np.array(kept, np.int64)
        apart = 1.5 * apart
