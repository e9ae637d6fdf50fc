"""Further channels that are trained along with colour, for whoever knows what they mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ChannelLoss = Callable[[int, NDArray[np.float32], NDArray[np.float32]], float]
"""Called with (view, drawn channels (C, H, W), where their gradient goes (C, H, W)); returns the loss.

The view's size is that of its photo, or half of it in the coarse part of the training. Channels are drawn as colour is,
Σ α·T·f over black (paper eq. 7).
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class ExtraChannels:
    """What `train` shall train beside colour.

    count: channels a Gaussian, which start at 0; loss: of a view's drawn channels; rate: their learning rate, which
    falls to a tenth; after: share of the steps after which they are trained; moves_gaussians: whether the loss also
    moves, reshapes and fades the Gaussians, or their channels alone, so that colour stays as it would be without; key:
    a hash of what the loss depends on, so that a checkpoint of another is not taken up.
    """

    count: int
    loss: ChannelLoss
    rate: float
    after: float
    moves_gaussians: bool
    key: str

    def rate_at(self, done: float) -> float:
        """The rate when this share of the training is over; 0 before they are trained."""
        if done < self.after:
            return 0.0
        return self.rate * 0.1 ** ((done - self.after) / max(1.0 - self.after, 1e-9))
