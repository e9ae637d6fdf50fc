"""The truth of a published data set, and its truth.json."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError
from ...storage.files import write_text
from ..number_table import read_numbers
from ..truth import Truth


@dataclass(frozen=True, kw_only=True, eq=False)
class ImportedTruth:
    """True fruit read from a published layout."""

    layout: str
    """Name of the layout."""
    label: str
    """Label of the fruit, a word of the vocabulary."""
    truth: Truth
    """The fruit. Published layouts do not record what each photo shows, so every fruit is visible."""
    names: tuple[str, ...]
    """(M,) the name of each fruit in the layout."""
    metres_per_unit: float | None = None
    """None if the layout does not record it."""
    remarks: tuple[str, ...] = ()
    """Remarks for a reader before using it, one line each."""


def assume_visible(
    centers: NDArray[np.float64], diameters: NDArray[np.float64], trees: NDArray[np.int64] | None = None
) -> Truth:
    """Return the truth of fruit (M, 3), (M,) without visibility: visible, fraction 1."""
    count = len(diameters)
    return Truth(centers.reshape(-1, 3), diameters, np.ones(count, dtype=bool), np.ones(count), trees=trees)


def transform(imported: ImportedTruth, similarity: NDArray[np.float64]) -> ImportedTruth:
    """Return the same fruit in another frame; similarity: (4, 4) rotation times one scale, and translation."""
    scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
    truth = imported.truth
    moved = replace(
        truth,
        centers=truth.centers @ similarity[:3, :3].T + similarity[:3, 3],
        diameters=scale * truth.diameters,
    )
    metres = None if imported.metres_per_unit is None else imported.metres_per_unit / scale
    return replace(imported, truth=moved, metres_per_unit=metres)


def read_similarity(path: Path) -> NDArray[np.float64]:
    """(4, 4) the matrix of a text file, as CloudCompare writes it after an alignment.

    Raises:
        FormatError: it is not four rows of four numbers, or it mirrors, shears or scales the axes differently.
    """
    matrix = read_numbers(path, columns=4, expected="4 numbers, 4 rows: a rotation times a scale, and a translation")
    if matrix.shape != (4, 4) or not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise FormatError(f"{path}: is not a 4x4 matrix that ends with the row 0 0 0 1. Expected a similarity")
    stretches = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if np.linalg.det(matrix[:3, :3]) <= 0.0 or stretches[0] > 1.01 * stretches[2]:
        raise FormatError(f"{path}: mirrors or stretches the scene. Expected a rotation times one scale")
    return matrix


def write_truth(path: Path, imported: ImportedTruth) -> None:
    """Write truth.json with the fields of the generator.

    Fields that no layout has are written as: seed null, variant "published", kind "hanging", clump 0, visible_pixels
    {}.

    Raises:
        OutputError: the file cannot be written.
    """
    truth = imported.truth
    fruits = [
        {
            "id": index + 1,
            "label": imported.label,
            "center": [round(float(value), 6) for value in truth.centers[index]],
            "diameter": round(float(truth.diameters[index]), 6),
            "kind": "hanging",
            "clump": 0,
            "visible_pixels": {},
            "visible_fraction": round(float(truth.visible_fractions[index]), 4),
            "visible": bool(truth.visible[index]),
            "name": imported.names[index],
            **({} if truth.trees is None else {"tree": int(truth.trees[index])}),
        }
        for index in range(len(truth.diameters))
    ]
    about = {
        "generator": imported.layout,
        "seed": None,
        "species": imported.label,
        "variant": "published",
        "metres_per_unit": imported.metres_per_unit,
        "remarks": list(imported.remarks),
    }
    write_text(path, json.dumps({**about, "fruits": fruits}, indent=1, allow_nan=False) + "\n")
