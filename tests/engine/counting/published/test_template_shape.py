"""Templates of a fruit: from meshes and point clouds of any size, from a scene, and files that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.published.template_shape import ball, cut_template, read_template
from fruitlangs.engine.errors import ConfigError, FormatError

BALL = np.pi / 6.0
"""Volume of a sphere of one diameter."""


def pear(size: float = 1.0) -> trimesh.Trimesh:
    body = trimesh.creation.icosphere(subdivisions=4)
    body.vertices[:, 2] *= np.where(body.vertices[:, 2] > 0, 1.8, 1.0)
    body.apply_scale(size)
    body.apply_translation([5.0, -3.0, 2.0])
    return body


def test_a_ball_has_the_volume_of_a_sphere_of_one_diameter() -> None:
    assert ball().volume == pytest.approx(BALL, rel=0.05)
    np.testing.assert_allclose(np.linalg.norm(ball().points, axis=1), 0.5)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb", ".stl"])
@pytest.mark.parametrize("size", [0.01, 40.0])
def test_a_mesh_of_any_size_and_place_becomes_one_diameter_about_its_middle(
    tmp_path: Path, suffix: str, size: float
) -> None:
    pear(size).export(tmp_path / f"pear{suffix}")
    template = read_template(tmp_path / f"pear{suffix}")
    assert template.volume == pytest.approx(BALL, rel=0.07)
    assert np.linalg.norm(template.points.mean(axis=0)) < 0.15
    longest = np.sort(np.ptp(template.points, axis=0))
    assert longest[2] / longest[0] == pytest.approx(1.4, rel=0.05)


def test_points_lie_evenly_over_a_mesh_whose_faces_do_not(tmp_path: Path) -> None:
    pear().export(tmp_path / "pear.ply")
    points = read_template(tmp_path / "pear.ply").points
    gaps = np.linalg.norm(points[:, None] - points, axis=2) + 9.0 * np.eye(len(points))
    assert gaps.min(axis=1).min() > 0.5 * np.median(gaps.min(axis=1))


def test_a_point_cloud_of_the_surface_is_a_template(tmp_path: Path) -> None:
    trimesh.PointCloud(pear(0.08).sample(3000)).export(tmp_path / "pear.ply")
    template = read_template(tmp_path / "pear.ply")
    assert template.volume == pytest.approx(BALL, rel=0.07)
    assert np.sort(np.ptp(template.points, axis=0))[2] > 1.2


def test_a_seed_is_one_template(tmp_path: Path) -> None:
    pear().export(tmp_path / "pear.obj")
    first, again, other = (read_template(tmp_path / "pear.obj", seed=seed).points for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_fruit_cut_out_of_a_scene_keeps_its_size() -> None:
    points = 0.6 * trimesh.creation.icosphere(subdivisions=3).vertices + 7.0
    template = cut_template(points)
    assert np.linalg.norm(template.points, axis=1).mean() == pytest.approx(0.6, rel=0.01)
    assert template.volume == pytest.approx(4.0 / 3.0 * np.pi * 0.6**3, rel=0.06)


def test_a_missing_file_is_an_error_that_names_the_flag(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--count\.template .*none\.obj does not exist"):
        read_template(tmp_path / "none.obj")


def test_a_mesh_with_a_hole_is_refused(tmp_path: Path) -> None:
    body = pear()
    body.update_faces(np.arange(len(body.faces)) > 3)
    body.export(tmp_path / "pear.obj")
    with pytest.raises(FormatError, match=r"pear\.obj is a mesh with a hole"):
        read_template(tmp_path / "pear.obj")


def test_a_mesh_without_volume_is_refused(tmp_path: Path) -> None:
    flat = trimesh.creation.box((1.0, 1.0, 1e-5))
    flat.export(tmp_path / "flat.ply")
    with pytest.raises(FormatError, match=r"flat\.ply holds no volume"):
        read_template(tmp_path / "flat.ply")


def test_points_in_a_plane_are_refused(tmp_path: Path) -> None:
    sheet = np.random.default_rng(0).random((100, 3)) * [1.0, 1.0, 0.0]
    trimesh.PointCloud(sheet).export(tmp_path / "sheet.ply")
    with pytest.raises(FormatError, match=r"sheet\.ply holds no volume"):
        read_template(tmp_path / "sheet.ply")


def test_too_few_points_are_refused(tmp_path: Path) -> None:
    trimesh.PointCloud(np.random.default_rng(0).random((9, 3))).export(tmp_path / "few.ply")
    with pytest.raises(FormatError, match=r"few\.ply has 9 points"):
        read_template(tmp_path / "few.ply")


def test_a_coordinate_that_is_no_number_is_refused(tmp_path: Path) -> None:
    lines = ["nan 0 0", *(" ".join(map(str, point)) for point in np.random.default_rng(0).random((99, 3)))]
    (tmp_path / "bad.xyz").write_text("\n".join(lines))
    with pytest.raises(FormatError, match=r"bad\.xyz holds coordinates that are not finite"):
        read_template(tmp_path / "bad.xyz")


@pytest.mark.parametrize("name", ["note.txt", "photo.jpg", "broken.ply", "broken.glb", "empty.obj"])
def test_a_file_that_is_no_shape_is_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("" if name == "empty.obj" else "not a shape\nat all\n")
    with pytest.raises(FormatError, match=name.replace(".", r"\.")) as caught:
        read_template(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_template_without_a_method_that_uses_it_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"--count\.template needs --count\.method template or fruitnerf"):
        CountConfig(template="pear.obj")
    assert CountConfig(template="pear.obj", method="template").template == "pear.obj"
