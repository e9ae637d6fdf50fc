"""The views in which fruit are searched: what the photos show of the prompt, and how far the Gaussians are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ...language.encoders.seen import resize
from ...language.prompts.photo_probability import PhotoMap
from ...splatting.kernels.surface import NOTHING
from ..evidence.visibility import Picture, spiral
from . import view_kernels
from .view_kernels import CHANNELS, LIKELY, Views

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

DISC, FEW = 0.9 * spiral(40), 0.9 * spiral(8)
"""(S, 2) spots tested on the disc of a sphere, in radii; FEW are enough to leave out most places."""
BLUR = 2.5
"""Pixels of a map by which offsets are smoothed: fruit of radius r look √(r² + this²) wide. Measured on apples, plums
and oranges that the network saw 15 to 30 pixels wide."""
LEAST_OF_SEEN = 0.5
"""Least radius, as a share of the one that is seen, that is left after the blur is subtracted."""
LEAST_VARIANCE = 1e-6
"""Mean squared deviation of offsets, in radii, from which they tell a radius: the rest is rounding."""
FARTHEST = 2**19
"""Places are searched up to this many steps from the origin of their frame, so that three of them make one number."""
SIDES = (2 * FARTHEST,) * 3
OWN, FOREIGN, THROUGH = 1.5, 0.3, 1.0
"""Weights of what a view shows of a sphere: pixels of a fruit with this centre count for it, those of other fruit and
what is seen through it against it."""


@dataclass(frozen=True, eq=False)
class PhotoViews:
    """V views of any sizes, their pixels one view after the other.

    probabilities: (n,) of the prompt in the photo; offsets: (n, 2) how far right and down from the centre of its fruit
    each pixel lies, in radii; depths: (n,) of the surface of the Gaussians along the viewing direction, scene units;
    starts: (V,) first pixel of each view; sizes: (V, 2) height and width; poses: (V, 3, 4) world to camera; lenses:
    (V, 4) fx, fy, cx, cy in pixels; blurs: (V,) BLUR in pixels of the view, which may have another size than its map.
    """

    probabilities: NDArray[np.float32]
    offsets: NDArray[np.float32]
    depths: NDArray[np.float32]
    starts: IntArray
    sizes: IntArray
    poses: FloatArray
    lenses: FloatArray
    blurs: FloatArray

    @classmethod
    def of(cls, pictures: Sequence[Picture], maps: Sequence[PhotoMap]) -> PhotoViews:
        """The views of rendered pictures; maps: what the photo of each shows, of any size."""
        sizes = [picture.depth.shape for picture in pictures]
        lengths = [picture.depth.size for picture in pictures]
        cameras = [picture.camera for picture in pictures]
        shown = (resize(torch.from_numpy(m.probability)[None], *size) for m, size in zip(maps, sizes, strict=True))
        return cls(
            np.concatenate([each.numpy().reshape(-1) for each in shown]),
            np.concatenate(
                [_pick_nearest(m.offsets, size).reshape(-1, 2) for m, size in zip(maps, sizes, strict=True)]
            ),
            np.concatenate([picture.depth.reshape(-1) for picture in pictures]),
            np.cumsum([0, *lengths[:-1]]),
            np.array(sizes, np.int64),
            np.stack([camera.world_to_camera[:3] for camera in cameras]),
            np.array([[camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]] for camera in cameras]),
            np.array([BLUR * size[1] / m.probability.shape[1] for m, size in zip(maps, sizes, strict=True)]),
        )

    @property
    def eyes(self) -> FloatArray:
        """(V, 3) where the cameras are."""
        return -np.einsum("vji,vj->vi", self.poses[:, :, :3], self.poses[:, :, 3])

    @property
    def arrays(self) -> Views:
        """The arrays as kernels take them."""
        return (self.probabilities, self.offsets, self.depths, self.starts, self.sizes, self.poses, self.lenses)

    def places(self, radius: float, pushes: Sequence[float], step: float, frame: FloatArray) -> FloatArray:
        """(S, 3) centres of the fruit that pixels show, `pushes` behind where their depth puts them, at least `step`
        apart, all in scene units. radius: of a fruit; frame: (3, 4) from the world to the axes along which places are
        separated."""
        found = [np.zeros(0, np.int64)]
        for start, (height, width), pose, lens in zip(self.starts, self.sizes, self.poses, self.lenses, strict=True):
            part = slice(start, start + height * width)
            depths = self.depths[part]
            shown = np.flatnonzero((self.probabilities[part] >= LIKELY) & (depths < NOTHING))
            pixels = np.stack([shown % width, shown // width], axis=1) + 0.5
            off, near = self.offsets[part][shown].astype(np.float64), depths[shown].astype(np.float64)
            rays = (pixels - lens[2:]) / lens[:2] - off * radius / near[:, None]
            rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
            middle = near + radius * np.sqrt(np.maximum(1.0 - (off**2).sum(axis=1), 0.0))
            behind = ((rays * (middle + push)[:, None] - pose[:, 3]) @ pose[:, :3] for push in pushes)
            found += [find_occupied_cubes(places, step, frame) for places in behind]
        return cube_centers(np.unique(np.concatenate(found)), step, frame)

    def score(self, centers: FloatArray, radius: float, disc: FloatArray = DISC) -> FloatArray:
        """(C,) how well spheres of a radius explain what the views show; a first guess."""
        scores = np.empty(len(centers))
        weights = np.array([OWN, FOREIGN, THROUGH])
        view_kernels.score_spheres(self.arrays, np.ascontiguousarray(centers), radius, disc, weights, scores)
        return scores

    def choose(self, centers: FloatArray, radii: FloatArray, most: int) -> tuple[IntArray, FloatArray]:
        """The views that show most of each sphere, (C, most), and what all views show of it, (C, 5); see
        `view_kernels.choose_views`."""
        chosen, sums = np.empty((len(centers), most), np.int64), np.zeros((len(centers), 5))
        view_kernels.choose_views(self.arrays, centers, radii, DISC, chosen, sums)
        return chosen, sums

    def measured(self, centers: FloatArray, radii: FloatArray, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
        """The radii (C,) of fruit at C centres, scene units, and how many pixels tell them: an offset grows by one from
        the centre of a fruit to its rim, so how fast it changes along the photo says how large the fruit is, also where
        only a part of it shows. radii: (C,) a first guess; chosen: (C, K) views. A radius is NaN where no pixels tell
        it, or only such as have all the same offset."""
        sums = np.zeros((len(centers), 4))
        view_kernels.measure_radii(self.arrays, centers, radii, chosen, self.blurs, sums)
        weight, square, product, blurred = sums.T
        usable = (square > LEAST_VARIANCE * weight) & (product > 0.0)
        seen = product / np.where(usable, square, 1.0)
        found = np.sqrt(np.maximum(seen**2 - blurred / np.where(usable, square, 1.0), (LEAST_OF_SEEN * seen) ** 2))
        return np.where(usable, found, np.nan), np.where(usable, weight, 0.0)

    def crops(
        self,
        centers: FloatArray,
        radii: FloatArray,
        chosen: IntArray,
        others: FloatArray,
        other_radii: FloatArray,
        near: IntArray,
        *,
        cells: int,
        span: float,
    ) -> NDArray[np.float32]:
        """(C, K, CHANNELS, cells, cells) surroundings of the spheres in the chosen views; see
        `view_kernels.cut_crops`."""
        crops = np.zeros((*chosen.shape, CHANNELS, cells, cells), np.float32)
        view_kernels.cut_crops(self.arrays, centers, radii, chosen, others, other_radii, near, span, crops)
        return crops

    def project(self, centers: FloatArray, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (C, K, 2) and depths (C, K) of centres in the chosen views; those of view 0 where there is none."""
        index = np.maximum(chosen, 0)
        camera = np.einsum("ckij,cj->cki", self.poses[index, :, :3], centers) + self.poses[index, :, 3]
        lens, depths = self.lenses[index], np.maximum(camera[..., 2], 1e-12)
        return lens[..., :2] * camera[..., :2] / depths[..., None] + lens[..., 2:], depths

    def pixels_wide(self, centers: FloatArray, radii: FloatArray, chosen: IntArray) -> FloatArray:
        """(C,) the mean width of spheres in the chosen views, in pixels of the maps; 0 where none is chosen."""
        index, seen = np.maximum(chosen, 0), chosen >= 0
        _, depths = self.project(centers, chosen)
        widths = 2.0 * radii[:, None] * self.lenses[index, 0] / depths * (BLUR / self.blurs[index])
        mean: FloatArray = (widths * seen).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
        return mean

    def slopes(self, centers: FloatArray, chosen: IntArray) -> FloatArray:
        """(C, K, 2, 3) change of the pixel of a centre in each chosen view per scene unit."""
        index = np.maximum(chosen, 0)
        pixels, depths = self.project(centers, chosen)
        lens, turned = self.lenses[index], self.poses[index, :, :3]
        off = (pixels - lens[..., 2:]) / lens[..., :2]
        return (lens[..., :2] / depths[..., None])[..., None] * (
            turned[..., :2, :] - off[..., None] * turned[..., 2:, :]
        )


