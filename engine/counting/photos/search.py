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
from ..geometry.cells import keep_apart
from .places import NO_PLACES, Places, find_clear, keep_strongest
from .verifier import VIEWS, Verdicts, Verifier
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
"""Usual diameters within which moved places are one, and mean diameters that new fruit keep from each other."""
KEPT_APART = 0.65
"""Mean diameters that known fruit keep from each other and new ones from known ones. Pairs that are nearer are mostly
one fruit: with .55 for new ones, mean F1 of 8 scenes (seed 101) was .908 instead of .912, and no scene was better."""
ROUNDS, MOVES, STEADY = 2, 2, 0.7
"""Rounds of the search, moves in each, and the share of a move that a known fruit makes."""
VARIED, SMALLER = 0.14, 0.6
"""Spread of radii from which places of small fruit are searched too, and their size in usual ones: what is found with
the usual size is too far from a small fruit. Of apples whose sizes vary by a third, F1 was .831 without, .892 with
them; where sizes are alike they add false fruit only."""
RESIZED, SAME_SIZE, FEWEST = 3, 0.08, 5
"""Searches for places with the size that the last one found, the change of its logarithm that ends them, and the fruit
that tell a size."""
LEAST_SPREAD = 0.12
"""Deviation of the logarithm of radii that is assumed between fruit, at least."""
MEASURES, TELLING, FARTHEST_SIZE = 2, 40.0, 0.8
"""Measurements of a radius, each around the last one; pixels that tell it as well as the size of the others does; and
the logarithm of the largest ratio to that."""


@dataclass(frozen=True, eq=False)
class FoundInPhotos:
    """C places where fruit may be, with their radii, and the log odds (C,) that they are; the first `known` of them
    were drawn into the crops of the others. radius_sds: (C,) standard deviations of the logarithms of the radii;
    diameter: the usual one of the fruit, scene units."""

    places: Places
    log_odds: FloatArray
    known: int
    radius_sds: FloatArray
    diameter: float


@dataclass(frozen=True, eq=False)
class _Verified:
    """C places with what the verifier says of them."""

    places: Places
    verdicts: Verdicts

    @classmethod
    def of(cls, verifier: Verifier, places: Places, known: Places) -> _Verified:
        """Places that are none of the known fruit."""
        return cls(places, verifier.verify(places, known))

    @classmethod
    def of_known(cls, verifier: Verifier, known: Places) -> _Verified:
        """Known fruit, each with the others around it."""
        return cls(known, verifier.verify(known, known, np.arange(len(known))))

    @property
    def odds(self) -> FloatArray:
        """(C,) log odds."""
        return self.verdicts.log_odds

    def select(self, index: NDArray) -> _Verified:
        """The places at `index` (bool mask (C,) or integer indices)."""
        return _Verified(self.places.select(index), self.verdicts.select(index))

    def keep_above(self, least: float) -> _Verified:
        """Keep the places with higher log odds than `least`."""
        return self.select(self.odds > least)

    def move(self, share: float = 1.0) -> Places:
        """Return the places after this share of their moves and of the growth of their radii."""
        said = self.verdicts
        return Places(self.places.centers + share * said.moves, self.places.radii * np.exp(share * said.growths))

    def keep_apart(self) -> Places:
        """Keep the likeliest places, KEPT_APART from each other."""
        return self.places.select(keep_strongest(self.places, self.odds, KEPT_APART))


