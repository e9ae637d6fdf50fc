"""Plain text tables of numbers, the format of published point clouds and boxes."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError


def read_numbers(path: Path, *, columns: int, expected: str) -> NDArray[np.float64]:
    """(R, C) the finite numbers of a text file, R ≥ 1 rows of C ≥ `columns`, separated by spaces, tabs or commas.

    expected: the content of a row, for messages.

    Raises:
        FormatError: the file is missing, is empty, holds something else than numbers, has too few columns, rows of
            different length, or a number that is not finite.
    """
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            first = next((line for line in file if line.strip()), "")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # numpy warns of an empty file, refused below
            numbers = np.loadtxt(path, delimiter="," if "," in first else None, ndmin=2, encoding="utf-8")
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror}). Expected rows of {expected}") from error
    except ValueError as error:
        raise FormatError(f"{path}: not a table of numbers ({error}). Expected rows of {expected}") from error
    if numbers.size == 0:
        raise FormatError(f"{path}: is empty. Expected rows of {expected}")
    if numbers.shape[1] < columns:
        raise FormatError(f"{path}: has {numbers.shape[1]} columns. Expected rows of {expected}")
    if not np.isfinite(numbers).all():
        row = int(np.flatnonzero(~np.isfinite(numbers).all(axis=1))[0]) + 1
        raise FormatError(f"{path}: row {row} holds a number that is not finite. Expected rows of {expected}")
    return numbers
