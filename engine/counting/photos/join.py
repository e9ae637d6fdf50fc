"""Fruit that surfaces of Gaussians show and fruit that photos show, as candidates of one search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...language.prompts.photo_probability import PhotoMap
from ...progress import Progress, silent
from ...splatting.gaussians import Gaussians
from ..evidence.candidates import Candidates, support_shares
from ..evidence.claims import claim
from ..evidence.cluster import LIKELY, Search
from ..evidence.gate import features_of
from ..evidence.size import FruitSize
from ..evidence.visibility import Picture, frame_of, gather_view_evidence
from ..geometry.sphere import weigh_spheres
from .colours import doubt_unlike
from .search import FoundInPhotos, search_photos
from .surroundings import Surroundings
from .verifier import Verifier, load_networks
from .views import PhotoViews

FloatArray = NDArray[np.float64]

LEAST = 0.01
"""Probability below which a place is no candidate."""
HALF = 0.5
"""Fruit that are added to two expected numbers before they are compared, so that none may be 0."""
USUAL = 0.06
"""Logarithm of the fruit expected on surfaces over those expected with photos, up to which photos refuse no more than
usual: on twelve trees its mean is -.12 and its standard deviation .08, of which this is 2.3 above the mean."""


@dataclass(frozen=True, eq=False)
class PhotoEvidence:
    """What photos show of the prompt, and the Gaussians that they were trained into.

    probabilities: (N,) of the Gaussians; maps: what each photo shows, of any size.
    """

    gaussians: Gaussians
    probabilities: FloatArray
    maps: Sequence[PhotoMap]


def add_photos(
    found: Search,
    photos: PhotoEvidence,
    pictures: Sequence[Picture],
    threshold: float,
    *,
    progress: Progress = silent,
) -> Search:
    """Add to the search the fruit that photos show, its dissent, and the likely fruit that it had without them.

    found: on surfaces of the Gaussians; pictures: their views, one for each map; threshold: of the probabilities.
    """
    centers, diameter = found.found.spheres.centers, found.size.diameter
    likely = centers[found.probabilities > LIKELY]
    surroundings = Surroundings.of(photos.gaussians, photos.probabilities, likely, diameter, threshold)
    verifier = Verifier(load_networks(), PhotoViews.of(pictures, photos.maps), surroundings)
    cameras = [picture.camera for picture in pictures]
    in_photos = search_photos(verifier, diameter, frame_of(cameras), progress=progress)
    together = doubt_unlike(join_places(found, in_photos, pictures, threshold), photos.gaussians)
    refused = measure_dissent(float(found.probabilities.sum()), float(together.probabilities.sum()))
    return replace(together, dissent=refused, on_surfaces=likely)


def measure_dissent(on_surfaces: float, in_photos: float) -> float:
    """Logarithm by which photos refuse more fruit than usual, from the numbers of fruit expected without and with
    them."""
    return max(float(np.log((on_surfaces + HALF) / (in_photos + HALF))) - USUAL, 0.0)


def join_places(found: Search, photos: FoundInPhotos, pictures: Sequence[Picture], threshold: float) -> Search:
    """Make the places of the photos candidates, with the points of the surfaces that lie on them."""
    probabilities = 1.0 / (1.0 + np.exp(-photos.log_odds))
    order = np.argsort(-probabilities, kind="stable")
    order = order[probabilities[order] >= LEAST]
    places, probabilities = photos.places.select(order), probabilities[order]
    centers, radii = places.centers, places.radii
    found = replace(found, size=FruitSize(photos.diameter, found.size.spread))
    radius_sds = radii * photos.radius_sds[order]
    surface = found.surface
    spheres = weigh_spheres(surface.cells, surface.normals, centers, radii, radius_sds)
    claims = claim(surface.cells, surface.normals, centers, radii)
    owners, free = np.full(len(surface.points), -1, np.int64), np.ones(len(centers))
    nobody = owners.copy()
    for index in range(len(centers)):
        own, left = claims.value(index, nobody)[0], claims.value(index, owners)[0]
        free[index] = left / own if own > 0.0 else 1.0
        claims.take(index, index, owners)
    evidence = gather_view_evidence(pictures, centers, radii, threshold)
    candidates = Candidates(spheres, evidence, support_shares(spheres), free, owners)
    features = features_of(candidates, surface, found.size, threshold)
    return replace(found, found=candidates, features=features, probabilities=probabilities, photos=True)