def find_occupied_cubes(places: FloatArray, step: float, frame: FloatArray) -> IntArray:
    """Find the numbers of the cubes of side `step` that places (S, 3) lie in, see `cubes`, each once, in order; those
    at FARTHEST cubes from the origin of the frame or more are left out."""
    steps = _steps(places, step, frame)
    return np.unique(_number_cubes(steps[(np.abs(steps) < FARTHEST).all(axis=1)]))


def cube_centers(numbers: IntArray, step: float, frame: FloatArray) -> FloatArray:
    """(S, 3) the centres of the cubes with these numbers (S,)."""
    scale = float(np.linalg.norm(frame[0, :3]))
    found = np.stack(np.unravel_index(numbers, SIDES), axis=1) - FARTHEST
    centers: FloatArray = ((found + 0.5) * step * scale - frame[:, 3]) @ frame[:, :3] / scale**2
    return centers


def cubes(places: FloatArray, step: float, frame: FloatArray) -> IntArray:
    """(S,) the number of the cube of side `step`, scene units, that each place (S, 3) lies in, cut along the axes of
    `frame` (3, 4)."""
    return _number_cubes(_steps(places, step, frame))


def _steps(places: FloatArray, step: float, frame: FloatArray) -> IntArray:
    """(S, 3) which cube along each axis of the frame each place lies in."""
    side = step * float(np.linalg.norm(frame[0, :3]))
    return np.floor((places @ frame[:, :3].T + frame[:, 3]) / side).astype(np.int64)


def _number_cubes(steps: IntArray) -> IntArray:
    """Give each cube (S, 3) one number (S,): numbers are sorted five times as fast as rows."""
    return np.ravel_multi_index(tuple(steps.T + FARTHEST), SIDES, mode="clip").astype(np.int64)


def _pick_nearest(values: NDArray[np.float32], size: tuple[int, ...]) -> NDArray[np.float32]:
    """Resample (H, W, 2) to (*size, 2) by the nearest of each."""
    rows, columns = ((np.arange(new) + 0.5) * old / new for new, old in zip(size, values.shape, strict=False))
    return np.ascontiguousarray(values[rows.astype(int)[:, None], columns.astype(int)])
