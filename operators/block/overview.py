"""A block as it is shown: fruit and a few thousand Gaussians of each result, and where its trees stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...engine.errors import FruitLangsError
from ...engine.progress import Progress, silent
from ..data.write_root import compute_upright_matrix, find_focus

if TYPE_CHECKING:
    from ...engine.block.ledger import Ledger
    from ...engine.block.reviews import ReviewedFruit
    from ...engine.block.trees import CountedTree
    from ...engine.scene.camera import Scene
    from ...engine.splatting.gaussians import Gaussians

FloatArray = NDArray[np.float64]

MOST_POINTS, MOST_EACH = 200_000, 6_000
"""Gaussians that are shown of all results together, and of one."""
AROUND, NEAR = 0.2, 0.6
"""Room around the fruit in which Gaussians are shown, in widths of the fruit; and without fruit the distance from what
the cameras look at, in extents of the scene."""
APART = 1.2
"""Distance between two results whose places are not known, in widths of the widest."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownTree:
    """A tree. name: of its line in the table; problem: why it has no count; note: what to know about its count;
    counted, reviewed: numbers, -1 without;
    centers, axes, probabilities: (F, 3), (F, 3, 3) half axes and (F,) of its fruit, in the frame of the result."""

    name: str
    problem: str = ""
    note: str = ""
    counted: int = -1
    reviewed: int = -1
    centers: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    axes: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    probabilities: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownResult:
    """A result with its trees. folder: its name; place: (2,) in the world; matrix: (4, 4) from its frame to the world,
    upright, with its middle over the origin; points, colors: (P, 3) some of its Gaussians and their sRGB; width:
    of what is shown, in the world."""

    folder: str
    trees: Sequence[ShownTree]
    place: FloatArray = field(default_factory=lambda: np.zeros(2))
    matrix: FloatArray = field(default_factory=lambda: np.eye(4))
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    colors: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    width: float = 0.0


