"""Gaussians with probabilities → counted fruit, each with its size, and an account of every cluster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..config import CountConfig
from ..errors import CountingError
from ..language.prompts.colour_choice import ColourChoice
from ..language.prompts.photo_probability import PhotoMap
from ..progress import Progress, part, silent
from ..scene.camera import Camera
from ..splatting.gaussians import PARAMETERS, Gaussians
from ..splatting.subject.viewpoints import find_subject
from .accounts.audit import account_for
from .accounts.describe import describe, place_fruit, point_colors
from .accounts.ids import NO_FRUIT, KnownFruit, number
from .accounts.interval import Estimate, estimate, evidence_of
from .accounts.zero import UNKNOWN, Matching, Quality
from .evidence.cluster import Clusters, Search, find_fruit, search
from .evidence.fruit_colours import colour_chances
from .evidence.picture_size import size_from_pictures
from .evidence.pixel_width import pixel_widths
from .evidence.size import LEAST_EVIDENCE, FruitSize, estimate_diameter
from .evidence.surface_points import LARGEST_SCALE, SURFACE, SurfacePoints, sample_enough, sample_surface, sample_volume
from .evidence.visibility import Picture, Visibility, draw, find_visibility, gather_view_evidence
from .fruit import NO_TREE, AuditEntry, FruitCount
from .geometry.sphere import Spheres
from .photos.join import PhotoEvidence, with_photos
from .published.fruitnerf import cluster_as_fruitnerf
from .published.template import split_by_template
from .published.template_shape import read_template
from .regions.ground import lying_on_ground
from .regions.region import REACH, Region, keep_inside, region_of, spaced
from .regions.row import check_trees, trees_of_row

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LEAST_OPACITY = 0.05
FAINT = 1.0 / 3.0
"""Share of the threshold above which a Gaussian may belong to a fruit whose other Gaussians are above the threshold."""
SIZING_POINTS, SIZING_SHARE = 20_000, 0.5
"""Points for the size estimate, or this many per Gaussian if that is more: ten per fruit are too few."""
VOLUME_POINTS = 60_000
"""Number of points of the paper's sampling."""
ROUNDING = 1e-5
"""Tolerance of a probability outside 0…1: rounding of sums in float32."""
DEFAULT_SPREAD = 0.2
"""Standard deviation of log diameter between fruit if the diameter is given."""
NO_SHAPE = "no candidate among the matching Gaussians has the shape of a fruit"
"""Reason of a 0 for which the audit lists the candidates."""
FACELESS = "has a side that faces the cameras and is not inside another"
"""Text for Gaussians that give no surface points: seen equally from opposite sides, they have no outer side."""
UNLIKE = 1.6
"""Ratio of the given diameter to that of the scene above which the user is notified."""
FIRST_SPREADS = (0.15, 0.35)
"""Least and largest standard deviation of log diameter to start from."""


