"""Adam for values of one photo: its colours, its pose. Rows are updated when their photo is used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-15


@dataclass(eq=False)
class ViewMoments:
    """Adam's moments by view.

    first, second: (V, …); updates: (V,) int32 how often each view was used.
    """

    first: NDArray[Any]
    second: NDArray[Any]
    updates: NDArray[np.int32]

    def step(self, view: int, gradient: NDArray[np.float64], rate: float) -> NDArray[Any]:
        """The step for the values of one view; updates its moments with the gradient."""
        self.updates[view] += 1
        t = int(self.updates[view])
        self.first[view] = BETA_1 * self.first[view] + (1 - BETA_1) * gradient
        self.second[view] = BETA_2 * self.second[view] + (1 - BETA_2) * gradient * gradient
        mean = self.first[view] / (1 - BETA_1**t)
        spread = np.sqrt(self.second[view] / (1 - BETA_2**t)) + EPSILON
        return rate * mean / spread


def decay_rate(rate: float, last: float, done: float) -> float:
    """Decay a learning rate exponentially; done: share of the training that is over."""
    return rate * (last / rate) ** done
