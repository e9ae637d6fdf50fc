"""`selection.safetensors`: probability and fruit of every Gaussian, in the order of gaussians.ply."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..counting.fruit import FruitCount, member_ids
from ..errors import FormatError
from ..storage.files import read_tensors, write_tensors

SELECTION = "selection.safetensors"
FORMAT = "fruitlangs-selection-1"


@dataclass(frozen=True, eq=False)
class Selection:
    """probability: (N,) float32 that a Gaussian matches the prompt; fruit_ids: (N,) int32 id of its fruit, -1 for
    none."""

    probability: Tensor
    fruit_ids: NDArray[np.int32]


def write_selection(path: Path, probability: Tensor, fruit_count: FruitCount, origin: Mapping[str, Any]) -> None:
    """Write the tensors `probability` and `fruit_id`, (N,) each, atomically; the header contains the words of `origin`.

    Raises:
        OutputError: the file cannot be written.
    """
    tensors = {
        "probability": probability.detach().float().cpu().contiguous(),
        "fruit_id": torch.from_numpy(member_ids(len(probability), fruit_count.fruits)),
    }
    words = {name: origin[name] for name in ("prompts", "negatives")}
    write_tensors(path, tensors, {"format": FORMAT, **words})


def read_selection(path: Path) -> Selection:
    """Read a file written by `write_selection`.

    Raises:
        FormatError: the file is missing, damaged or something else.
    """
    try:
        tensors, _ = read_tensors(path)
        return Selection(tensors["probability"], tensors["fruit_id"].numpy())
    except (KeyError, ValueError) as error:
        raise FormatError(f"{path} holds no selection ({str(error).splitlines()[0]}). Count again") from error