def count_fruit(
    gaussians: Gaussians,
    probability: NDArray | torch.Tensor,
    cameras: Sequence[Camera],
    config: CountConfig,
    *,
    label: str,
    up: FloatArray | None = None,
    visibility: Visibility | None = None,
    known: KnownFruit = NO_FRUIT,
    quality: Quality = UNKNOWN,
    photos: Sequence[PhotoMap] | None = None,
    choice: ColourChoice | None = None,
    progress: Progress = silent,
) -> FruitCount:
    """Count the fruit formed by the Gaussians with a probability (N,) near or above `config.threshold`.

    If a part of a fruit is about as probable as the threshold, its fainter Gaussians count as well. With a region, size
    and fruit come from its inside; a fruit that its border cuts is fitted whole. A prompt that no Gaussian matches is a
    count of 0 with one audit entry that gives the highest probability. If Gaussians match, but none has the size or
    shape of a fruit, the count is 0 with an interval that admits what may be there, unless the cause is known.

    up: (3,) away from the ground; estimated from the cameras if not given. visibility: of the Gaussians in the cameras,
    if known; rendered otherwise. known: fruit that an earlier count of the scene numbered, whose ids stay; new fruit
    are numbered from top to bottom, from 1 or after the last id. quality: of the Gaussians, which may be the cause of a
    0. photos: what each camera's photo shows of the prompt; fruit that Gaussians leave out are found in them. choice:
    the colours of which fruit are counted, if not all; probability and photos are of the fruit of any colour then.

    Raises:
        ConfigError: the region is invalid, two trees stand above one another, or the file that `config.template`
            names is missing.
        FormatError: that file holds no template.
        CountingError: a shape does not fit, a value is not finite, a probability is invalid, `up` is not a direction,
            there are no Gaussians or no cameras, all Gaussians lie at one position, none lies in the region, there are
            fewer fruit, or places with fruit, than trees, the diameter is larger than all that may be fruit, or no
            fruit is found because the reconstruction is poor or the diameter is not that of the scene.
    """
    probabilities = _checked(gaussians, probability, cameras)
    up = _mean_top(cameras) if up is None else _checked_up(up)
    region = region_of(config, up)
    check_trees(config, up)
    inside = _inside(region, gaussians)
    highest = float(probabilities[inside].max())
    chosen = np.flatnonzero(inside & (probabilities >= config.threshold))
    matching = Matching.of(gaussians, probabilities, chosen, cameras, label, quality)

    def nothing(reason: str, diameter: float | None = None, *, points: int = 0, visible: bool = True) -> FruitCount:
        matching.require_answer(reason, diameter)
        none = _none(highest, known, reason, points, diameter)
        return _on_trees(matching.with_bounds(none, diameter, visible=visible), [], config, up, cameras)

    selected = select_gaussians(gaussians, probabilities, config)
    if highest < config.threshold:
        return nothing(f"no Gaussian reaches {config.threshold:.2f}: the highest probability is {highest:.3f}")
    if not inside[selected].any():
        return nothing(
            f"all {len(matching)} Gaussians of {label} are transparent: their opacities are below {LEAST_OPACITY}"
        )
    progress(0.0, "Rendering the Gaussians in each view")
    if visibility is None:
        visibility = find_visibility(gaussians, cameras, progress=part(progress, 0.0, 0.3))
    seen = selected[visibility.weights[selected] > 0]
    own = seen[inside[seen]]
    if len(own) == 0:
        return nothing(f"no view shows any of the {inside[selected].sum()} Gaussians of {label}", visible=False)
    notices = _check_diameter(gaussians, probabilities, visibility, own, config, part(progress, 0.3, 0.4))
    size = fruit_size(gaussians, probabilities, visibility, own, config, part(progress, 0.4, 0.5))
    pictures = draw(gaussians, probabilities, cameras, progress=part(progress, 0.5, 0.7))
    sized = size or size_from_pictures(pictures, config.threshold, region.contains)
    if sized is None or (size is None and matching.sharp(sized.diameter)):
        return nothing(_why_no_size(gaussians, probabilities, visibility, own, config, label), points=len(own))
    if size is None:
        notices = [
            f"no surface of {label} is round, so the size of the fruit was estimated from the widths of its regions in "
            "the rendered views. Check the sizes and the count"
        ]
    points = _sampled(gaussians, probabilities, visibility, seen, sized.diameter, config)
    points = points.select(region.contains(points.positions, REACH * sized.diameter))
    if len(points) == 0:
        reason = _why_no_points(gaussians, own, sized.diameter, label)
        _require_fine(gaussians, own, sized.diameter, config, reason, label)
        none = nothing(reason, sized.diameter, points=len(own))
        return replace(none, notices=[*notices, *none.notices])
    evidence = None if photos is None else PhotoEvidence(gaussians, probabilities, photos)
    found, searched = _find(points, sized, pictures, evidence, config, part(progress, 0.7, 1.0))
    within = keep_inside(found, region)
    colours = _Chosen(choice, gaussians, probabilities, visibility, pictures, photos, config)
    clusters = colours.keep(within)
    spheres = clusters.spheres
    mean = float(2.0 * spheres.radii.mean()) if len(spheres) else None
    numbers = number(spheres.centers, _top_to_bottom(spheres.centers, cameras), mean or 0.0, known)
    account = account_for(clusters, numbers, beyond=len(found.spheres) - len(within.spheres))
    view_evidence = gather_view_evidence(pictures, spheres.centers, spheres.radii, config.threshold)
    counted = FruitCount(
        fruits=describe(gaussians, seen, clusters, numbers, account.compound, view_evidence, label),
        audit=account.entries,
        max_probability=highest,
        mean_diameter=mean,
        last_id=max(known.last, int(numbers.max(initial=0))),
        points=clusters.points.positions,
        point_colors=np.round(point_colors(gaussians, clusters)).astype(np.uint8),
        point_fruit_ids=np.append(numbers, -1)[clusters.owners],
        notices=notices,
        pixel_width=_pixel_width(spheres, cameras, pictures),
    )
    others = gaussians.select(torch.from_numpy(np.flatnonzero(probabilities < config.threshold)))
    lying = lying_on_ground(others, cameras, counted.centers, counted.diameters, up)
    placed = _on_trees(counted, lying, config, up, cameras)
    if searched is not None:
        candidates = searched.found.spheres
        counts = region.contains(candidates.centers) * colours.chances(candidates)
        placed = _with_intervals(placed, searched, counts, pictures, config.seed)
    if len(spheres):
        return placed
    if len(within.spheres):
        matching.require_answer(colours.refusal)
        return placed
    if len(found.spheres):
        matching.require_answer("all fruit that were found lie outside the region")
        return placed
    if config.diameter is not None and notices:
        raise CountingError(f"The 0 for {label} is not a count: {notices[0]}")
    matching.require_answer(NO_SHAPE, sized.diameter)
    estimated = searched is not None and len(searched.found.spheres) > 0 and size is not None
    return placed if estimated else matching.with_bounds(placed, sized.diameter)


