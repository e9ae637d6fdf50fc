"""Gaussians with probabilities → counted fruit, each with its size, and an account of every cluster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..config import CountConfig
from ..errors import CountingError
from ..progress import Progress, part, silent
from ..scene.camera import Camera
from ..splatting.gaussians import Gaussians
from ..splatting.viewpoints import find_subject
from .account import Account, account_for
from .claims import members
from .cluster import Clusters, find_fruit, search
from .fruit import NO_TREE, AuditEntry, Fruit, FruitCount, FruitKind, Tree
from .ground import lying_on_ground
from .region import REACH, Region, keep_inside, region_of, spaced
from .row import Row, trees_of_row
from .sample import SurfacePoints, sample_skin, sample_volume
from .size import LEAST_EVIDENCE, FruitSize, estimate_diameter
from .sphere import Spheres
from .template import split_by_template
from .visibility import Looks, Picture, Visibility, draw, edge_ratio, look_at, see

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LEAST_OPACITY = 0.05
FAINT = 1.0 / 3.0
"""Share of the threshold from which a Gaussian may add to a fruit whose surer Gaussians come near the threshold."""
SIZING_POINTS = 20_000
LARGEST_SCALE = 0.5
"""Largest standard deviation, in mean fruit diameters, of a Gaussian that may give points."""
DEFAULT_SPREAD = 0.2
"""Deviation of log diameter between fruit where the diameter is given and not estimated."""
FIRST_SPREADS = (0.15, 0.35)
"""Least and largest deviation of log diameter that is looked for first."""
SMALL = 0.6
"""A fruit below this many mean diameters is of kind "small"."""


def count_fruit(
    gaussians: Gaussians,
    probability: NDArray | torch.Tensor,
    cameras: Sequence[Camera],
    config: CountConfig,
    *,
    label: str,
    up: FloatArray | None = None,
    visibility: Visibility | None = None,
    progress: Progress = silent,
) -> FruitCount:
    """Count the fruit that the Gaussians with a probability (N,) near or above `config.threshold` make up.

    Where a part of a fruit is about as probable as the threshold, its fainter Gaussians count as well.

    up: (3,) away from the ground; as the cameras stand where it is not given. visibility: how the cameras see the
    Gaussians, where it is known already; rendered otherwise. Fruit are numbered from 1, from top to bottom as the
    cameras stand. A prompt that no Gaussian satisfies is a count of 0 with one audit entry that says how near it came.
    With a region, size and fruit come from what lies in it; what it cuts in two is looked at whole.

    Raises:
        ConfigError: the region is no region.
        CountingError: a shape does not fit, a value is not finite, there are no Gaussians or no cameras, none lies in
            the region, or there are fewer fruit than trees asked for.
    """
    chances = _checked(gaussians, probability, cameras)
    up = _mean_top(cameras) if up is None else np.asarray(up, np.float64) / np.linalg.norm(up)
    region = region_of(config, up)
    inside = _inside(region, gaussians)
    highest = float(chances[inside].max())
    selected = select_gaussians(gaussians, chances, config)
    if highest < config.threshold or not inside[selected].any():
        return _none(highest, f"no Gaussian reaches {config.threshold:.2f}: the highest probability is {highest:.3f}")
    progress(0.0, "seeing the Gaussians from each view")
    if visibility is None:
        visibility = see(gaussians, cameras, progress=part(progress, 0.0, 0.3))
    seen = selected[visibility.weights[selected] > 0]
    own = seen[inside[seen]]
    if len(own) == 0:
        return _none(highest, f"no view sees any of the {inside[selected].sum()} Gaussians of {label}")
    sized = fruit_size(gaussians, chances, visibility, own, config, part(progress, 0.3, 0.5))
    if sized is None:
        return _none(highest, f"none of the {len(own)} Gaussians of {label} lie on anything round", len(own))
    sample = sample_volume if config.method == "template" else sample_skin
    points = sample(
        gaussians,
        chances,
        visibility,
        seen,
        budget=config.sample_budget,
        seed=config.seed,
        largest=LARGEST_SCALE * sized.diameter,
    )
    points = points.select(region.contains(points.positions, REACH * sized.diameter))
    if len(points) == 0:
        return _none(
            highest, f"all {len(own)} Gaussians of {label} are larger than a fruit of diameter {sized.diameter:.3g}"
        )
    pictures = draw(gaussians, chances, cameras, progress=part(progress, 0.5, 0.7))
    found = _find(points, sized, pictures, config, part(progress, 0.7, 1.0))
    clusters = keep_inside(found, region)
    order = _top_to_bottom(clusters.spheres.centers, cameras)
    account = account_for(clusters, order, beyond=len(found.spheres) - len(clusters.spheres))
    spheres = clusters.spheres.select(order)
    if config.diameter is None:
        spheres = spheres.grown(edge_ratio(pictures, spheres.centers, spheres.radii))
    looks = look_at(pictures, spheres.centers, spheres.radii)
    counted = _finish(gaussians, chances, seen, clusters, spheres, order, account, looks, label, highest)
    others = gaussians.select(torch.from_numpy(np.flatnonzero(chances < config.threshold)))
    lying = lying_on_ground(others, cameras, counted.centers, counted.diameters, up)
    row = trees_of_row(counted.centers, config, up, cameras[0].world_to_camera[0, :3])
    return _placed(counted, lying, row)


def _inside(region: Region, gaussians: Gaussians) -> NDArray[np.bool_]:
    """(N,) which Gaussians lie in the region; an error with the scene's extent where none does."""
    inside = region.contains(gaussians.means.detach().double().cpu().numpy())
    if not inside.any():
        subject = find_subject(gaussians)
        raise CountingError(
            f"none of the {len(inside)} Gaussians lies in the region (--count.box or --count.polygon); the scene's "
            f"detail lies between {spaced(subject.center - subject.radius)} and "
            f"{spaced(subject.center + subject.radius)}"
        )
    return inside


