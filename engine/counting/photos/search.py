"""The search for fruit in the photos: places behind pixels that show fruit, moved and verified until all are explained.

Fruit that are certain are drawn into the crops of the others, so that what the photos show of a clump is explained by
one fruit after the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...progress import Progress, silent
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
"""Share of the places that are scored by all spots, the best by few: all of the sample's best 1,500 places by all spots
were among its best 1.4 % by few."""
PEAKS, PEAKS_OF_FRUIT = 1800, 18
"""How many places are verified, at least, and for each fruit that was found on surfaces."""
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
    places = likely_places(verifier.views, diameter, frame)
    on_surfaces = verifier.surroundings.fruit
    starts = np.concatenate([places[: max(PEAKS, PEAKS_OF_FRUIT * len(on_surfaces))], on_surfaces])
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


def likely_places(views: PhotoViews, diameter: float, frame: FloatArray) -> FloatArray:
    """(S, 3) places where photos may show fruit of a diameter: the FIRST of every cube, then the others, each the
    likeliest first. frame: as of `search_photos`."""
    places = views.places(diameter / 2.0, [push * diameter for push in PUSHES], STEP * diameter, frame)
    guesses = views.score(places, diameter / 2.0, FEW)
    places = places[guesses >= np.quantile(guesses, 1.0 - PROMISING)] if len(places) else places
    places = places[strongest(places, views.score(places, diameter / 2.0), PEAK * diameter, LEAST_SCORE)]
    later = _earlier(cubes(places, diameter, frame)) >= FIRST
    return places[np.argsort(later, kind="stable")]


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
