"""Time and memory of counting by number of points: simulated crowns above each other, with rendered views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...engine.config import CountConfig
from ...engine.counting.accounts.audit import account_for
from ...engine.counting.accounts.describe import describe
from ...engine.counting.accounts.ids import number
from ...engine.counting.accounts.interval import estimate, gather_evidence
from ...engine.counting.evidence.cluster import Clusters, Search, find_fruit, search
from ...engine.counting.evidence.surface_points import LARGEST_SCALE, sample_surface
from ...engine.counting.evidence.visibility import Picture, Visibility, draw, find_visibility, gather_view_evidence
from ...engine.counting.regions.ground import find_fallen
from ...engine.counting.sizing import fruit_size, select_gaussians
from ...engine.errors import CountingError
from ...engine.progress import Progress, part, silent
from ...engine.splatting.gaussians import Gaussians
from ..stopwatch import Stage, Stopwatch
from .simulated import SETTINGS, simulate

CROWN, SEED = "clumped", 1001
POINTS = 1_000_000
"""Points of a crown; larger numbers use several crowns."""
YIELD = 1.26
"""Points that a budget of one gives."""
SPACING = 200.0
"""Distance between crowns, in mean diameters: no view of one shows another."""
UP = np.array([0.0, 0.0, 1.0])
"""Away from the ground."""


@dataclass(frozen=True, eq=False)
class Stack:
    """Crowns above each other: their Gaussians with probability (N,), visibility, and rendered views."""

    gaussians: Gaussians
    probability: NDArray[np.float64]
    visibility: Visibility
    pictures: list[Picture]

    @property
    def seen(self) -> NDArray[np.int64]:
        """Which Gaussians may be fruit and are visible."""
        selected = select_gaussians(self.gaussians, self.probability, CountConfig())
        return selected[self.visibility.weights[selected] > 0]

    def repeat(self, crowns: int) -> Stack:
        shifts = SPACING * torch.arange(crowns)[:, None, None] * torch.tensor([0.0, 0.0, 1.0])
        means = (self.gaussians.means + shifts).reshape(-1, 3)
        index = torch.arange(len(self.gaussians)).repeat(crowns)
        seen, own = self.visibility, index.numpy()
        return Stack(
            replace(self.gaussians.select(index), means=means),
            np.tile(self.probability, crowns),
            Visibility(seen.weights[own], seen.views[own], seen.directions[own], seen.frame),
            [_move_picture(picture, crown * SPACING) for crown in range(crowns) for picture in self.pictures],
        )


def make_crown() -> Stack:
    """Make a crown as its 36 cameras show it."""
    simulation = simulate(SETTINGS[CROWN], SEED)
    probabilities = simulation.probability.double().numpy()
    visibility = find_visibility(simulation.gaussians, simulation.cameras)
    return Stack(
        simulation.gaussians, probabilities, visibility, draw(simulation.gaussians, probabilities, simulation.cameras)
    )


def measure_counting(numbers: Sequence[int], *, progress: Progress = silent) -> list[Stage]:
    """Count in about this many points each, from the size of the fruit to their description."""
    if min(numbers) < 1:
        raise CountingError("--counting: give numbers of points from 1 on")
    crown = make_crown()
    _time_stages(crown, 20_000, silent)  # compiles
    return [
        row
        for place, points in enumerate(numbers)
        for row in _time_stages(
            crown.repeat(-(-points // POINTS)),
            points,
            part(progress, place / len(numbers), (place + 1) / len(numbers)),
        )
    ]


def _time_stages(stack: Stack, wanted: int, progress: Progress) -> list[Stage]:
    watch, config, seen = Stopwatch(), CountConfig(), stack.seen
    with watch.running():
        with watch.stage("size"):
            size = fruit_size(stack.gaussians, stack.probability, stack.visibility, seen, config)
        assert size is not None
        with watch.stage("points"):
            points = sample_surface(
                stack.gaussians, stack.probability, stack.visibility, seen,
                budget=max(1, round(wanted / YIELD)), seed=config.seed, largest=LARGEST_SCALE * size.diameter,
            )  # fmt: skip
        with watch.stage("fruit"):
            searched = search(points, size, stack.pictures, config.threshold, progress=progress)
            fruit = find_fruit(searched)
        _tell(stack, fruit, searched, config, watch)
    return watch.rows(f"{len(points):,} points, {len(fruit.spheres):,} fruit")


def _tell(stack: Stack, fruit: Clusters, searched: Search, config: CountConfig, watch: Stopwatch) -> None:
    """The steps of `count_fruit` after the search."""
    centers, radii = fruit.spheres.centers, fruit.spheres.radii
    with watch.stage("account"):
        numbers = number(centers, np.arange(len(centers)), float(2.0 * radii.mean()))
        account = account_for(fruit, numbers)
    with watch.stage("describe"):
        view_evidence = gather_view_evidence(stack.pictures, centers, radii, config.threshold)
        describe(stack.gaussians, stack.seen, fruit, numbers, account.compound, view_evidence, "apple")
    with watch.stage("ground"):
        others = stack.gaussians.select(torch.from_numpy(np.flatnonzero(stack.probability < config.threshold)))
        find_fallen(others, [picture.camera for picture in stack.pictures], centers, 2.0 * radii, UP)
    with watch.stage("interval"):
        everywhere = np.ones(len(searched.found))
        estimate(gather_evidence(searched, everywhere, stack.pictures, seed=config.seed), len(centers))


def _move_picture(picture: Picture, along: float) -> Picture:
    """Return the picture of a crown that hangs higher, along z."""
    pose = picture.camera.world_to_camera.copy()
    pose[:3, 3] -= pose[:3, 2] * along
    return replace(picture, camera=replace(picture.camera, world_to_camera=pose))
