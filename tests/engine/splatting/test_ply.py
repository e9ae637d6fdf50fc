"""Gaussians as .ply: what is written comes back, and what is no such file is named."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from splats import random_gaussians

from fruitlangs.engine.errors import FormatError, OutputError
from fruitlangs.engine.splatting.gaussians import PARAMETERS
from fruitlangs.engine.splatting.ply import read_ply, read_vertices, write_ply


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_comes_back(tmp_path: Path, degree: int) -> None:
    gaussians = random_gaussians(17, degree)
    write_ply(tmp_path / "g.ply", gaussians)
    again = read_ply(tmp_path / "g.ply")
    for name in PARAMETERS:
        assert torch.equal(getattr(again, name), getattr(gaussians, name)), name


def test_the_layout_is_that_of_3dgs(tmp_path: Path) -> None:
    gaussians = random_gaussians(5, 1)
    write_ply(tmp_path / "g.ply", gaussians)
    vertices = PlyData.read(str(tmp_path / "g.ply"))["vertex"].data
    rest = [f"f_rest_{k}" for k in range(9)]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert list(vertices.dtype.names) == names
    # Channel by channel: the three red harmonics come first.
    assert vertices["f_rest_1"][4] == gaussians.sh[4, 2, 0]
    assert vertices["f_rest_3"][4] == gaussians.sh[4, 1, 1]


def test_no_gaussians_can_be_written_and_read(tmp_path: Path) -> None:
    write_ply(tmp_path / "g.ply", random_gaussians(0, 2))
    assert len(read_ply(tmp_path / "g.ply")) == 0


def test_many_gaussians_are_read_by_as_many_calls_as_few(tmp_path: Path) -> None:
    """Number by number 100,000 would take seven seconds and more."""

    def calls(count: int) -> int:
        write_ply(tmp_path / "g.ply", random_gaussians(count, 2))
        events: list[str] = []
        sys.setprofile(lambda frame, event, arg: events.append(event))
        try:
            read_vertices(tmp_path / "g.ply")
        finally:
            sys.setprofile(None)
        return len(events)

    calls(1)
    assert calls(2000) == pytest.approx(calls(20), rel=0.02)


def test_what_was_read_outlives_its_file(tmp_path: Path) -> None:
    written = random_gaussians(100, 2)
    write_ply(tmp_path / "g.ply", written)
    read = read_vertices(tmp_path / "g.ply")
    write_ply(tmp_path / "g.ply", random_gaussians(1, 0))
    np.testing.assert_array_equal(read.table["x"], written.means[:, 0].numpy())


def test_any_order_of_properties_is_read(tmp_path: Path) -> None:
    gaussians = random_gaussians(4, 1)
    write_ply(tmp_path / "g.ply", gaussians)
    ply = PlyData.read(str(tmp_path / "g.ply"))
    data = ply["vertex"].data
    order = list(reversed(data.dtype.names))
    ply["vertex"].data = np.array(data[order].tolist(), dtype=[(name, "f8") for name in order])
    ply.text = True
    ply.write(str(tmp_path / "other.ply"))
    torch.testing.assert_close(read_ply(tmp_path / "other.ply").sh, gaussians.sh)


@pytest.mark.parametrize("kept", [0.0, 0.02, 0.5, 0.99])
def test_a_cut_file_is_named(tmp_path: Path, kept: float) -> None:
    path = tmp_path / "cut.ply"
    write_ply(path, random_gaussians(50, 1))
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * kept)])
    with pytest.raises(FormatError, match=r"cut\.ply"):
        read_ply(path)


@pytest.mark.parametrize(
    "content", [b"", b"not a ply", b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n", b"\xff\xfe"]
)
def test_another_file_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "odd.ply").write_bytes(content)
    with pytest.raises(FormatError, match=r"odd\.ply"):
        read_ply(tmp_path / "odd.ply")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="not there"):
        read_ply(tmp_path / "none.ply")


def test_a_point_cloud_is_distinguished_from_gaussians(tmp_path: Path) -> None:
    header = (
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (tmp_path / "cloud.ply").write_text(header + "1 2 3\n")
    with pytest.raises(FormatError, match="opacity"):
        read_ply(tmp_path / "cloud.ply")


def test_nan_is_refused(tmp_path: Path) -> None:
    gaussians = random_gaussians(3, 0)
    gaussians.means[1, 1] = float("nan")
    write_ply(tmp_path / "g.ply", gaussians)
    with pytest.raises(FormatError, match="NaN"):
        read_ply(tmp_path / "g.ply")


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_ply(tmp_path / "file" / "g.ply", random_gaussians(3, 0))
