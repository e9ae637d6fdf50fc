"""What finds the masks of a photo for a crop encoder, and how one is opened."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...config import EmbedConfig
from ...errors import EncoderError
from ...progress import Progress, silent
from .segments import Segments


class Segmenter(Protocol):
    """Cuts a photo into masks at several levels, small things first."""

    @property
    def identity(self) -> str:
        """Name and, where it has weights, their fingerprint; masks of another identity are not reused."""
        ...

    def segment(self, image: NDArray[np.uint8], *, progress: Progress = silent) -> Segments:
        """(H, W, 3) sRGB → masks with labels of (L, H, W). Raises Cancelled: `progress` asked for it."""
        ...


def open_segmenter(config: EmbedConfig) -> Segmenter:
    """The segmenter that the settings name.

    Raises:
        EncoderError: its weights are missing or unreadable.
    """
    if config.masks == "classical":
        from .classical import ClassicalSegmenter

        return ClassicalSegmenter()
    if config.masks == "sam":
        from .sam import SamSegmenter

        return SamSegmenter.open(config.sam, allow_download=config.allow_download)
    raise EncoderError(f"Unknown masks '{config.masks}'. Use 'classical' or 'sam'")
