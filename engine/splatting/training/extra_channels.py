"""Further channels that are trained together with colour."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ChannelLoss = Callable[[int, NDArray[np.float32], NDArray[np.float32]], float]
"""Called with (view, rendered channels (C, H, W), output for their gradient (C, H, W)); returns the loss.

The view has the size of its photo, or half of it in the coarse part of the training. Channels are rendered like colour,
Σ α·T·f over black (paper eq. 7).
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class ExtraChannels:
    """What `train` trains in addition to colour.

    count: channels per Gaussian, which start at 0; loss: of the rendered channels of a view; rate: their learning rate,
    which falls to a tenth; after: share of the steps after which they are trained; moves_gaussians: whether the loss
    also changes position, shape and opacity of the Gaussians, or only their channels, so that colour is the same as
    without; key: a hash of what the loss depends on, so that a checkpoint with another loss is not resumed.
    """

    count: int
    loss: ChannelLoss
    rate: float
    after: float
    moves_gaussians: bool
    key: str

    def rate_at(self, done: float) -> float:
        """The rate when this share of the training is over; 0 before the channels are trained."""
        if done < self.after:
            return 0.0
        return self.rate * 0.1 ** ((done - self.after) / max(1.0 - self.after, 1e-9))
