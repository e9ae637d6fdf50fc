"""Fuji-SfM (Gené-Mola et al. 2020): a row of 11 apple trees as a coloured cloud, with a box around every apple."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError
from ..number_table import read_numbers
from .cloud import ColoredCloud, cloud_of
from .imported import ImportedTruth, assume_visible

FloatArray = NDArray[np.float64]

LAYOUT = "fuji-sfm"
SPACE = "3-3D_data"
CLOUD = "Fuji_apple_trees_point_cloud.txt"
BOXES = "GroundTruth-3D_apples_locations"

_BOX_FILE = re.compile(r"Tree(\d+)-annotations_(\d+)\.txt")
_CORNERS = 8


def read_fuji_truth(folder: Path) -> ImportedTruth:
    """Read the box of every apple below `3-3D_data/GroundTruth-3D_apples_locations`, of both sets.

    A box is `TreeNN-annotations_NNNNNN.txt`: x y z of its middle, then of its 8 corners (the middle may be missing). An
    apple's centre is the mean of the corners, its diameter the mean side of the box, which was drawn by hand and is not
    a calliper measurement. folder: `Fuji-SfM_dataset`, or its `3-3D_data`.

    Raises:
        FormatError: the folder has no boxes, or a file is not such a box.
    """
    boxes = _space(folder) / BOXES
    found = [(path, _BOX_FILE.fullmatch(path.name)) for path in boxes.rglob("*.txt")] if boxes.is_dir() else []
    named = sorted((int(name[1]), int(name[2]), path) for path, name in found if name is not None)
    if not named:
        raise FormatError(f"{boxes}: holds no box. Expected training_set/ and test_set/ with Tree01-annotations_*.txt")
    repeated = next((path for before, path in pairwise(named) if before[:2] == path[:2]), None)
    if repeated is not None:
        raise FormatError(f"{repeated[2]}: the same apple stands in two sets. Expected each box once")
    corners = np.stack([_corners(path) for _, _, path in named])
    sides = np.ptp(corners, axis=1)
    return ImportedTruth(
        layout=LAYOUT,
        label="apple",
        truth=assume_visible(corners.mean(axis=1), sides.mean(axis=1), np.array([tree for tree, _, _ in named])),
        names=tuple(f"Tree{tree:02d}_{number:06d}" for tree, number, _ in named),
        metres_per_unit=1.0,
        remarks=(
            "diameters are mean sides of hand-drawn boxes",
            f"the frame is that of {CLOUD}; photos need --transform",
        ),
    )


def read_fuji_cloud(folder: Path) -> ColoredCloud:
    """Read the coloured cloud of the row, in the frame of the boxes; 10.9 million points take a minute.

    Raises:
        FormatError: the file is missing or no table of points.
    """
    return cloud_of(read_numbers(_space(folder) / CLOUD, columns=6, expected="x y z red green blue"))


def _space(folder: Path) -> Path:
    return folder / SPACE if (folder / SPACE).is_dir() else folder


def _corners(path: Path) -> FloatArray:
    """(8, 3) corners of a box file."""
    expected = "x y z of a box's middle and its 8 corners"
    rows = read_numbers(path, columns=3, expected=expected)[:, :3]
    if len(rows) not in (_CORNERS, _CORNERS + 1):
        raise FormatError(f"{path}: has {len(rows)} rows. Expected {expected}")
    corners = rows[-_CORNERS:]
    sides = np.ptp(corners, axis=0)
    if not (sides > 0.0).all():
        raise FormatError(f"{path}: its box is flat. Expected {expected}")
    if len(rows) > _CORNERS and (np.abs(rows[0] - corners.mean(axis=0)) > 0.5 * sides).any():
        raise FormatError(f"{path}: its first row lies outside the box of the others. Expected {expected}")
    return corners