@dataclass(frozen=True, eq=False)
class _Chosen:
    """Which fruit have a colour that is asked for: all without a choice."""

    choice: ColourChoice | None
    gaussians: Gaussians
    probabilities: FloatArray
    visibility: Visibility
    pictures: Sequence[Picture]
    maps: Sequence[PhotoMap] | None
    config: CountConfig

    @property
    def refusal(self) -> str:
        """Why a fruit of another colour is not counted."""
        assert self.choice is not None
        asked = [word for word, wanted in zip(self.choice.split.words, self.choice.split.asked, strict=True) if wanted]
        return f"its fruit are not {' or '.join(asked)}"

    def chances(self, spheres: Spheres) -> FloatArray:
        """(F,) probability that each sphere has one of the colours."""
        if self.choice is None:
            return np.ones(len(spheres))
        means = self.gaussians.means.detach().double().cpu().numpy()
        weights = np.where(self.probabilities >= FAINT * self.config.threshold, self.visibility.weights, 0.0)
        threshold = self.config.threshold
        return colour_chances(
            self.choice, spheres.centers, spheres.radii, means, weights, self.pictures, self.maps, threshold
        )

    def keep(self, clusters: Clusters) -> Clusters:
        """The clusters without fruit of other colours."""
        if self.choice is None:
            return clusters
        return clusters.keeping(self.chances(clusters.spheres) > 0.5, np.ones(len(clusters.points), bool), self.refusal)


def _pixel_width(spheres: Spheres, cameras: Sequence[Camera], pictures: Sequence[Picture]) -> float | None:
    """The median width of the fruit in pixels of the photos as they were read; None if no view frames one."""
    widths = pixel_widths(spheres.centers, 2.0 * spheres.radii, cameras, pictures)
    known = widths[np.isfinite(widths)]
    return float(np.median(known)) if len(known) else None


def _on_trees(
    counted: FruitCount, lying: Sequence[bool | None], config: CountConfig, up: FloatArray, cameras: Sequence[Camera]
) -> FruitCount:
    """The count with the position of each fruit, and an audit entry for trees that no fruit belongs to."""
    row = trees_of_row(counted.centers, config, up, cameras[0].world_to_camera[0, :3])
    placed = place_fruit(counted, lying, row)
    if config.trees == 0 or row is not None:
        return placed
    reason = f"no tree of the {config.trees} that --count.trees asks for is found: trees are found by their fruit"
    last = max((entry.cluster for entry in counted.audit), default=-1)
    entry = AuditEntry(cluster=last + 1, verdict="dropped", reason=reason, center=(0.0, 0.0, 0.0), points=0)
    return replace(placed, audit=[*placed.audit, entry])


