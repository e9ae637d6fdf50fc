"""The search for fruit in the photos: places behind pixels that show fruit, moved and verified until all are explained.

Fruit that are certain are drawn into the crops of the others, so that what the photos show of a clump is explained by
one fruit after the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...progress import Progress, silent
from ..evidence.camera_parts import split_by_cameras
from ..geometry.cells import separated
from .verifier import Verifier
from .views import FEW, PhotoViews, cubes

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

PUSHES, STEP = (-1.0, -0.5, 0.0, 0.5, 1.0, 2.0), 0.25
"""Diameters behind the place of a pixel's fruit at which it is also searched, and the distance between such places."""
PEAK, LEAST_SCORE = 0.25, 0.15
"""Diameters between the best places, and the least score of one."""
PROMISING = 0.15
"""Share of the places of a group that are scored by all spots, the best by few: all of the sample's best 1,500 places
by all spots were among its best 1.4 % by few."""
PEAKS, PEAKS_OF_FRUIT = 1800, 18
"""How many places of a group are verified, at least, and for each fruit that was found on surfaces."""
COVERAGE_RATIO, LEAST_GROUP = 2.0, 0.2
"""Places around two fruit do not compete if one is framed by more than this many times as many photos: scores grow with
the number of photos. The least share of a part's fruit in a group: a few fruit behind a tree are none. Of the 122 fruit
of the sample in 10 photos, 109 had a verified place; next to one tree with 60 photos 104, next to five 99."""
FIRST = 5
"""Places in a cube of a diameter that come before other places: a fruit that few photos show has lower scores than
many places around one that all photos show."""
GIVEN_UP, UNLIKELY, LIKELY = -2.5, -3.0, 1.0
"""Log odds below which a place is given up at once, below which it is after fruit are known, and from which a fruit is
known to the others."""
SAME, APART = 0.25, 0.7
"""Diameters within which moved places are one, and that new fruit keep from each other."""
KEPT_APART = 0.65
"""Diameters that known fruit keep from each other and new ones from known ones. Pairs that are nearer are mostly one
fruit: with .55 for new ones, mean F1 of 8 scenes (seed 101) was .908 instead of .912, and no scene was better."""
ROUNDS, MOVES, STEADY = 2, 2, 0.7
"""Rounds of the search, moves in each, and the share of a move that a known fruit makes."""
NO_PLACES = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class FoundInPhotos:
    """C places where fruit may be, centers (C, 3), and the log odds (C,) that they are; the first `known` of them were
    drawn into the crops of the others."""

    centers: FloatArray
    log_odds: FloatArray
    known: int


def search_photos(
    verifier: Verifier, diameter: float, frame: FloatArray, *, progress: Progress = silent
) -> FoundInPhotos:
    """Look for fruit of a diameter, scene units. frame: (3, 4) of the cameras, see `visibility.frame_of`."""
    radius = diameter / 2.0
    on_surfaces = verifier.surroundings.fruit
    starts = np.concatenate([likely_places(verifier.views, on_surfaces, diameter, frame), on_surfaces])
    odds, moves = verifier.verify(starts, radius, NO_PLACES)
    pool, moves, odds = (each[odds > GIVEN_UP] for each in (starts, moves, odds))
    progress(0.3, "Looking for fruit in the photos")
    centers = pool
    for _ in range(MOVES):
        centers = centers + moves
        centers = centers[strongest(centers, odds, SAME * diameter)]
        odds, moves = verifier.verify(centers, radius, NO_PLACES)
    certain = np.flatnonzero(odds > LIKELY)
    known = centers[certain][strongest(centers[certain], odds[certain], KEPT_APART * diameter)]
    fresh, fresh_odds = NO_PLACES, np.zeros(0)
    for number in range(ROUNDS):
        progress(0.3 + 0.7 * number / ROUNDS, f"Looking for fruit in the photos, round {number + 1} of {ROUNDS}")
        known = _settled(verifier, np.concatenate([known, fresh[fresh_odds > LIKELY]]), diameter)
        fresh, fresh_odds = _beyond(verifier, pool, known, diameter)
    known_odds, _ = verifier.verify(known, radius, known, np.arange(len(known)))
    return FoundInPhotos(np.concatenate([known, fresh]), np.concatenate([known_odds, fresh_odds]), len(known))


