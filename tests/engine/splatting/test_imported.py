"""Reconstructions of other programs: coloured points become Gaussians, and what is neither is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from clouds import grid, write_cloud
from splats import random_gaussians

from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.splatting.gaussians import PARAMETERS
from fruitlangs.engine.splatting.imported.read_ply import read_imported_ply
from fruitlangs.engine.splatting.ply import write_ply

ORANGE = np.array([1.0, 0.6, 0.2])


@pytest.mark.parametrize("text", [False, True], ids=["binary", "ascii"])
@pytest.mark.parametrize(("kind", "most"), [("u1", 255), ("i4", 255), ("u2", 65535), ("f4", 1), ("f8", 255)])
def test_points_of_any_type_keep_their_place_and_colour(tmp_path: Path, kind: str, most: int, text: bool) -> None:
    colors = np.tile(ORANGE * most, (1000, 1))
    imported = read_imported_ply(write_cloud(tmp_path / "c.ply", grid(), colors, kind=kind, place="f8", text=text))
    assert imported.kind == "points"
    np.testing.assert_allclose(np.sort(imported.gaussians.means.numpy(), axis=0), np.sort(grid(), axis=0), atol=1e-6)
    np.testing.assert_allclose(imported.gaussians.base_colors.numpy(), np.tile(ORANGE, (1000, 1)), atol=1e-5)
    assert float(imported.gaussians.opacities.min()) > 0.95


def cloud(tmp_path: Path, points: np.ndarray) -> Path:
    return write_cloud(tmp_path / "cloud.ply", points, np.full((len(points), 3), 90))


def test_a_gaussian_is_round_and_half_as_wide_as_the_points_are_apart(tmp_path: Path) -> None:
    scales = read_imported_ply(cloud(tmp_path, grid(spacing=0.1))).gaussians.scales
    torch.testing.assert_close(scales, torch.full((1000, 3), 0.05))


def test_doubled_points_count_once(tmp_path: Path) -> None:
    twice = read_imported_ply(cloud(tmp_path, np.concatenate([grid(), grid()]))).gaussians
    assert len(twice) == 1000
    torch.testing.assert_close(twice.scales, torch.full((1000, 3), 0.05))


def test_a_stray_point_stays_small(tmp_path: Path) -> None:
    scales = read_imported_ply(cloud(tmp_path, np.concatenate([grid(), [[50.0, 0.0, 0.0]]]))).gaussians.scales
    assert len(scales) == 1001
    assert float(scales.max()) <= 0.1 + 1e-6


def test_a_large_cloud_is_thinned_evenly_and_reported(tmp_path: Path) -> None:
    dense = np.random.default_rng(0).random((20_000, 3)) * [0.5, 1.0, 1.0]
    sparse = np.random.default_rng(1).random((2_000, 3)) * [0.5, 1.0, 1.0] + [0.5, 0.0, 0.0]
    imported = read_imported_ply(cloud(tmp_path, np.concatenate([dense, sparse])), most_points=3000)
    assert 2000 < len(imported.gaussians) <= 3000
    assert any("22,000" in notice and f"{len(imported.gaussians):,}" in notice for notice in imported.notices)
    left = int((imported.gaussians.means[:, 0] < 0.5).sum())
    assert left < 0.75 * len(imported.gaussians)  # of the cloud's points 0.91 lie there


def test_points_that_are_not_finite_are_left_out_and_reported(tmp_path: Path) -> None:
    points = grid()
    points[3, 1], points[7, 2] = np.nan, np.inf
    imported = read_imported_ply(cloud(tmp_path, points))
    assert len(imported.gaussians) == 998
    assert any("2 points" in notice for notice in imported.notices)


def test_gaussians_are_read_as_they_are(tmp_path: Path) -> None:
    gaussians = random_gaussians(40, 2)
    write_ply(tmp_path / "g.ply", gaussians)
    imported = read_imported_ply(tmp_path / "g.ply")
    assert imported.kind == "gaussians"
    for name in PARAMETERS:
        assert torch.equal(getattr(imported.gaussians, name), getattr(gaussians, name)), name


def no_points(path: Path) -> None:
    write_cloud(path, np.zeros((0, 3)), np.zeros((0, 3)))


def no_gaussians(path: Path) -> None:
    write_ply(path, random_gaussians(0, 0))


def no_colors(path: Path) -> None:
    write_cloud(path, grid(), None)


def only_nan(path: Path) -> None:
    write_cloud(path, np.full((1000, 3), np.nan), np.zeros((1000, 3)))


def nan_gaussians(path: Path) -> None:
    gaussians = random_gaussians(30, 0)
    gaussians.means[4, 0] = float("nan")
    write_ply(path, gaussians)


def a_box(path: Path) -> None:
    write_cloud(path, grid(side=2), np.zeros((8, 3)))


def one_place(path: Path) -> None:
    write_cloud(path, np.ones((5000, 3)), np.zeros((5000, 3)))


def cut_short(path: Path) -> None:
    write_cloud(path, grid(), np.zeros((1000, 3)))
    path.write_bytes(path.read_bytes()[:-100])


def far_away(path: Path) -> None:
    write_cloud(path, grid() + [500_000.0, 5_200_000.0, 300.0], np.zeros((1000, 3)), place="f8")


def nothing(path: Path) -> None:
    pass


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (no_points, "no points"),
        (no_gaussians, "no Gaussians"),
        (no_colors, "colours"),
        (only_nan, "finite"),
        (nan_gaussians, "NaN"),
        (a_box, "only 8 different points"),
        (one_place, "only 1 different point"),
        (cut_short, "cut short"),
        (far_away, "origin"),
        (nothing, "not there"),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_a_file_that_cannot_be_used_is_one_line_that_names_it(tmp_path: Path, make, says: str) -> None:
    make(tmp_path / "odd.ply")
    with pytest.raises(FormatError, match=says) as caught:
        read_imported_ply(tmp_path / "odd.ply")
    assert "odd.ply" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