def _with_intervals(
    counted: FruitCount, searched: Search, counts: FloatArray, pictures: Sequence[Picture], seed: int
) -> FruitCount:
    """The count and its trees with intervals; a candidate belongs to the tree of its nearest fruit.

    counts: (C,) probability that a candidate counts if it is a fruit. Without fruit, trees have no interval.
    """
    centers = searched.found.spheres.centers
    numbers = np.array([NO_TREE if fruit.tree is None else fruit.tree for fruit in counted.fruits])
    known = counted.trees and counted.fruits
    own = numbers[cKDTree(counted.centers).query(centers)[1]] if known else np.full(len(centers), NO_TREE)

    def estimated(of: FloatArray, count: int) -> Estimate:
        return estimate(evidence_of(searched, of, pictures, seed=seed), count)

    def intervals(of: Estimate) -> dict[str, Any]:
        return {"interval": of.visible, "total": of.total, "total_interval": of.total_interval}

    trees = counted.trees
    if known:
        trees = [replace(tree, **intervals(estimated(counts * (own == tree.number), tree.count))) for tree in trees]
    whole = estimated(counts, counted.count)
    return replace(counted, trees=trees, likely=whole.likely, **intervals(whole))


def _inside(region: Region, gaussians: Gaussians) -> NDArray[np.bool_]:
    """(N,) which Gaussians lie in the region; an error with the extent of the scene if none does."""
    inside = region.contains(gaussians.means.detach().double().cpu().numpy())
    if not inside.any():
        subject = find_subject(gaussians)
        raise CountingError(
            f"None of the {len(inside)} Gaussians lies in the region (--count.box or --count.polygon). The scene's "
            f"detail lies between {spaced(subject.center - subject.radius)} and "
            f"{spaced(subject.center + subject.radius)}"
        )
    return inside


def _checked(gaussians: Gaussians, probability: NDArray | torch.Tensor, cameras: Sequence[Camera]) -> FloatArray:
    """The probabilities as (N,) float64, after shapes and values of all inputs were checked."""
    if isinstance(probability, torch.Tensor):
        probability = probability.detach().cpu().numpy()
    probabilities = np.asarray(probability, dtype=np.float64)
    if len(gaussians) == 0:
        raise CountingError("There are no Gaussians to count in. Train the scene first")
    if len(cameras) == 0:
        raise CountingError("There are no cameras. Counting needs the views that saw the scene")
    if probabilities.shape != (len(gaussians),):
        raise CountingError(
            f"The probability has shape {probabilities.shape}. Give one for each of the {len(gaussians)} Gaussians"
        )
    if not np.isfinite(probabilities).all():
        raise CountingError(
            f"{(~np.isfinite(probabilities)).sum()} probabilities are not finite. Lift the features again"
        )
    if probabilities.min() < -ROUNDING or probabilities.max() > 1.0 + ROUNDING:
        raise CountingError(
            f"The probabilities lie between {probabilities.min():.6g} and {probabilities.max():.6g}, not from 0 to 1"
        )
    for name in PARAMETERS:
        bad = int((~torch.isfinite(getattr(gaussians, name))).sum())
        if bad:
            raise CountingError(f"{bad} values of the Gaussians' {name} are not finite. Train the scene again")
    if len(gaussians) > 1 and bool((gaussians.means == gaussians.means[0]).all()):
        raise CountingError(
            f"All {len(gaussians)} Gaussians lie at the same position, "
            f"{spaced(gaussians.means[0].detach().cpu().numpy())}. Train the scene again"
        )
    return probabilities


def _checked_up(up: FloatArray) -> FloatArray:
    """The direction (3,) away from the ground with length 1."""
    given = np.asarray(up, np.float64)
    length = float(np.linalg.norm(given))
    if given.shape != (3,) or not 0.0 < length < np.inf:
        raise CountingError(f"The direction up is {given.tolist()}. Give three finite numbers that are not all 0")
    upward: FloatArray = given / length
    return upward