def _checked(gaussians: Gaussians, probability: NDArray | torch.Tensor, cameras: Sequence[Camera]) -> FloatArray:
    """The probabilities as (N,) float64, once everything that goes in has a sound shape and finite values."""
    if isinstance(probability, torch.Tensor):
        probability = probability.detach().cpu().numpy()
    chances = np.asarray(probability, dtype=np.float64)
    if len(gaussians) == 0:
        raise CountingError("there are no Gaussians to count in; train the scene first")
    if len(cameras) == 0:
        raise CountingError("there are no cameras; counting needs the views that saw the scene")
    if chances.shape != (len(gaussians),):
        raise CountingError(
            f"the probability has shape {chances.shape}; give one value for each of the {len(gaussians)} Gaussians"
        )
    if not np.isfinite(chances).all():
        raise CountingError(f"{(~np.isfinite(chances)).sum()} probabilities are not finite; lift the features again")
    for name in ("means", "log_scales", "quats", "opacity_logits"):
        bad = int((~torch.isfinite(getattr(gaussians, name))).sum())
        if bad:
            raise CountingError(f"{bad} values of the Gaussians' {name} are not finite; train the scene again")
    return chances


def select_gaussians(gaussians: Gaussians, chances: FloatArray, config: CountConfig) -> IntArray:
    """Which Gaussians may give surface points: opaque, and with a probability (N,) that is high enough."""
    opaque = gaussians.opacities.detach().double().cpu().numpy() >= LEAST_OPACITY
    least = config.threshold * (1.0 if config.method == "template" else FAINT)
    return np.flatnonzero((chances >= least) & opaque)


def fruit_size(
    gaussians: Gaussians,
    chances: FloatArray,
    visibility: Visibility,
    seen: IntArray,
    config: CountConfig,
    progress: Progress = silent,
) -> FruitSize | None:
    """The size of the fruit, given or estimated; None when nothing looks round.

    chances: (N,) probability of each Gaussian; seen: those that may be fruit and that a view sees.
    """
    if config.diameter is not None:
        return FruitSize(config.diameter, DEFAULT_SPREAD)
    widths = gaussians.scales.detach().double().cpu().numpy()[seen].max(axis=1)
    typical = float(np.median(widths))
    points = sample_skin(
        gaussians,
        chances,
        visibility,
        seen,
        budget=min(SIZING_POINTS, config.sample_budget),
        seed=config.seed,
        largest=8.0 * typical,
    )
    estimate = estimate_diameter(points, typical, seed=config.seed, progress=progress)
    if estimate is None or estimate.evidence < LEAST_EVIDENCE:
        return None
    return FruitSize(estimate.diameter, float(np.clip(estimate.spread, *FIRST_SPREADS)))


