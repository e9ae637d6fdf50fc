"""Surface points, compared with brute force."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fruitlangs.engine.counting.evidence import surface_points
from fruitlangs.engine.counting.evidence.surface_points import SURFACE, SurfacePoints, sample_surface
from fruitlangs.engine.counting.evidence.visibility import Visibility
from fruitlangs.engine.splatting.gaussians import Gaussians


def gaussians(count: int = 60) -> Gaussians:
    """Many in a small place, so that they lie inside each other."""
    rng = np.random.default_rng(3)
    return Gaussians(
        means=torch.from_numpy(rng.uniform(-1.0, 1.0, (count, 3))).float(),
        log_scales=torch.from_numpy(np.log(rng.uniform(0.05, 0.8, (count, 3)))).float(),
        quats=torch.from_numpy(rng.standard_normal((count, 4))).float(),
        opacity_logits=torch.from_numpy(rng.uniform(-2.0, 4.0, count)).float(),
        sh=torch.zeros((count, 1, 3)),
    )


def sampled(chosen: Gaussians, budget: int = 3000) -> SurfacePoints:
    n = len(chosen)
    nowhere = np.zeros((3, 4))  # so that the same is drawn wherever the Gaussians are
    seen = Visibility(np.ones(n), np.ones(n, np.int64), np.zeros((n, 3)) + [0.0, 0.0, 1.0], nowhere)
    return sample_surface(chosen, np.ones(n), seen, np.arange(n), budget=budget, seed=5)


def own_distances(chosen: Gaussians, positions: np.ndarray) -> np.ndarray:
    """(P, G) distance of each point from each Gaussian, in its standard deviations."""
    offsets = positions[:, None] - chosen.means.double().numpy()
    axes, scales = chosen.rotations.double().numpy(), chosen.scales.double().numpy()
    return np.linalg.norm(np.einsum("gij,pgi->pgj", axes, offsets) / scales, axis=2)


def test_points_lie_on_their_gaussians_surface_and_outside_all_others():
    chosen = gaussians()
    points = sampled(chosen)
    distances = own_distances(chosen, points.positions)
    assert len(points) > 200
    assert distances[np.arange(len(points)), points.gaussians] == pytest.approx(np.full(len(points), SURFACE), abs=1e-4)
    opacities = chosen.opacities.double().numpy() * np.exp(-0.5 * distances**2)
    assert opacities.max() <= 0.5 + 1e-4


def test_no_point_outside_all_gaussians_is_left_out():
    chosen = gaussians()
    far = Gaussians(
        means=chosen.means + 20.0 * torch.arange(len(chosen))[:, None],
        log_scales=chosen.log_scales,
        quats=chosen.quats,
        opacity_logits=chosen.opacity_logits,
        sh=chosen.sh,
    )
    alone, together = sampled(far), sampled(chosen)
    shift = 20.0 * alone.gaussians[:, None]
    opacities = chosen.opacities.double().numpy()
    hidden = (opacities * np.exp(-0.5 * own_distances(chosen, alone.positions - shift) ** 2)).max(axis=1) > 0.5
    assert hidden.any()
    assert len(together) == np.count_nonzero(~hidden)


def test_how_many_points_are_tried_at_once_changes_none_of_them(monkeypatch: pytest.MonkeyPatch):
    chosen = gaussians()
    whole = sampled(chosen)
    monkeypatch.setattr(surface_points, "BLOCK", 997)
    parts = sampled(chosen)
    assert np.array_equal(parts.positions, whole.positions)
    assert np.array_equal(parts.gaussians, whole.gaussians)