def select_gaussians(gaussians: Gaussians, probabilities: FloatArray, config: CountConfig) -> IntArray:
    """Which Gaussians may give surface points: opaque, and with a high enough probability (N,)."""
    opaque = gaussians.opacities.detach().double().cpu().numpy() >= LEAST_OPACITY
    least = config.threshold * (FAINT if config.method == "voting" else 1.0)
    return np.flatnonzero((probabilities >= least) & opaque)


def fruit_size(
    gaussians: Gaussians,
    probabilities: FloatArray,
    visibility: Visibility,
    seen: IntArray,
    config: CountConfig,
    progress: Progress = silent,
) -> FruitSize | None:
    """The size of the fruit, given or estimated; None if no part of the scene is round or gives points.

    probabilities: (N,) of the Gaussians; seen: those that may be fruit and that a view shows.
    """
    if config.diameter is not None:
        return FruitSize(config.diameter, DEFAULT_SPREAD)
    return _measured_size(gaussians, probabilities, visibility, seen, config, progress)


def _measured_size(
    gaussians: Gaussians,
    probabilities: FloatArray,
    visibility: Visibility,
    seen: IntArray,
    config: CountConfig,
    progress: Progress = silent,
) -> FruitSize | None:
    """The size estimated from the scene."""
    points = _sizing_points(gaussians, probabilities, visibility, seen, config)
    typical = float(np.median(_widths(gaussians, seen)))
    estimate = estimate_diameter(points, typical, progress=progress)
    if estimate is None or estimate.evidence < LEAST_EVIDENCE:
        return None
    return FruitSize(estimate.diameter, float(np.clip(estimate.spread, *FIRST_SPREADS)))


def _check_diameter(
    gaussians: Gaussians,
    probabilities: FloatArray,
    visibility: Visibility,
    seen: IntArray,
    config: CountConfig,
    progress: Progress = silent,
) -> list[str]:
    """Check a given diameter and return notices: one in another unit would find other objects, or nothing.

    Raises:
        CountingError: a fruit of that size is larger than all that may be fruit.
    """
    if config.diameter is None:
        return []
    places = gaussians.means.detach().double().cpu().numpy()[seen]
    extent = float(np.linalg.norm(np.ptp(places, axis=0)) + 2.0 * SURFACE * _widths(gaussians, seen).max())
    if config.diameter > extent:
        raise CountingError(
            f"--count.diameter {config.diameter:.4g} is larger than all that may be fruit, which extends over "
            f"{extent:.4g} scene units. Give the diameter in scene units, or leave it out"
        )
    measured = _measured_size(gaussians, probabilities, visibility, seen, config, progress)
    if measured is None or abs(np.log(config.diameter / measured.diameter)) < np.log(UNLIKE):
        return []
    return [
        f"fruit of diameter {config.diameter:.4g} scene units were counted, as --count.diameter says, but those of "
        f"the scene are {measured.diameter:.4g} wide. Without the setting these are counted"
    ]


def _sizing_points(
    gaussians: Gaussians, probabilities: FloatArray, visibility: Visibility, seen: IntArray, config: CountConfig
) -> SurfacePoints:
    """The points for the size estimate."""
    return sample_surface(
        gaussians,
        probabilities,
        visibility,
        seen,
        budget=min(max(SIZING_POINTS, int(SIZING_SHARE * len(seen))), config.sample_budget),
        seed=config.seed,
        largest=8.0 * float(np.median(_widths(gaussians, seen))),
    )


def _widths(gaussians: Gaussians, index: IntArray) -> FloatArray:
    """(G,) largest standard deviation of each of the Gaussians at `index` (G,), scene units."""
    widths: FloatArray = gaussians.scales.detach().double().cpu().numpy()[index].max(axis=1)
    return widths


def _why_no_size(
    gaussians: Gaussians,
    probabilities: FloatArray,
    visibility: Visibility,
    seen: IntArray,
    config: CountConfig,
    label: str,
) -> str:
    """Why no size can be estimated from the visible Gaussians."""
    if len(_sizing_points(gaussians, probabilities, visibility, seen, config)) == 0:
        return f"none of the {len(seen)} Gaussians of {label} {FACELESS}"
    return f"none of the {len(seen)} Gaussians of {label} lie on anything round"