def _find(
    points: SurfacePoints,
    size: FruitSize,
    pictures: Sequence[Picture],
    config: CountConfig,
    progress: Progress,
) -> Clusters:
    if config.method == "template":
        return split_by_template(points, size.diameter, seed=config.seed, progress=progress)
    given = config.diameter is not None
    return find_fruit(search(points, size, pictures, config.threshold, given=given, progress=progress))


def _mean_top(cameras: Sequence[Camera]) -> FloatArray:
    """(3,) mean of the cameras' own upward axes."""
    return -np.mean([camera.world_to_camera[1, :3] for camera in cameras], axis=0)


def _top_to_bottom(centers: FloatArray, cameras: Sequence[Camera]) -> IntArray:
    """Order of the centres (F, 3) by falling height along the mean of the cameras' own upward axes."""
    return np.argsort(-(centers @ _mean_top(cameras)), kind="stable").astype(np.int64)


def _finish(
    gaussians: Gaussians,
    chances: FloatArray,
    seen: IntArray,
    clusters: Clusters,
    spheres: Spheres,
    order: IntArray,
    account: Account,
    looks: Looks,
    label: str,
    highest: float,
) -> FruitCount:
    numbers = np.append(account.numbers, -1)
    mean = float(2.0 * spheres.radii.mean()) if len(spheres) else None
    means = gaussians.means.detach().double().cpu().numpy()[seen]
    owners = _nearest_sphere(means, spheres.centers, spheres.radii)
    colors = 255.0 * gaussians.base_colors.detach().double().cpu().numpy()[clusters.points.gaussians]
    own = members(clusters.owners, len(spheres))
    fruits = []
    for index in range(len(spheres)):
        diameter, shown = float(2.0 * spheres.radii[index]), float(looks.visible_fractions[index])
        kind: FruitKind = "compound-part" if account.compound[index] else "single"
        fruits.append(
            Fruit(
                id=index + 1,
                label=label,
                center=spheres.centers[index],
                diameter=diameter,
                diameter_sd=float(2.0 * spheres.radius_sds[index]),
                volume=float(np.pi / 6.0 * diameter**3),
                probability=float(clusters.probabilities[order[index]]),
                visible_fraction=None if np.isnan(shown) else shown,
                views=int(looks.views[index]),
                color=colors[own[order[index]]].mean(axis=0).round().astype(np.uint8),
                kind="small" if mean and diameter < SMALL * mean else kind,
                members=seen[owners == index],
            )
        )
    return FruitCount(
        fruits=fruits,
        audit=account.entries,
        max_probability=highest,
        mean_diameter=mean,
        points=clusters.points.positions,
        point_colors=np.round(colors).astype(np.uint8),
        point_fruit_ids=numbers[clusters.owners],
    )


def _placed(counted: FruitCount, lying: Sequence[bool | None], row: Row | None) -> FruitCount:
    """The fruit with what is known of where they are: on the ground or not, and on which tree."""
    numbers = [NO_TREE] * counted.count if row is None else row.numbers.tolist()
    fruits = [
        replace(fruit, fallen=fallen, tree=None if number == NO_TREE else number)
        for fruit, fallen, number in zip(counted.fruits, lying, numbers, strict=True)
    ]
    places = () if row is None else row.places
    trees = [Tree(number, place, numbers.count(number)) for number, place in enumerate(places, start=1)]
    return replace(counted, fruits=fruits, trees=trees)


def _nearest_sphere(means: FloatArray, centers: FloatArray, radii: FloatArray) -> IntArray:
    """(N,) index of the sphere each mean (N, 3) lies in or within 0.3 radii of, the relatively nearest; -1 none."""
    owners, best = np.full(len(means), -1, np.int64), np.full(len(means), 1.3)
    for index, (center, radius) in enumerate(zip(centers, radii, strict=True)):
        relative = np.linalg.norm(means - center, axis=1) / radius
        closer = relative < best
        owners[closer], best[closer] = index, relative[closer]
    return owners


def _none(highest: float, reason: str, points: int = 0) -> FruitCount:
    entry = AuditEntry(cluster=0, verdict="dropped", reason=reason, center=(0.0, 0.0, 0.0), points=points)
    return FruitCount(fruits=[], audit=[entry], max_probability=highest, mean_diameter=None)