def read_overview(ledger: Ledger, trees: Sequence[CountedTree], progress: Progress = silent) -> list[ShownResult]:
    """Every result of a block, in the order of its manifest. trees: of `read_counts`."""
    own: dict[str, list[CountedTree]] = {}
    for tree in trees:
        own.setdefault(tree.folder, []).append(tree)
    most = min(MOST_POINTS // max(len(own), 1), MOST_EACH)
    found = []
    for number, (folder, its) in enumerate(own.items()):
        progress(number / len(own), f"reading {folder}, {number + 1} of {len(own)}")
        try:
            found.append(_read(ledger.folder(folder).path, its, most))
        except FruitLangsError as error:
            found.append(ShownResult(folder=folder, trees=[_make_uncounted(tree, str(error)) for tree in its]))
    return [replace(each, place=place) for each, place in zip(found, _find_places(found, own), strict=True)]


def _read(path: Path, trees: Sequence[CountedTree], most: int) -> ShownResult:
    """
    Raises:
        OutputError, FormatError: the result is damaged.
    """
    from ...engine.block.reviews import fruit_of, read_review
    from ...engine.report.results import FRUITS_JSON, parse_results
    from ...engine.scene.formats.cameras_json import read_cameras
    from ...engine.splatting.ply import read_ply
    from ...engine.training import CAMERAS, GAUSSIANS

    if trees[0].count is None:
        return ShownResult(folder=path.name, trees=[_make_uncounted(tree) for tree in trees])
    document = parse_results(path / FRUITS_JSON)
    unit = document["metres_per_unit"] or 1.0
    fruits = [fruit for fruit in fruit_of(document, read_review(path, document["set_id"])) if fruit.counts]
    numbers = [tree["number"] for tree in document.get("trees") or []] or [None]
    shown = [
        _make_tree(tree, [fruit for fruit in fruits if number is None or fruit.tree == number], unit)
        for tree, number in zip(trees, numbers, strict=True)
    ]
    scene = replace(read_cameras(path / CAMERAS), metres_per_unit=document["metres_per_unit"])
    centers = np.concatenate([tree.centers for tree in shown])
    points, colors = _sample_gaussians(scene, read_ply(path / GAUSSIANS), centers, most)
    matrix = np.diag([unit, unit, unit, 1.0]) @ compute_upright_matrix(replace(scene, points=points))
    matrix = _align_along_x(matrix, [tree.centers.mean(axis=0) for tree in shown if len(tree.centers)]) @ matrix
    world = (centers if len(centers) else points) @ matrix[:3, :3].T
    width = float(np.ptp(world[:, :2], axis=0).max()) if len(world) else 0.0
    return ShownResult(folder=path.name, trees=shown, matrix=matrix, points=points, colors=colors, width=width)


def _align_along_x(matrix: FloatArray, trees: Sequence[FloatArray]) -> FloatArray:
    """Return the rotation (4, 4) about z after which trees of a row, at (3,) in its frame, follow each other along
    x."""
    turn = np.eye(4)
    if len(trees) > 1:
        x, y = (matrix[:3, :3] @ (trees[-1] - trees[0]))[:2]
        turn[:2, :2] = np.array([[x, y], [-y, x]]) / max(float(np.hypot(x, y)), 1e-12)
    return turn


def _make_uncounted(tree: CountedTree, problem: str = "") -> ShownTree:
    return ShownTree(name=tree.entry.id, problem=problem or tree.state.reason or tree.state.stage)


def _make_tree(tree: CountedTree, fruits: Sequence[ReviewedFruit], unit: float) -> ShownTree:
    assert tree.counted is not None
    return ShownTree(
        name=tree.entry.id,
        note=tree.note,
        counted=tree.counted,
        reviewed=-1 if tree.reviewed is None else tree.reviewed,
        centers=np.array([fruit.center for fruit in fruits], np.float64).reshape(-1, 3),
        axes=np.array([fruit.axes for fruit in fruits], np.float64).reshape(-1, 3, 3) / unit,
        probabilities=np.array([fruit.probability for fruit in fruits], np.float64),
    )


def _sample_gaussians(
    scene: Scene, gaussians: Gaussians, fruit: FloatArray, most: int
) -> tuple[FloatArray, FloatArray]:
    """Return the means (P, 3) and sRGB (P, 3) of Gaussians around the fruit (F, 3), or around what the cameras look at
    without any: a random choice, the same each time, in which large ones are likelier."""
    means = gaussians.means.double().numpy()
    chance = gaussians.opacities.double().numpy() * gaussians.scales.double().numpy().max(axis=1)
    if len(fruit) > 1:
        low, high = fruit.min(axis=0), fruit.max(axis=0)
        margin = AROUND * float(np.median(high - low))
        chance[((means < low - margin) | (means > high + margin)).any(axis=1)] = 0.0
    else:
        chance[np.linalg.norm(means - find_focus(scene), axis=1) > NEAR * scene.extent] = 0.0
    there = np.flatnonzero(chance > 0.0)
    if len(there) > most:
        share = chance[there] / chance[there].sum()
        there = np.sort(np.random.default_rng(0).choice(there, most, replace=False, p=share))
    return means[there], gaussians.base_colors.double().numpy()[there]


def _find_places(results: Sequence[ShownResult], own: dict[str, list[CountedTree]]) -> list[FloatArray]:
    """Find the place (2,) in the world of each result: by GPS, else by row and position, if lengths are metres and all
    are known; else row by row, side by side."""
    from ...engine.scene.gps import GpsTag, local_metres

    entries = [[tree.entry for tree in own[each.folder]] for each in results]
    latitudes, longitudes, alongs = (
        [_mean([getattr(entry, name) for entry in its]) for its in entries]
        for name in ("latitude", "longitude", "position")
    )
    metric = all(tree.metric for its in own.values() for tree in its if tree.count is not None)
    if metric and None not in latitudes + longitudes:
        tags = [GpsTag(*place, None) for place in zip(latitudes, longitudes, strict=True)]  # type: ignore[arg-type]
        return list(local_metres(tags)[:, :2])
    rows = list(dict.fromkeys(its[0].row for its in entries))
    apart = APART * max((each.width for each in results), default=0.0) or 1.0
    known = metric and None not in alongs
    taken = dict.fromkeys(rows, 0)
    found = []
    for its, along in zip(entries, alongs, strict=True):
        row = its[0].row
        x = along if known and along is not None else apart * taken[row]
        taken[row] += 1
        found.append(np.array([x, -apart * rows.index(row)]))
    return found


def _mean(values: Sequence[float | None]) -> float | None:
    """Their mean; None if one is not known."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None
