"""PFuji-Size (Gené-Mola et al. 2021): the scanned points of every apple, and its diameter by calliper."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError
from ..number_table import read_numbers
from .cloud import ColoredCloud, cloud_of
from .imported import ImportedTruth, assume_visible
from .sphere_fit import fit_sphere

FloatArray = NDArray[np.float64]

LAYOUT = "pfuji-size"
CLOUDS = "3-apple_point_clouds"
TABLE = "4-apples_GT_diameter.txt"
LEAST_TRUSTED = 50
"""Only points confirmed by more than one photo are used if there are this many of them."""

_CLOUD_FILE = re.compile(r"(\d+_\d+)_(\d+)\.txt")
_POINT = "x y z red green blue and further columns"
_ROW = "a cloud's file name and its diameter in millimetres"


@dataclass(frozen=True, eq=False)
class ScannedApples:
    """M apples of one part of the data set.

    truth: fruit with measured diameters; fitted_diameters: (M,) of a sphere fitted to each apple's points alone, in
    metres, NaN if they do not determine one; cloud: all their points; measured: (M,) whether the table lists the apple.
    """

    truth: ImportedTruth
    fitted_diameters: FloatArray
    cloud: ColoredCloud
    measured: NDArray[np.bool_]


def read_pfuji(folder: Path, part: str | None = None) -> ScannedApples:
    """Read the apples of one part, such as 2018_01: parts are other trees or another day, each in its own frame.

    An apple's diameter is the table's; its centre that of the sphere of this diameter through its points. An apple
    that is not in the table has the diameter of the sphere fitted to its points. folder: `PFuji-Size_dataset`.

    Raises:
        FormatError: a file is missing or malformed, the folder has no such part, or several and none is named, or the
            points of an apple fix no sphere.
    """
    files = _cloud_files(folder / CLOUDS, part)
    diameters = _diameters(folder / TABLE)
    rows = [read_numbers(path, columns=6, expected=_POINT) for path in files]
    names = [path.stem for path in files]
    centers, fitted = [], []
    for path, points in zip(files, rows, strict=True):
        known, trusted = diameters.get(path.stem), _select_trusted(points)
        alone = fit_sphere(trusted)
        sphere = alone if known is None else fit_sphere(trusted, known / 2.0)
        if sphere is None:
            size = "" if known is None else f" of {1000.0 * known:g} mm"
            raise FormatError(f"{path}: its {len(points)} points fix no sphere{size}. Expected the points of an apple")
        centers.append(sphere.center)
        fitted.append(float("nan") if alone is None else 2.0 * alone.radius)
    measured = np.array([name in diameters for name in names])
    true = np.array([diameters.get(name, fit) for name, fit in zip(names, fitted, strict=True)])
    imported = ImportedTruth(
        layout=LAYOUT,
        label="apple",
        truth=assume_visible(np.stack(centers), true),
        names=tuple(names),
        metres_per_unit=1.0,
        remarks=_remarks(np.array(fitted), true, measured),
    )
    return ScannedApples(imported, np.array(fitted), cloud_of(np.concatenate([r[:, :6] for r in rows])), measured)


def _cloud_files(folder: Path, part: str | None) -> list[Path]:
    found = [(path, _CLOUD_FILE.fullmatch(path.name)) for path in sorted(folder.glob("*.txt"))]
    parts = sorted({name[1] for _, name in found if name is not None})
    if not parts:
        raise FormatError(f"{folder}: holds no apple. Expected files such as 2018_01_001.txt")
    if part is None and len(parts) > 1:
        raise FormatError(f"{folder}: holds the parts {', '.join(parts)}, each in its own frame. Name one with --part")
    chosen = parts[0] if part is None else part
    if chosen not in parts:
        raise FormatError(f"{folder}: has no part {chosen}, only {', '.join(parts)}. Name one of these with --part")
    return [path for path, name in found if name is not None and name[1] == chosen]


def _diameters(path: Path) -> Mapping[str, float]:
    """Diameter in metres by name of cloud; a heading is skipped."""
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror}). Expected rows of {_ROW}") from error
    diameters: dict[str, float] = {}
    for number, line in enumerate(lines, 1):
        cells = [cell.strip() for cell in re.split(r"[,;\t]", line)] if line.strip() else []
        if not cells or (number == 1 and not _is_number(cells[1:2])):
            continue
        millimetres = float(cells[1]) if _is_number(cells[1:2]) else float("nan")
        if not (np.isfinite(millimetres) and millimetres > 0.0):
            raise FormatError(f"{path}: line {number} is {line.strip()!r}. Expected {_ROW}")
        name = cells[0].removesuffix(".txt")
        if name in diameters:
            raise FormatError(f"{path}: line {number} gives {name} a second diameter. Expected each apple once")
        diameters[name] = millimetres / 1000.0
    if not diameters:
        raise FormatError(f"{path}: lists no apple. Expected rows of {_ROW}")
    return diameters


def _is_number(cells: Sequence[str]) -> bool:
    try:
        float(cells[0])
    except (IndexError, ValueError):
        return False
    return True


def _select_trusted(rows: FloatArray) -> FloatArray:
    """Select the points (P, 3) confirmed by more than one photo (column 8 above 1), or all if there are too few."""
    confirmed = rows[rows[:, 7] > 1.0] if rows.shape[1] > 8 else rows
    return (confirmed if len(confirmed) >= LEAST_TRUSTED else rows)[:, :3]


def _remarks(fitted: FloatArray, true: FloatArray, measured: NDArray[np.bool_]) -> tuple[str, ...]:
    """Agreement of the fits with the table."""
    remarks = []
    if not measured.all():
        remarks.append(
            f"{int((~measured).sum())} of {len(measured)} apples are not in {TABLE}: their diameter is fitted"
        )
    if (measured & np.isfinite(fitted)).any():
        errors = (fitted / true - 1.0)[measured & np.isfinite(fitted)]
        remarks.append(
            f"spheres fitted to the points alone differ from the table by {np.median(errors):+.1%} in the median "
            f"and by {np.median(np.abs(errors)):.1%} in the median amount"
        )
    return tuple(remarks)