def search_photos(
    verifier: Verifier, diameter: float, frame: FloatArray, *, progress: Progress = silent
) -> FoundInPhotos:
    """Look for fruit. diameter: about that of the fruit, scene units; frame: (3, 4) of the cameras, see
    `visibility.frame_of`."""
    pool, diameter = _find_first_places(verifier, diameter, frame)
    verifier = verifier.with_size(diameter, spread_of(pool.keep_above(LIKELY).places.radii, diameter / 2.0))
    progress(0.3, "Looking for fruit in the photos")
    known = _follow(verifier, pool, NO_PLACES, diameter).keep_above(LIKELY).keep_apart()
    fresh = pool.select(np.zeros(0, np.int64))
    for number in range(ROUNDS):
        progress(0.3 + 0.7 * number / ROUNDS, f"Looking for fruit in the photos, round {number + 1} of {ROUNDS}")
        known = _settle(verifier, Places.join([known, fresh.keep_above(LIKELY).places]))
        fresh = _find_beyond(verifier, pool.places, known, diameter)
    places = Places.join([known, fresh.places])
    said = Verdicts.join([_Verified.of_known(verifier, known).verdicts, fresh.verdicts])
    usual = _usual(known.radii, diameter)
    held = Places(places.centers, shrink_to_usual(places.radii, said.radius_sds, known.radii, usual / 2.0))
    return FoundInPhotos(held, said.log_odds, len(known), said.radius_sds, usual)


def shrink_to_usual(radii: FloatArray, sds: FloatArray, known: FloatArray, usual: float) -> FloatArray:
    """Move the logarithms of radii (C,), which have standard deviations (C,), towards the usual one by the share of
    their variance that is an error of measurement: the spread of the known fruit (F,) says how much they truly vary."""
    shares = 1.0 / (1.0 + (sds / spread_of(known, usual)) ** 2)
    held: FloatArray = usual * (radii / usual) ** shares
    return held


def spread_of(known: FloatArray, usual: float) -> float:
    """Standard deviation of the logarithm of the radii (F,) of known fruit around the usual one, robust against a few
    that are wrong; LEAST_SPREAD if they are few, or alike."""
    if len(known) < FEWEST:
        return LEAST_SPREAD
    return max(float(1.48 * np.median(np.abs(np.log(known / usual)))), LEAST_SPREAD)


def _find_first_places(verifier: Verifier, diameter: float, frame: FloatArray) -> tuple[_Verified, float]:
    """Find places that are not given up, and the diameter of the likely ones: places are searched again with it if it
    differs, and then with a smaller one too if their sizes vary."""
    for _ in range(RESIZED):
        starts = _find_starts(verifier, diameter, frame)
        pool = _Verified.of(verifier.with_size(diameter), starts, NO_PLACES)
        before, likely = diameter, pool.keep_above(LIKELY).places.radii
        diameter = _usual(likely, before)
        if abs(np.log(diameter / before)) < SAME_SIZE:
            break
    if spread_of(likely, diameter / 2.0) > VARIED:
        starts = Places.join([starts, _find_starts(verifier, SMALLER * diameter, frame)])
        pool = _Verified.of(verifier.with_size(diameter), starts, NO_PLACES)
        diameter = _usual(pool.keep_above(LIKELY).places.radii, diameter)
    return pool.keep_above(GIVEN_UP), diameter


def _find_starts(verifier: Verifier, diameter: float, frame: FloatArray) -> Places:
    """Find places of fruit of a diameter, each with the radius that is measured there."""
    on_surfaces = verifier.surroundings.fruit
    centers = np.concatenate([find_likely_places(verifier.views, on_surfaces, diameter, frame), on_surfaces])
    return size_places(verifier.views, Places.alike(centers, diameter), diameter)


def _usual(radii: FloatArray, diameter: float) -> float:
    """Twice the median of radii (F,); `diameter` if they are too few."""
    return 2.0 * float(np.median(radii)) if len(radii) >= FEWEST else diameter


def _follow(verifier: Verifier, found: _Verified, known: Places, diameter: float) -> _Verified:
    """Places after all their moves, clear of stronger ones and of known fruit."""
    for _ in range(MOVES):
        places = found.move()
        places = places.select(non_maximum_suppression(places.centers, found.odds, SAME * diameter))
        places = places.select(find_clear(places, known, KEPT_APART))
        found = _Verified.of(verifier, places, known)
    return found


def size_places(views: PhotoViews, places: Places, diameter: float) -> Places:
    """Give the places the radii that the photos show; the fewer pixels tell one, the nearer it stays to that of the
    scene, half of `diameter`."""
    usual = diameter / 2.0
    for _ in range(MEASURES):
        radii, shares = _measure_radii(views, places)
        off = np.clip(np.log(np.where(shares > 0.0, radii, usual) / usual), -FARTHEST_SIZE, FARTHEST_SIZE)
        places = Places(places.centers, usual * np.exp(shares * off))
    return places


