"""The colour of each fruit: that of the pixels that show it, or without photos of the Gaussians on it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...language.prompts.colour_choice import ColourChoice
from ...language.prompts.photo_probability import PhotoMap
from ...splatting.gaussians import Gaussians
from .cluster import Clusters
from .visibility import SPOTS, Picture, spiral

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

INSIDE = 0.8
"""Radii around the centre of a fruit whose pixels are used: those at its rim mix with what is behind it."""
OFF = 0.5
"""Radii by which the place on its fruit that a pixel tells may differ from its place on this one."""
DOUBT = 0.05
"""Difference between the shares of two colours at which either may be the colour of a fruit."""
NEAR = (0.6, 1.3)
"""Distances in radii between which Gaussians are on the surface of a fruit."""


@dataclass(frozen=True, eq=False)
class FruitColours:
    """The colours of fruit, of which some are asked for; without a choice all are.

    weights: (N,) how much each of the Gaussians counts, 0 for those that are no fruit; pictures, maps: of the photos;
    threshold: probability from which a pixel shows fruit.
    """

    choice: ColourChoice | None
    gaussians: Gaussians
    weights: FloatArray
    pictures: Sequence[Picture]
    maps: Sequence[PhotoMap] | None
    threshold: float

    @property
    def refusal(self) -> str:
        """Why a fruit of another colour is not counted."""
        assert self.choice is not None
        split = self.choice.split
        return f"its fruit are not {' or '.join(itertools.compress(split.words, split.asked))}"

    def keep(self, clusters: Clusters) -> Clusters:
        """The clusters without fruit of other colours."""
        chosen = self.chances(clusters.spheres.centers, clusters.spheres.radii) > 0.5
        return clusters if chosen.all() else clusters.keep(chosen, np.ones(len(clusters.points), bool), self.refusal)

    def chances(self, centers: FloatArray, radii: FloatArray) -> FloatArray:
        """(F,) probability that fruit at centers (F, 3) with radii (F,), scene units, have a colour that is asked for.

        It is above ½ if the colour with the largest share of a fruit is one of them.
        """
        if self.choice is None:
            return np.ones(len(centers))
        shares, asked = self._shares(self.choice, centers, radii), self.choice.asked
        difference = np.where(asked, 0.0, shares).max(axis=1) - np.where(asked, shares, 0.0).max(axis=1)
        chances: FloatArray = 1.0 / (1.0 + np.exp(difference / DOUBT))
        return chances

    def _shares(self, choice: ColourChoice, centers: FloatArray, radii: FloatArray) -> FloatArray:
        """(F, A) shares of the colours on each fruit."""
        shares = np.zeros((len(centers), len(choice.asked)))
        if self.maps is not None and choice.photos is not None:
            for picture, shown, (rows, colours) in zip(self.pictures, self.maps, choice.pixels(), strict=True):
                _add_pixels(shares, centers, radii, picture, shown, rows, colours, self.threshold)
        bare = np.flatnonzero(shares.sum(axis=1) == 0.0)
        means = self.gaussians.means.detach().double().cpu().numpy()
        _add_gaussians(shares, bare, centers, radii, means, self.weights, choice.gaussians)
        return shares / np.maximum(shares.sum(axis=1, keepdims=True), 1e-12)


def _add_pixels(
    shares: FloatArray,
    centers: FloatArray,
    radii: FloatArray,
    picture: Picture,
    shown: PhotoMap,
    rows: IntArray,
    colours: NDArray[np.float32],
    threshold: float,
) -> None:
    """Add the spots of each fruit's disc that show it in this photo to its colours (F, A)."""
    camera = picture.camera
    places, depths = camera.project(centers)
    height, width = shown.probability.shape
    scale = np.array([width / camera.width, height / camera.height])
    front = np.flatnonzero(depths > 0.0)
    sizes = (radii[front] / depths[front])[:, None] * np.diag(camera.K)[:2]
    beside = (places[front] + sizes < 0.0) | (places[front] - sizes >= [camera.width, camera.height])
    near, sizes = front[~beside.any(axis=1)], sizes[~beside.any(axis=1)]
    disc = INSIDE * spiral(SPOTS)
    spots = places[near][:, None] + disc * sizes[:, None]
    right, down = np.moveaxis(np.floor(spots * scale).astype(np.int64), -1, 0)
    framed = (right >= 0) & (right < width) & (down >= 0) & (down < height)
    right, down = np.where(framed, right, 0), np.where(framed, down, 0)
    own = np.abs(shown.offsets[down, right] - disc).max(axis=-1) < OFF
    own &= framed & (shown.probability[down, right] >= threshold)
    shares[near] += (colours[rows[down, right]] * own[..., None]).sum(axis=1)


def _add_gaussians(
    shares: FloatArray,
    index: IntArray,
    centers: FloatArray,
    radii: FloatArray,
    means: FloatArray,
    weights: FloatArray,
    colours: NDArray[np.float32],
) -> None:
    """Add the Gaussians on the surface of the fruit at `index` to their colours; the nearest if there are none."""
    used = np.flatnonzero(weights > 0.0)
    if len(index) == 0 or len(used) == 0:
        return
    tree = cKDTree(means[used])
    for each in index.tolist():
        center, radius = centers[each], radii[each]
        around = used[tree.query_ball_point(center, NEAR[1] * radius)]
        on = around[np.linalg.norm(means[around] - center, axis=1) >= NEAR[0] * radius]
        if len(on) == 0:
            on = used[[tree.query(center)[1]]]
        shares[each] += weights[on] @ colours[on]
