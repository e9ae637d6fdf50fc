"""Gaussians with probabilities → counted fruit, each with its size, and an account of every cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
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
from .accounts.interval import Estimate, estimate, gather_evidence
from .accounts.zero import UNKNOWN, Matching, Quality
from .evidence.cluster import Clusters, Search, find_fruit, search
from .evidence.fruit_colours import FruitColours
from .evidence.long_fruit import Parts
from .evidence.picture_size import size_from_pictures
from .evidence.pixel_width import pixel_widths
from .evidence.size import FruitSize
from .evidence.surface_points import SurfacePoints
from .evidence.visibility import Picture, Visibility, draw, find_visibility, gather_view_evidence
from .fruit import NO_TREE, AuditEntry, FruitCount
from .geometry.sphere import Spheres
from .photos.join import PhotoEvidence, add_photos
from .published.fruitnerf import cluster_as_fruitnerf
from .published.template import split_by_template
from .published.template_shape import read_template
from .regions.ground import doubt_sunken, find_fallen
from .regions.region import REACH, Region, format_position, keep_inside, region_of
from .regions.row import check_trees, trees_of_row
from .sizing import (
    FAINT,
    LEAST_OPACITY,
    check_diameter,
    explain_no_points,
    explain_no_size,
    fruit_size,
    require_fine,
    sample_points,
    select_gaussians,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

ROUNDING = 1e-5
"""Tolerance of a probability outside 0…1: rounding of sums in float32."""
NO_SHAPE = "no candidate among the matching Gaussians has the shape of a fruit"
"""Reason of a 0 for which the audit lists the candidates."""


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
    probabilities = _check_inputs(gaussians, probability, cameras)
    up = _mean_top(cameras) if up is None else _check_up(up)
    region = region_of(config, up)
    check_trees(config, up)
    inside = _find_inside(region, gaussians)
    highest = float(probabilities[inside].max())
    matching = Matching.of(gaussians, probabilities, inside, cameras, label, quality, photos, config.threshold)

    def count_zero(reason: str, diameter: float | None = None, *, points: int = 0, visible: bool = True) -> FruitCount:
        matching.require_answer(reason, diameter)
        none = _make_zero(highest, known, reason, points, diameter)
        return _place_on_trees(matching.add_bounds(none, diameter, visible=visible), [], config, up, cameras)

    selected = select_gaussians(gaussians, probabilities, config)
    if highest < config.threshold:
        return count_zero(f"no Gaussian reaches {config.threshold:.2f}: the highest probability is {highest:.3f}")
    if not inside[selected].any():
        return count_zero(
            f"all {len(matching)} Gaussians of {label} are transparent: their opacities are below {LEAST_OPACITY}"
        )
    progress(0.0, "Rendering the Gaussians in each view")
    if visibility is None:
        visibility = find_visibility(gaussians, cameras, progress=part(progress, 0.0, 0.3))
    seen = selected[visibility.weights[selected] > 0]
    own = seen[inside[seen]]
    if len(own) == 0:
        return count_zero(f"no view shows any of the {inside[selected].sum()} Gaussians of {label}", visible=False)
    notices = check_diameter(gaussians, probabilities, visibility, own, config, part(progress, 0.3, 0.4))
    size = fruit_size(gaussians, probabilities, visibility, own, config, part(progress, 0.4, 0.5))
    pictures = draw(gaussians, probabilities, cameras, progress=part(progress, 0.5, 0.7))
    sized = size or size_from_pictures(pictures, config.threshold, region.contains)
    if sized is None or (size is None and matching.is_sharp(sized.diameter)):
        return count_zero(explain_no_size(gaussians, probabilities, visibility, own, config, label), points=len(own))
    if size is None:
        notices = [
            f"no surface of {label} is round, so the size of the fruit was estimated from the widths of its regions in "
            "the rendered views. Check the sizes and the count"
        ]
    points = sample_points(gaussians, probabilities, visibility, seen, sized.diameter, config)
    points = points.select(region.contains(points.positions, REACH * sized.diameter))
    if len(points) == 0:
        reason = explain_no_points(gaussians, own, sized.diameter, label)
        require_fine(gaussians, own, sized.diameter, config, reason, label)
        none = count_zero(reason, sized.diameter, points=len(own))
        return replace(none, notices=[*notices, *none.notices])
    evidence = None if photos is None else PhotoEvidence(gaussians, probabilities, photos)
    others = gaussians.select(torch.from_numpy(np.flatnonzero(probabilities < config.threshold)))
    doubt = partial(doubt_sunken, gaussians=others, cameras=cameras, up=up)
    lengthwise = config.diameter is None or not notices  # small spheres on large fruit look like a long one
    found, searched = _find(points, sized, pictures, evidence, doubt, lengthwise, config, part(progress, 0.7, 1.0))
    within = keep_inside(found, region)
    weights = np.where(probabilities >= FAINT * config.threshold, visibility.weights, 0.0)
    colours = FruitColours(choice, gaussians, weights, pictures, photos, config.threshold)
    clusters = colours.keep(within)
    spheres, beyond = clusters.spheres, len(found.spheres) - len(within.spheres)
    described = _describe_fruit(gaussians, seen, clusters, pictures, cameras, known, config, label, beyond, highest)
    other_colors = len(within.spheres) - len(spheres)
    counted = replace(
        described, notices=[*quality.notices, *notices, *_note_long_fruit(found)], other_colors=other_colors
    )
    lying = find_fallen(others, cameras, counted.centers, counted.diameters, up)
    placed = _place_on_trees(counted, lying, config, up, cameras)
    if searched is not None:
        candidates = searched.found.spheres
        counts = region.contains(candidates.centers) * colours.chances(candidates.centers, candidates.radii)
        placed = _add_intervals(placed, searched, counts, found.parts, pictures, config.seed)
    if len(spheres):
        return placed
    if len(within.spheres):
        matching.require_answer(colours.refusal)
        notice = f"no {label} was counted, but {other_colors} fruit of other colours were found"
        return replace(placed, notices=[*placed.notices, notice])
    if len(found.spheres):
        matching.require_answer("all fruit that were found lie outside the region")
        return placed
    if config.diameter is not None and notices:
        raise CountingError(f"The 0 for {label} is not a count: {notices[0]}")
    matching.require_answer(NO_SHAPE, sized.diameter)
    estimated = searched is not None and len(searched.found.spheres) > 0 and size is not None
    if estimated and photos is None:
        return placed
    refused = 0 if searched is None else int(region.contains(searched.on_surfaces).sum())
    return matching.add_bounds(placed, sized.diameter, searched=estimated, refused=refused)


def _describe_fruit(
    gaussians: Gaussians,
    seen: IntArray,
    clusters: Clusters,
    pictures: Sequence[Picture],
    cameras: Sequence[Camera],
    known: KnownFruit,
    config: CountConfig,
    label: str,
    beyond: int,
    highest: float,
) -> FruitCount:
    """Return the fruit with their numbers and descriptions, and the audit.

    beyond: number of fruit outside the region; highest: probability of a Gaussian in it.
    """
    spheres = clusters.spheres
    mean = float(2.0 * spheres.radii.mean()) if len(spheres) else None
    numbers = number(spheres.centers, _top_to_bottom(spheres.centers, cameras), mean or 0.0, known)
    account = account_for(clusters, numbers, beyond=beyond)
    view_evidence = gather_view_evidence(pictures, spheres.centers, spheres.radii, config.threshold)
    return FruitCount(
        fruits=describe(gaussians, seen, clusters, numbers, account.compound, view_evidence, label),
        audit=account.entries,
        max_probability=highest,
        mean_diameter=mean,
        last_id=max(known.last, int(numbers.max(initial=0))),
        points=clusters.points.positions,
        point_colors=np.round(point_colors(gaussians, clusters)).astype(np.uint8),
        point_fruit_ids=np.append(numbers, -1)[clusters.owners],
        pixel_width=_pixel_width(spheres, cameras, pictures),
    )


def _note_long_fruit(found: Clusters) -> list[str]:
    """Return a message if the fruit are long."""
    if found.parts is None or found.axes is None:
        return []
    lengths = np.linalg.norm(found.axes, axis=2)
    return [
        f"the fruit are about {np.median(lengths[:, 0] / lengths[:, 1]):.1f} times as long as wide: "
        f"{len(found.parts.owners)} spheres along them were joined to {len(found.spheres)} fruit"
    ]


def _pixel_width(spheres: Spheres, cameras: Sequence[Camera], pictures: Sequence[Picture]) -> float | None:
    """The median width of the fruit in pixels of the photos as they were read; None if no view frames one."""
    widths = pixel_widths(spheres.centers, 2.0 * spheres.radii, cameras, pictures)
    known = widths[np.isfinite(widths)]
    return float(np.median(known)) if len(known) else None


def _place_on_trees(
    counted: FruitCount, lying: Sequence[bool | None], config: CountConfig, up: FloatArray, cameras: Sequence[Camera]
) -> FruitCount:
    """Add the position of each fruit to the count, and an audit entry for trees that no fruit belongs to."""
    row = trees_of_row(counted.centers, config, up, cameras[0].world_to_camera[0, :3])
    placed = place_fruit(counted, lying, row)
    if config.trees == 0 or row is not None:
        return placed
    reason = f"no tree of the {config.trees} that --count.trees asks for is found: trees are found by their fruit"
    last = max((entry.cluster for entry in counted.audit), default=-1)
    entry = AuditEntry(cluster=last + 1, verdict="dropped", reason=reason, center=(0.0, 0.0, 0.0), points=0)
    return replace(placed, audit=[*placed.audit, entry])


def _add_intervals(
    counted: FruitCount,
    searched: Search,
    counts: FloatArray,
    parts: Parts | None,
    pictures: Sequence[Picture],
    seed: int,
) -> FruitCount:
    """Add intervals to the count and its trees; a candidate belongs to the tree of its nearest fruit.

    counts: (C,) probability that a candidate counts if it is a fruit; parts: of long fruit, None if they are round.
    Without fruit, trees have no interval.
    """
    centers = searched.found.spheres.centers
    shares = None if parts is None else parts.shares(centers)
    numbers = np.array([NO_TREE if fruit.tree is None else fruit.tree for fruit in counted.fruits])
    known = counted.trees and counted.fruits
    own = numbers[cKDTree(counted.centers).query(centers)[1]] if known else np.full(len(centers), NO_TREE)

    def estimate_for(of: FloatArray, count: int) -> Estimate:
        return estimate(gather_evidence(searched, of, pictures, shares, seed=seed), count)

    def intervals(of: Estimate) -> dict[str, Any]:
        return {
            "interval": of.visible,
            "likely": of.likely,
            "total": of.total,
            "total_interval": of.total_interval,
        }

    trees = counted.trees
    if known:
        trees = [replace(tree, **intervals(estimate_for(counts * (own == tree.number), tree.count))) for tree in trees]
    whole = estimate_for(counts, counted.count)
    return replace(counted, trees=trees, **intervals(whole))


def _find_inside(region: Region, gaussians: Gaussians) -> NDArray[np.bool_]:
    """Find which Gaussians (N,) lie in the region; raise an error with the extent of the scene if none does."""
    inside = region.contains(gaussians.means.detach().double().cpu().numpy())
    if not inside.any():
        subject = find_subject(gaussians)
        raise CountingError(
            f"None of the {len(inside)} Gaussians lies in the region (--count.box or --count.polygon). The scene's "
            f"detail lies between {format_position(subject.center - subject.radius)} and "
            f"{format_position(subject.center + subject.radius)}"
        )
    return inside


def _check_inputs(gaussians: Gaussians, probability: NDArray | torch.Tensor, cameras: Sequence[Camera]) -> FloatArray:
    """Check shapes and values of all inputs and return the probabilities as (N,) float64."""
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
            f"{format_position(gaussians.means[0].detach().cpu().numpy())}. Train the scene again"
        )
    return probabilities


def _check_up(up: FloatArray) -> FloatArray:
    """Check the direction (3,) away from the ground and return it with length 1."""
    given = np.asarray(up, np.float64)
    length = float(np.linalg.norm(given))
    if given.shape != (3,) or not 0.0 < length < np.inf:
        raise CountingError(f"The direction up is {given.tolist()}. Give three finite numbers that are not all 0")
    upward: FloatArray = given / length
    return upward


def _find(
    points: SurfacePoints,
    size: FruitSize,
    pictures: Sequence[Picture],
    photos: PhotoEvidence | None,
    doubt: Callable[[Search], Search],
    lengthwise: bool,
    config: CountConfig,
    progress: Progress,
) -> tuple[Clusters, Search | None]:
    """What the points became, and the candidates with their probabilities, which the published methods do not have;
    those use no photos. doubt: lowers the probabilities of candidates in the ground; lengthwise: whether fruit may be
    long."""
    if config.method != "voting":
        template = read_template(Path(config.template), seed=config.seed) if config.template else None
        road = split_by_template if config.method == "template" else cluster_as_fruitnerf
        return road(points, size.diameter, template, progress=progress), None
    given = config.diameter is not None
    alone = progress if photos is None else part(progress, 0.0, 0.3)
    found = search(points, size, pictures, config.threshold, given=given, progress=alone)
    if photos is not None:
        found = add_photos(found, photos, pictures, config.threshold, progress=part(progress, 0.3, 1.0))
    found = doubt(found)
    return find_fruit(found, lengthwise=lengthwise), found


def _mean_top(cameras: Sequence[Camera]) -> FloatArray:
    """(3,) mean of the cameras' upward axes, of length 1; the first camera's if they cancel each other out."""
    upward = -np.mean([camera.world_to_camera[1, :3] for camera in cameras], axis=0)
    length = float(np.linalg.norm(upward))
    top: FloatArray = upward / length if length > 1e-6 else -cameras[0].world_to_camera[1, :3]
    return top


def _top_to_bottom(centers: FloatArray, cameras: Sequence[Camera]) -> IntArray:
    """Order of the centres (F, 3) by descending height along the mean of the cameras' upward axes."""
    return np.argsort(-(centers @ _mean_top(cameras)), kind="stable").astype(np.int64)


def _make_zero(
    highest: float, known: KnownFruit, reason: str, points: int = 0, diameter: float | None = None
) -> FruitCount:
    entry = AuditEntry(0, "dropped", reason, (0.0, 0.0, 0.0), points, diameter=diameter)
    return FruitCount(fruits=[], audit=[entry], max_probability=highest, mean_diameter=None, last_id=known.last)
