"""Counted fruit and the audit of the count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FruitKind = Literal["single", "small", "compound-part"]
KIND_TEXTS: dict[str, str] = {"single": "single", "small": "small", "compound-part": "in a clump"}
"""The kinds for people; files for programs have the keys."""
Verdict = Literal["kept", "split", "merged", "dropped"]

NEAR = 0.5
"""Diameters within which a centre of a later count is the same fruit."""
NO_TREE = 0
"""Tree number of a fruit that belongs to no tree of the row."""


@dataclass(frozen=True, eq=False)
class Fruit:
    """One counted fruit.

    Attributes
    ----------
    id : int
        Number that later counts of the scene keep.
    label : str
        The prompt.
    center : array, (3,)
        In the frame of the scene, scene units.
    diameter : float
        Diameter of the sphere of equal volume, scene units.
    diameter_sd : float
        Its standard deviation, scene units.
    volume : float
        Cubed scene units.
    axes : array, (3, 3)
        Rows are its half axes, longest first, right-handed, scene units.
    probability : float
        That it is a fruit of the prompt.
    visible_fraction : float or None
        Largest share of it that one view shows; None if not measured.
    views : int
        Views that show at least a tenth of it.
    color : array, (3,)
        Mean sRGB of its surface, which indicates its ripeness.
    kind : str
        "single", "small", or "compound-part" for a part of a cluster.
    members : array, (M,)
        Indices of its Gaussians.
    fallen : bool or None
        Whether it lies on the ground; None if no ground is visible.
    tree : int or None
        Number of its tree, from 1; None if no trees were requested or it belongs to none.
    """

    id: int
    label: str
    center: NDArray[np.float64]
    diameter: float
    diameter_sd: float
    volume: float
    axes: NDArray[np.float64]
    probability: float
    visible_fraction: float | None
    views: int
    color: NDArray[np.uint8]
    kind: FruitKind
    members: NDArray[np.int64]
    fallen: bool | None = None
    tree: int | None = None

    @property
    def lengths(self) -> NDArray[np.float64]:
        """(3,) length, width and thickness, scene units."""
        return 2.0 * np.linalg.norm(self.axes, axis=1)


def member_ids(count: int, fruits: Sequence[Fruit]) -> NDArray[np.int32]:
    """(N,) the id of the fruit that each of `count` Gaussians belongs to, -1 for none."""
    ids = np.full(count, -1, np.int32)
    for fruit in fruits:
        ids[fruit.members] = fruit.id
    return ids


@dataclass(frozen=True, eq=False)
class Tree:
    """One tree of a row. number: from 1 along the row; position: (3,) in the scene frame; count: of its fruit;
    interval, likely, total, total_interval, other_fruit: as in `FruitCount`, for the fruit of this tree."""

    number: int
    position: NDArray[np.float64]
    count: int
    interval: tuple[int, int] | None = None
    likely: float | None = None
    total: float | None = None
    total_interval: tuple[int, int] | None = None
    other_fruit: int = 0


@dataclass(frozen=True)
class AuditEntry:
    """Why one cluster of selected points became fruit, several fruit, or none.

    diameter: of its fruit, the mean of several, or the size that was searched for, scene units; None without one.
    reason contains no length, because the unit may become known later.
    """

    cluster: int
    verdict: Verdict
    reason: str
    center: tuple[float, float, float]
    points: int
    fruit_ids: tuple[int, ...] = ()
    diameter: float | None = None


@dataclass(frozen=True, eq=False)
class FruitCount:
    """The fruit of one prompt in one scene.

    count: visible fruit = len(fruits); interval, total_interval: low and high of 90 % intervals of the visible fruit
    and of all fruit; likely, total: most likely numbers of the visible fruit and of all fruit, hidden ones included;
    None if the method gives no interval; trees: those of the row, if requested; notices: what the user should know;
    mean_diameter: scene units, None without fruit; last_id: the highest id that this and earlier counts of the scene
    gave; max_probability: the highest of any Gaussian; points, point_fruit_ids: (P, 3) and (P,) the sampled surface
    points with the id of their fruit (-1 none); point_colors: (P, 3) uint8 sRGB; pixel_width: median width of the fruit
    in pixels of the photos as they were read, None if it is not known; other_fruit: number of fruit of other kinds, if
    these are at least as many as the count, so that the encoder may have taken fruit of the prompt for them, else 0;
    other_colors: number of fruit that were not counted because of their color.
    """

    fruits: Sequence[Fruit]
    audit: Sequence[AuditEntry]
    max_probability: float
    mean_diameter: float | None
    last_id: int = 0
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    point_colors: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    point_fruit_ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    interval: tuple[int, int] | None = None
    likely: float | None = None
    total: float | None = None
    total_interval: tuple[int, int] | None = None
    trees: Sequence[Tree] = ()
    notices: Sequence[str] = ()
    pixel_width: float | None = None
    other_fruit: int = 0
    other_colors: int = 0

    @property
    def count(self) -> int:
        return len(self.fruits)

    @property
    def hanging(self) -> int | None:
        """Fruit that do not lie on the ground; None if no ground is visible."""
        return self._count_known(False)

    @property
    def fallen(self) -> int | None:
        """Fruit on the ground; None if no ground is visible."""
        return self._count_known(True)

    def _count_known(self, fallen: bool) -> int | None:
        known = [fruit.fallen for fruit in self.fruits if fruit.fallen is not None]
        return known.count(fallen) if known else None

    @property
    def centers(self) -> NDArray[np.float64]:
        """(F, 3) the centres of the fruit, in the scene frame."""
        return np.array([fruit.center for fruit in self.fruits], dtype=np.float64).reshape(-1, 3)

    @property
    def diameters(self) -> NDArray[np.float64]:
        """(F,) the diameters of the fruit, scene units."""
        return np.array([fruit.diameter for fruit in self.fruits], dtype=np.float64)
