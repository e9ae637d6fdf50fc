"""Which kind of fruit each fruit looks like."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..features.features import Features

UNKNOWN_KIND = -1
"""Kind of a fruit without Gaussians that a view shows."""


def likely_kinds(features: Features, members: Sequence[NDArray[np.int64]], kinds: Tensor) -> NDArray[np.int64]:
    """(F,) the most probable kind of each fruit, the mean over its Gaussians by their pixels; UNKNOWN_KIND without any.

    members: the Gaussians of each fruit; kinds: (K, D) orthonormal text vectors, whose squared cosines are proportional
    to probabilities.
    """
    found = np.full(len(members), UNKNOWN_KIND, np.int64)
    for index, own in enumerate(members):
        rows = torch.from_numpy(np.asarray(own, np.int64))
        likelihoods = (features.unit(0, rows) @ kinds.T).square()
        shares = (likelihoods * features.weights[rows, :1]).sum(0)
        if float(shares.sum()) > 0.0:
            found[index] = int(shares.argmax())
    return found
