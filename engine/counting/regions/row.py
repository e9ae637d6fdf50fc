"""Trees: their positions, and which fruit belong to each."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

from ...config import CountConfig
from ...errors import ConfigError, CountingError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

STEEPEST = 0.995
"""Share of the distance between two trees along up: on no slope are trees so far above one another."""
NEIGHBOURS = 12
"""Nearest trees among which the neighbours of a tree are searched."""


@dataclass(frozen=True, eq=False)
class Row:
    """T trees in the order of their numbers, from 1. places: (T, 3) in the scene frame; numbers: (F,) the tree of each
    fruit, or NO_TREE."""

    places: FloatArray
    numbers: IntArray


def check_trees(config: CountConfig, up: FloatArray) -> None:
    """Refuse trees that are above one another along up (3,), because fruit are assigned to trees as seen from above.

    Raises:
        ConfigError: two of `config.tree_places` do.
    """
    places = np.array(config.tree_places or ()).reshape(-1, 3)
    for number in range(1, len(places)):
        between = places[:number] - places[number]
        above = np.abs(between @ up) >= STEEPEST * np.linalg.norm(up) * np.linalg.norm(between, axis=1)
        if above.any():
            raise ConfigError(
                f"--count.tree-places: trees {int(above.argmax()) + 1} and {number + 1} have the "
                "same position seen from above. Give the foot of every tree"
            )


def trees_of_row(centers: FloatArray, config: CountConfig, up: FloatArray, right: FloatArray) -> Row | None:
    """The tree of each of F fruit; None if no trees were requested, or if they must be estimated and there are no
    fruit.

    Given trees keep their order. Others are estimated along the direction in which the fruit spread most: a mixture of
    normal distributions of one width, started from k-means.

    Args:
        centers: (F, 3) of the fruit, scene units.
        up: (3,) unit, away from the ground; right: (3,) direction of the row from left to right in the first camera.

    Raises:
        CountingError: there are fewer fruit than trees to be found, or they hang in fewer places along the row.
    """
    level = centers - np.outer(centers @ up, up)
    if config.tree_places is not None:
        places = np.array(config.tree_places).reshape(-1, 3)
        return Row(places, nearest_tree(centers, places, up) + 1)
    if config.trees == 0 or len(centers) == 0:
        return None
    if len(centers) < config.trees:
        raise CountingError(
            f"--count.trees asks for {config.trees} trees and only {len(centers)} fruit were counted, too few to find "
            "them by. Say where the trees stand with --count.tree-places"
        )
    axis = _main_axis(level)
    along = level @ (axis if axis @ right >= 0.0 else -axis)
    stations = _find_stations(along, config.trees, config.seed) if config.trees > 1 else along.mean(keepdims=True)
    nearest = np.abs(along[:, None] - stations).argmin(axis=1)
    found = len(np.unique(nearest))
    if found < config.trees:
        raise CountingError(
            f"--count.trees asks for {config.trees} trees and the fruit hang about {found} places along the row only. "
            "Ask for fewer, or say where the trees stand with --count.tree-places"
        )
    places = np.array([centers[nearest == tree].mean(axis=0) for tree in range(config.trees)])
    return Row(places, nearest.astype(np.int64) + 1)


def nearest_tree(centers: FloatArray, places: FloatArray, up: FloatArray) -> IntArray:
    """(F,) index of the tree (T, 3) that each centre (F, 3) is nearest to as seen from above, -1 for none.

    A fruit belongs to none if it is farther away than the tree's nearest neighbour, or more than half a spacing beyond
    the last tree of a row: there it is nearer to the next one, which is not listed. A single tree gets every fruit.
    up: (3,) unit.
    """
    if len(places) == 0 or len(centers) == 0:
        return np.full(len(centers), -1, np.int64)
    if len(places) == 1:
        return np.zeros(len(centers), np.int64)
    feet, hang = (each - np.outer(each @ up, up) for each in (places, centers))
    spacing = cKDTree(feet).query(feet, k=2)[0][:, 1]
    distance, nearest = cKDTree(np.vstack([feet, _extend_rows(feet)])).query(hang)
    own = nearest < len(feet)
    own[own] = distance[own] <= spacing[nearest[own]]
    return np.where(own, nearest, -1).astype(np.int64)


def _extend_rows(feet: FloatArray) -> FloatArray:
    """Return where (G, 3) the rows of trees (T, 3) would go on: each tree's neighbours mirrored at it, where no tree
    stands.

    Neighbours have no other tree in the circle between them (Gabriel and Sokal 1969).
    """
    tree = cKDTree(feet)
    near = tree.query(feet, k=min(NEIGHBOURS + 1, len(feet)))[1][:, 1:]
    own, other = np.repeat(np.arange(len(feet)), near.shape[1]), near.ravel()
    apart = np.linalg.norm(feet[own] - feet[other], axis=1)
    clear = tree.query(0.5 * (feet[own] + feet[other]))[0] >= 0.499 * apart
    beyond = 2.0 * feet[own] - feet[other]
    free = tree.query(beyond)[0] >= 0.5 * apart
    return beyond[clear & free]


def _main_axis(places: FloatArray) -> FloatArray:
    """(3,) unit vector along which the places (N, 3) spread most."""
    return np.linalg.svd(places - places.mean(axis=0), full_matrices=False)[2][0]


def _find_stations(along: FloatArray, trees: int, seed: int) -> FloatArray:
    """Find the positions (T,) of the trees along the row, ascending, from the positions of their fruit (F,)."""
    unit = float(np.ptp(along)) or 1.0
    places = (np.sort(along)[:, None] - along.min()) / unit  # in order, so that shuffling changes nothing
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # warning for fruit at fewer positions than there are trees
        start = KMeans(trees, n_init=10, random_state=seed).fit(places).cluster_centers_
        mixture = GaussianMixture(trees, covariance_type="tied", means_init=start, random_state=seed).fit(places)
    return np.sort(mixture.means_[:, 0]) * unit + along.min()