def _require_fine(
    gaussians: Gaussians, seen: IntArray, diameter: float, config: CountConfig, reason: str, label: str
) -> None:
    """Refuse a 0 that comes from Gaussians larger than the fruit, or from a diameter smaller than the Gaussians.

    Raises:
        CountingError: most of the visible Gaussians are larger than the expected fruit.
    """
    if np.mean(_widths(gaussians, seen) > LARGEST_SCALE * diameter) <= 0.5:
        return
    advice = (
        "The reconstruction is too blurred: take sharper photos, read them larger (--scene.max-side), or train more "
        "Gaussians for more steps (--train.max-gaussians, --train.steps)"
        if config.diameter is None
        else f"--count.diameter {diameter:.4g} is too small: give it in scene units, or leave it out"
    )
    raise CountingError(f"The 0 for {label} is not a count: {reason}. {advice}")


def _why_no_points(gaussians: Gaussians, seen: IntArray, diameter: float, label: str) -> str:
    """Why the visible Gaussians give no points."""
    large = int((_widths(gaussians, seen) > LARGEST_SCALE * diameter).sum())
    if large == len(seen):
        return f"all {large} Gaussians of {label} are larger than the expected fruit"
    text = f"none of the {len(seen) - large} Gaussians of {label} {FACELESS}"
    return text + (f"; {large} others are larger than the expected fruit" if large else "")


def _sampled(
    gaussians: Gaussians,
    probabilities: FloatArray,
    visibility: Visibility,
    seen: IntArray,
    diameter: float,
    config: CountConfig,
) -> SurfacePoints:
    """The points to count in: on surfaces, or spread through the volume for the published methods."""
    if config.method == "voting":
        return sample_enough(
            gaussians, probabilities, visibility, seen, diameter=diameter, most=config.sample_budget, seed=config.seed
        )
    return sample_volume(
        gaussians, probabilities, visibility, seen,
        budget=min(VOLUME_POINTS, config.sample_budget), seed=config.seed, largest=LARGEST_SCALE * diameter,
    )  # fmt: skip


def _find(
    points: SurfacePoints,
    size: FruitSize,
    pictures: Sequence[Picture],
    photos: PhotoEvidence | None,
    config: CountConfig,
    progress: Progress,
) -> tuple[Clusters, Search | None]:
    """What the points became, and the candidates with their probabilities, which the published methods do not have;
    those use no photos."""
    if config.method != "voting":
        template = read_template(Path(config.template), seed=config.seed) if config.template else None
        road = split_by_template if config.method == "template" else cluster_as_fruitnerf
        return road(points, size.diameter, template, progress=progress), None
    given = config.diameter is not None
    alone = progress if photos is None else part(progress, 0.0, 0.3)
    found = search(points, size, pictures, config.threshold, given=given, progress=alone)
    if photos is not None:
        found = with_photos(found, photos, pictures, config.threshold, progress=part(progress, 0.3, 1.0))
    return find_fruit(found), found


def _mean_top(cameras: Sequence[Camera]) -> FloatArray:
    """(3,) mean of the cameras' upward axes, of length 1; the first camera's if they cancel each other out."""
    upward = -np.mean([camera.world_to_camera[1, :3] for camera in cameras], axis=0)
    length = float(np.linalg.norm(upward))
    top: FloatArray = upward / length if length > 1e-6 else -cameras[0].world_to_camera[1, :3]
    return top


def _top_to_bottom(centers: FloatArray, cameras: Sequence[Camera]) -> IntArray:
    """Order of the centres (F, 3) by descending height along the mean of the cameras' upward axes."""
    return np.argsort(-(centers @ _mean_top(cameras)), kind="stable").astype(np.int64)


def _none(highest: float, known: KnownFruit, reason: str, points: int = 0, diameter: float | None = None) -> FruitCount:
    entry = AuditEntry(0, "dropped", reason, (0.0, 0.0, 0.0), points, diameter=diameter)
    return FruitCount(fruits=[], audit=[entry], max_probability=highest, mean_diameter=None, last_id=known.last)
