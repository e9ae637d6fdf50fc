"""Audit and description of clusters and fruit, compared with a plain implementation that tests every point for every
fruit."""

from __future__ import annotations

import numpy as np
import pytest

from fruitlangs.engine.counting.accounts.audit import account_for
from fruitlangs.engine.counting.accounts.describe import MEMBER_REACH, nearest_sphere
from fruitlangs.engine.counting.evidence.claims import commonest
from fruitlangs.engine.counting.evidence.cluster import Clusters
from fruitlangs.engine.counting.evidence.surface_points import SurfacePoints
from fruitlangs.engine.counting.geometry.random_streams import even_turns
from fruitlangs.engine.counting.geometry.sphere import Spheres

FRUIT, POINTS = 40, 3000


def clusters(seed: int) -> Clusters:
    """Points of FRUIT fruit in 30 clusters of any size, most of a fruit's points in one, some without a fruit."""
    random = np.random.default_rng(seed)
    positions, count = random.normal(0.0, 3.0, (POINTS, 3)), np.ones(FRUIT)
    owners = random.integers(-30, FRUIT, POINTS).clip(-1)
    homes = random.integers(0, 25, FRUIT + 1)
    components = np.where(random.random(POINTS) < 0.8, homes[owners], random.geometric(0.1, POINTS).clip(1, 30) - 1)
    return Clusters(
        points=SurfacePoints(positions, positions, np.arange(POINTS), np.ones(POINTS), positions, even_turns(POINTS)),
        spheres=Spheres(random.normal(size=(FRUIT, 3)), *(count * random.uniform(0.2, 0.9) for _ in range(8))),
        owners=owners,
        components=components,
        probabilities=count,
        refusals={},
    )


@pytest.mark.parametrize("seed", range(5))
def test_every_cluster_has_the_centre_points_and_fruit_that_the_plain_way_gives(seed: int) -> None:
    found, numbers = clusters(seed), np.random.default_rng(seed).permutation(FRUIT) + 7
    account = account_for(found, numbers)
    homes = np.array([np.bincount(found.components[found.owners == fruit]).argmax() for fruit in range(FRUIT)])
    assert account.compound.tolist() == [(homes == home).sum() > 1 for home in homes]
    told = {entry.cluster: entry for entry in account.entries if entry.cluster <= found.components.max()}
    assert set(homes) <= set(told)
    for component, entry in told.items():
        inside = found.components == component
        assert entry.points == inside.sum()
        assert entry.center == tuple(found.points.positions[inside].mean(axis=0))
        if entry.verdict in ("kept", "split"):
            assert entry.fruit_ids == tuple(sorted(numbers[homes == component]))
    dust = np.flatnonzero(~np.isin(np.arange(found.components.max() + 1), list(told)))
    assert sum(entry.points for entry in account.entries) == POINTS
    assert all((found.components == component).sum() < 20 for component in dust)


def test_a_fruit_without_points_is_one_that_photos_show() -> None:
    found = clusters(0)
    found.owners[found.owners == 3] = -1
    entry = next(entry for entry in account_for(found, np.arange(FRUIT) + 7).entries if entry.fruit_ids == (3 + 7,))
    assert entry.reason.startswith("seen in the photos only")
    assert (entry.verdict, entry.points) == ("kept", 0)


@pytest.mark.parametrize("seed", range(5))
def test_every_gaussian_has_the_sphere_that_the_plain_way_gives_it(seed: int) -> None:
    random = np.random.default_rng(seed)
    means, centers, radii = random.normal(size=(2000, 3)), random.normal(size=(60, 3)), random.uniform(0.1, 0.6, 60)
    means[:60], centers[1], radii[1] = centers, centers[0], radii[0]  # one sphere twice: the first has the Gaussians
    relative = np.stack([np.linalg.norm(means - c, axis=1) / r for c, r in zip(centers, radii, strict=True)], axis=1)
    expected = np.where(relative.min(axis=1) < MEMBER_REACH, relative.argmin(axis=1), -1)
    np.testing.assert_array_equal(nearest_sphere(means, centers, radii), expected)
    assert len(np.unique(expected)) > 50


def test_without_gaussians_or_spheres_nothing_is_near() -> None:
    assert nearest_sphere(np.zeros((0, 3)), np.zeros((2, 3)), np.ones(2)).tolist() == []
    assert nearest_sphere(np.zeros((2, 3)), np.zeros((0, 3)), np.ones(0)).tolist() == [-1, -1]


def test_of_numbers_that_are_as_common_the_least_is_the_commonest() -> None:
    assert commonest(np.array([9, 4, 4, 9, 5])) == 4