def _measure_radii(views: PhotoViews, places: Places) -> tuple[FloatArray, FloatArray]:
    """Measure the radii (C,) that pixels around places tell, and the share (C,) of each in `size_places`."""
    chosen, _ = views.choose(places.centers, places.radii, VIEWS)
    radii, pixels = views.measured(places.centers, places.radii, chosen)
    return radii, pixels / (pixels + TELLING)


def find_likely_places(views: PhotoViews, fruit: FloatArray, diameter: float, frame: FloatArray) -> FloatArray:
    """Find the places (S, 3) where photos may show fruit of a diameter: of each group the best, first the FIRST of
    every cube, each the likeliest first. fruit: (F, 3) on surfaces; frame: as of `search_photos`.

    Places compete in the group of the nearest fruit, so well-covered trees take nothing from others.
    """
    groups = group_fruit(views, fruit, diameter)
    most = np.maximum(PEAKS, PEAKS_OF_FRUIT * np.bincount(groups, minlength=1))
    places = views.places(diameter / 2.0, [push * diameter for push in PUSHES], STEP * diameter, frame)
    own = _find_nearest_group(places, fruit, groups)
    places = places[_find_best(views.score(places, diameter / 2.0, FEW), own)]
    places = places[non_maximum_suppression(places, views.score(places, diameter / 2.0), PEAK * diameter, LEAST_SCORE)]
    later = _count_earlier(cubes(places, diameter, frame)) >= FIRST
    places = places[np.argsort(later, kind="stable")]
    own = _find_nearest_group(places, fruit, groups)
    return places[_count_earlier(own) < most[own]]


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


def _find_nearest_group(places: FloatArray, fruit: FloatArray, groups: IntArray) -> IntArray:
    """Find the group (S,) of the fruit (F, 3) nearest to each place (S, 3)."""
    if groups.max(initial=0) == 0 or len(places) == 0:
        return np.zeros(len(places), np.int64)
    own: IntArray = groups[cKDTree(fruit).query(places)[1]]
    return own


def _find_best(guesses: FloatArray, groups: IntArray) -> NDArray[np.bool_]:
    """Find which guesses (S,) are among the best of their group (S,)."""
    least = [
        np.quantile(guesses[groups == group], 1.0 - PROMISING) if (groups == group).any() else np.inf
        for group in range(groups.max(initial=-1) + 1)
    ]
    return guesses >= np.array(least)[groups]


def _count_earlier(owners: IntArray) -> IntArray:
    """Count how many before each (S,) have the same owner."""
    order = np.argsort(owners, kind="stable")
    starts = np.searchsorted(owners[order], owners[order])
    earlier = np.empty(len(owners), np.int64)
    earlier[order] = np.arange(len(owners)) - starts
    return earlier


def _settle(verifier: Verifier, known: Places) -> Places:
    """Move known fruit to where the others leave them; those that are unlikely then are left out."""
    for _ in range(MOVES):
        known = _Verified.of_known(verifier, known).move(STEADY)
    return _Verified.of_known(verifier, known).keep_above(LIKELY - 1.0).keep_apart()


def _find_beyond(verifier: Verifier, pool: Places, known: Places, diameter: float) -> _Verified:
    """Find the places of the pool, moved, that may be fruit besides the known ones."""
    fresh = _Verified.of(verifier, pool.select(find_clear(pool, known, KEPT_APART)), known).keep_above(UNLIKELY)
    found = _follow(verifier, fresh, known, diameter)
    return found.select(keep_strongest(found.places, found.odds, APART))


def non_maximum_suppression(
    places: FloatArray, strengths: FloatArray, reach: float, least: float = -np.inf
) -> IntArray:
    """Choose which places (S, 3) to keep, strongest first, so that none lies within `reach` of a stronger one."""
    order = np.argsort(-strengths, kind="stable")
    return keep_apart(places, order[strengths[order] > least], reach)
