"""The two Fuji data sets, read from tiny folders built as they are published."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.evaluation.datasets.fuji import read_fuji_cloud, read_fuji_truth
from fruitlangs.engine.evaluation.datasets.pfuji import read_pfuji
from fruitlangs.engine.evaluation.datasets.sphere_fit import fit_sphere

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2.0


def box(folder: Path, name: str, center: list[float], sides: list[float], rows: int = 9) -> Path:
    """A box file: its middle and 8 corners, or the corners alone."""
    path = folder / "3-3D_data" / "GroundTruth-3D_apples_locations" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    corners = np.array(center) + CORNERS * sides
    np.savetxt(path, np.vstack([[center], corners])[9 - rows :], fmt="%.6f")
    return path


@pytest.fixture
def row(tmp_path: Path) -> Path:
    """Two apples of tree 2 and one of tree 10, in two sets, with a cloud of three points."""
    box(tmp_path, "training_set/Tree10-annotations_000001.txt", [11.6, 74.0, 311.0], [0.08, 0.08, 0.08])
    box(tmp_path, "test_set/Tree02-annotations_000007.txt", [11.5, 68.2, 310.0], [0.06, 0.09, 0.09])
    box(tmp_path, "test_set/Tree02-annotations_000003.txt", [11.5, 68.0, 309.0], [0.07, 0.07, 0.07], rows=8)
    points = "11.5\t68.0\t309.0\t200\t30\t20\n11.6\t68.1\t309.1\t10\t120\t30\n11.7\t68.2\t309.2\t0\t0\t255\n"
    (tmp_path / "3-3D_data" / "Fuji_apple_trees_point_cloud.txt").write_text(points)
    return tmp_path


def test_fuji_boxes_give_centre_diameter_and_tree(row: Path) -> None:
    imported = read_fuji_truth(row)
    assert imported.truth.trees is not None
    assert imported.truth.trees.tolist() == [2, 2, 10]
    assert imported.names == ("Tree02_000003", "Tree02_000007", "Tree10_000001")
    assert np.allclose(imported.truth.centers, [[11.5, 68.0, 309.0], [11.5, 68.2, 310.0], [11.6, 74.0, 311.0]])
    assert imported.truth.diameters == pytest.approx([0.07, 0.08, 0.08])
    assert imported.truth.visible.all()


def test_fuji_folder_may_be_given_at_its_space_part(row: Path) -> None:
    assert len(read_fuji_truth(row / "3-3D_data").names) == 3


def test_fuji_cloud_keeps_places_and_colours(row: Path) -> None:
    cloud = read_fuji_cloud(row)
    assert cloud.points[1].tolist() == [11.6, 68.1, 309.1]
    assert cloud.colors[2].tolist() == [0, 0, 255]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("1 2 3\n4 5 6\n", "2 rows"),
        ("1 2\n" * 9, "2 columns"),
        ("1 2 nan\n" * 9, "not finite"),
        ("x y z\n", "not a table"),
        ("", "is empty"),
        ("1 2 3\n" * 9, "flat"),
    ],
)
def test_a_bad_box_names_its_file_and_what_is_expected(content: str, said: str, row: Path) -> None:
    path = box(row, "test_set/Tree03-annotations_000001.txt", [0, 0, 0], [1, 1, 1])
    path.write_text(content)
    with pytest.raises(FormatError, match=said) as caught:
        read_fuji_truth(row)
    assert path.name in str(caught.value)
    assert "8 corners" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_a_box_whose_first_row_is_not_its_middle_is_refused(row: Path) -> None:
    path = box(row, "test_set/Tree03-annotations_000001.txt", [0, 0, 0], [1, 1, 1])
    rows = np.loadtxt(path)
    np.savetxt(path, np.vstack([[5.0, 5.0, 5.0], rows[1:]]))
    with pytest.raises(FormatError, match="outside the box"):
        read_fuji_truth(row)


def test_an_apple_in_both_sets_is_refused(row: Path) -> None:
    box(row, "test_set/Tree10-annotations_000001.txt", [11.6, 74.0, 311.0], [0.08, 0.08, 0.08])
    with pytest.raises(FormatError, match="two sets"):
        read_fuji_truth(row)


def test_a_folder_without_boxes_says_what_belongs_there(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="Tree01-annotations"):
        read_fuji_truth(tmp_path)


def shell(center: list[float], diameter: float, *, count: int = 600, seed: int = 0, noise: float = 0.0) -> np.ndarray:
    """(count, 3) points of the side of a sphere that looks along -x, and a quarter as many on a leaf across it."""
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 0] = -np.abs(directions[:, 0])
    surface = np.array(center) + 0.5 * diameter * directions + noise * generator.normal(size=(count, 3))
    leaf = np.array(center) + diameter * (generator.random((count // 4, 3)) - 0.5) * [0.02, 1, 1]
    leaf[:, 0] -= 0.6 * diameter
    return np.vstack([surface, leaf])


def apple(folder: Path, name: str, points: np.ndarray) -> Path:
    """A scanned apple: x y z r g b, three scalars, a normal; every point confirmed by three photos."""
    path = folder / "3-apple_point_clouds" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    rest = np.tile([200, 40, 30, 0, 3, 1, 0.6, 0.8, 0], (len(points), 1))
    np.savetxt(path, np.hstack([points, rest]), fmt=["%.8f"] * 3 + ["%d"] * 3 + ["%.6f"] * 6)
    return path


@pytest.fixture
def orchard(tmp_path: Path) -> Path:
    """Two apples of one part and one of another, all in the table."""
    apple(tmp_path, "2018_01_001.txt", shell([0.1, 0.2, 1.0], 0.080))
    apple(tmp_path, "2018_01_004.txt", shell([0.4, 0.2, 1.5], 0.070, seed=1))
    apple(tmp_path, "2020_01_001.txt", shell([0.1, 0.2, 1.0], 0.060, seed=2))
    table = "2018_01_001.txt,80.0\n2018_01_004.txt,70\n2020_01_001.txt,60.5\n"
    (tmp_path / "4-apples_GT_diameter.txt").write_text(table)
    return tmp_path


def test_pfuji_takes_diameters_from_the_table_and_centres_from_the_points(orchard: Path) -> None:
    apples = read_pfuji(orchard, "2018_01")
    assert apples.truth.names == ("2018_01_001", "2018_01_004")
    assert apples.truth.truth.diameters.tolist() == [0.08, 0.07]
    assert np.abs(apples.truth.truth.centers - [[0.1, 0.2, 1.0], [0.4, 0.2, 1.5]]).max() < 0.001
    assert apples.fitted_diameters == pytest.approx([0.08, 0.07], rel=0.02)
    assert apples.cloud.colors[0].tolist() == [200, 40, 30]
    assert len(apples.cloud.points) == 1500


def test_pfuji_trusts_points_that_more_than_one_photo_confirms(orchard: Path) -> None:
    path = orchard / "3-apple_point_clouds" / "2018_01_001.txt"
    rows = np.loadtxt(path)
    strays = np.tile(rows, (4, 1))
    strays[:, :3], strays[:, 7] = shell([0.3, 0.2, 1.0], 0.080, count=4 * 600, seed=9), 1.0
    np.savetxt(path, np.vstack([rows, strays]))
    assert np.abs(read_pfuji(orchard, "2018_01").truth.truth.centers[0] - [0.1, 0.2, 1.0]).max() < 0.001


def test_an_apple_outside_the_table_has_its_fitted_diameter_and_a_remark(orchard: Path) -> None:
    (orchard / "4-apples_GT_diameter.txt").write_text("name,diameter (mm)\n2018_01_001.txt,80.0\n")
    apples = read_pfuji(orchard, "2018_01")
    assert apples.measured.tolist() == [True, False]
    assert apples.truth.truth.diameters == pytest.approx([0.08, 0.07], rel=0.02)
    assert "1 of 2 apples are not in" in apples.truth.remarks[0]


def test_parts_in_different_frames_are_never_mixed(orchard: Path) -> None:
    with pytest.raises(FormatError, match="2018_01, 2020_01"):
        read_pfuji(orchard)
    with pytest.raises(FormatError, match="no part 2019_01"):
        read_pfuji(orchard, "2019_01")


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("2018_01_001.txt,eighty\n2018_01_004.txt,70\n" * 2, "line 3"),
        ("2018_01_001.txt,80\n2018_01_004.txt,nan\n", "line 2"),
        ("2018_01_001.txt,80\n2018_01_004.txt\n", "line 2"),
        ("2018_01_001.txt,-80\n", "line 1"),
        ("2018_01_001.txt,80\n2018_01_001.txt,81\n", "second diameter"),
        ("", "lists no apple"),
    ],
)
def test_a_bad_table_of_diameters_names_its_line(table: str, said: str, orchard: Path) -> None:
    (orchard / "4-apples_GT_diameter.txt").write_text(table)
    with pytest.raises(FormatError, match=said) as caught:
        read_pfuji(orchard, "2018_01")
    assert "4-apples_GT_diameter.txt" in str(caught.value)


def test_points_that_fix_no_sphere_name_their_apple(orchard: Path) -> None:
    apple(orchard, "2018_01_001.txt", np.zeros((100, 3)))
    with pytest.raises(FormatError, match=r"2018_01_001\.txt: its 100 points fix no sphere"):
        read_pfuji(orchard, "2018_01")


def test_half_seen_spheres_next_to_a_leaf_are_found_with_and_without_their_radius() -> None:
    center = [3.0, -2.0, 1.0]
    for seed in range(30):
        points = shell(center, 0.08, seed=seed, noise=0.002)
        free, known = fit_sphere(points), fit_sphere(points, 0.04)
        assert free is not None
        assert known is not None
        assert free.radius == pytest.approx(0.04, rel=0.1)
        assert known.radius == 0.04
        assert np.linalg.norm(known.center - center) < 0.002


def test_a_measured_diameter_steadies_the_centre_of_a_small_cap() -> None:
    errors = []
    for seed in range(20):
        points = shell([0.0, 0.0, 0.0], 0.08, count=4000, seed=seed, noise=0.003)[:4000]
        cap = points[points[:, 0] < -0.028]
        free, known = fit_sphere(cap), fit_sphere(cap, 0.04)
        assert free is not None
        assert known is not None
        errors.append([np.linalg.norm(free.center), np.linalg.norm(known.center)])
    medians = np.median(errors, axis=0)
    assert medians[1] < 0.005
    assert medians[0] > 1.3 * medians[1]