def likely_places(views: PhotoViews, fruit: FloatArray, diameter: float, frame: FloatArray) -> FloatArray:
    """(S, 3) places where photos may show fruit of a diameter: of each group the best, first the FIRST of every cube,
    each the likeliest first. fruit: (F, 3) on surfaces; frame: as of `search_photos`.

    Places compete in the group of the nearest fruit, so well-covered trees take nothing from others.
    """
    groups = group_fruit(views, fruit, diameter)
    most = np.maximum(PEAKS, PEAKS_OF_FRUIT * np.bincount(groups, minlength=1))
    places = views.places(diameter / 2.0, [push * diameter for push in PUSHES], STEP * diameter, frame)
    own = _nearest(places, fruit, groups)
    places = places[_best(views.score(places, diameter / 2.0, FEW), own)]
    places = places[strongest(places, views.score(places, diameter / 2.0), PEAK * diameter, LEAST_SCORE)]
    later = _earlier(cubes(places, diameter, frame)) >= FIRST
    places = places[np.argsort(later, kind="stable")]
    own = _nearest(places, fruit, groups)
    return places[_earlier(own) < most[own]]


def group_fruit(views: PhotoViews, fruit: FloatArray, diameter: float) -> IntArray:
    """(F,) the group of each fruit (F, 3): parts of the scene that are as large as a tree, each divided where some
    fruit are framed by less than half as many photos as others. One group if all are photographed alike."""
    groups, number = np.zeros(len(fruit), np.int64), 0
    if len(fruit) == 0:
        return groups
    framed = views.choose(fruit, np.full(len(fruit), diameter / 2.0), 1)[1][:, 4]
    for part in split_by_cameras(fruit, views.eyes):
        order = part.fruit[np.argsort(-framed[part.fruit], kind="stable")]
        start, least = 0, max(math.ceil(LEAST_GROUP * len(order)), 1)
        for place in range(least, len(order) - least + 1):
            if place - start >= least and COVERAGE_RATIO * framed[order[place]] < framed[order[start]]:
                groups[order[start:place]], start, number = number, place, number + 1
        groups[order[start:]], number = number, number + 1
    return groups


def _nearest(places: FloatArray, fruit: FloatArray, groups: IntArray) -> IntArray:
    """(S,) the group of the fruit (F, 3) nearest to each place (S, 3)."""
    if groups.max(initial=0) == 0 or len(places) == 0:
        return np.zeros(len(places), np.int64)
    own: IntArray = groups[cKDTree(fruit).query(places)[1]]
    return own


def _best(guesses: FloatArray, groups: IntArray) -> NDArray[np.bool_]:
    """(S,) which guesses (S,) are among the best of their group (S,)."""
    least = [
        np.quantile(guesses[groups == group], 1.0 - PROMISING) if (groups == group).any() else np.inf
        for group in range(groups.max(initial=-1) + 1)
    ]
    return guesses >= np.array(least)[groups]


def _earlier(owners: IntArray) -> IntArray:
    """(S,) how many before each have the same owner."""
    order = np.argsort(owners, kind="stable")
    starts = np.searchsorted(owners[order], owners[order])
    earlier = np.empty(len(owners), np.int64)
    earlier[order] = np.arange(len(owners)) - starts
    return earlier


def _settled(verifier: Verifier, known: FloatArray, diameter: float) -> FloatArray:
    """Known fruit (F, 3), moved to where the others leave them; those that are unlikely then are left out."""
    for _ in range(MOVES):
        _, moves = verifier.verify(known, diameter / 2.0, known, np.arange(len(known)))
        known = known + STEADY * moves
    odds, _ = verifier.verify(known, diameter / 2.0, known, np.arange(len(known)))
    kept = np.flatnonzero(odds > LIKELY - 1.0)
    return known[kept][strongest(known[kept], odds[kept], KEPT_APART * diameter)]


def _beyond(verifier: Verifier, pool: FloatArray, known: FloatArray, diameter: float) -> tuple[FloatArray, FloatArray]:
    """The places of the pool (S, 3), moved, that may be fruit besides the known ones (F, 3), and their log odds."""
    centers = pool[_distances(pool, known) > KEPT_APART * diameter]
    odds, moves = verifier.verify(centers, diameter / 2.0, known)
    centers, odds, moves = (each[odds > UNLIKELY] for each in (centers, odds, moves))
    for _ in range(MOVES):
        centers = centers + moves
        centers = centers[strongest(centers, odds, SAME * diameter)]
        centers = centers[_distances(centers, known) > KEPT_APART * diameter]
        odds, moves = verifier.verify(centers, diameter / 2.0, known)
    best = strongest(centers, odds, APART * diameter)
    return centers[best], odds[best]


def _distances(places: FloatArray, others: FloatArray) -> FloatArray:
    """(S,) distance of each place to the nearest of the others; infinite without any."""
    if len(others) == 0 or len(places) == 0:
        return np.full(len(places), np.inf)
    distances: FloatArray = cKDTree(others).query(places)[0]
    return distances


def strongest(places: FloatArray, strengths: FloatArray, reach: float, least: float = -np.inf) -> IntArray:
    """Which places (S, 3) to keep, strongest first, so that none lies within `reach` of a stronger one."""
    order = np.argsort(-strengths, kind="stable")
    return separated(places, order[strengths[order] > least], reach)
