"""The colour of each fruit: that of the pixels that show it, or without photos of the Gaussians on it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...language.prompts.colour_choice import ColourChoice
from ...language.prompts.photo_probability import PhotoMap
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


def colour_chances(
    choice: ColourChoice,
    centers: FloatArray,
    radii: FloatArray,
    means: FloatArray,
    weights: FloatArray,
    pictures: Sequence[Picture],
    maps: Sequence[PhotoMap] | None,
    threshold: float,
) -> FloatArray:
    """(F,) probability that each fruit has a colour that is asked for; above ½ if the colour with its largest share is
    one of them.

    centers: (F, 3), radii: (F,) of the fruit, scene units; means: (N, 3) of the Gaussians; weights: (N,) how much each
    counts, 0 for those that are no fruit; pictures, maps: of the photos; threshold: probability from which a pixel
    shows fruit.
    """
    shares = np.zeros((len(centers), len(choice.asked)))
    if maps is not None and choice.photos is not None:
        for picture, shown, (rows, colours) in zip(pictures, maps, choice.pixels(), strict=True):
            _add_pixels(shares, centers, radii, picture, shown, rows, colours, threshold)
    bare = np.flatnonzero(shares.sum(axis=1) == 0.0)
    _add_gaussians(shares, bare, centers, radii, means, weights, choice.gaussians)
    shares /= np.maximum(shares.sum(axis=1, keepdims=True), 1e-12)
    asked = np.where(choice.asked, shares, 0.0).max(axis=1)
    others = np.where(choice.asked, 0.0, shares).max(axis=1)
    chances: FloatArray = 1.0 / (1.0 + np.exp((others - asked) / DOUBT))
    return chances


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
    front = depths > 0.0
    sizes = radii / np.where(front, depths, 1.0)
    disc = INSIDE * spiral(SPOTS)
    spots = places[:, None] + disc * (sizes[:, None] * np.diag(camera.K)[:2])[:, None]
    right, down = np.moveaxis(np.floor(np.where(front[:, None, None], spots, -1.0) * scale).astype(np.int64), -1, 0)
    framed = (right >= 0) & (right < width) & (down >= 0) & (down < height)
    right, down = np.where(framed, right, 0), np.where(framed, down, 0)
    own = np.abs(shown.offsets[down, right] - disc).max(axis=-1) < OFF
    own &= framed & (shown.probability[down, right] >= threshold)
    shares += (colours[rows[down, right]] * own[..., None]).sum(axis=1)


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
