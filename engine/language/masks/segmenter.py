"""The interface of segmenters, which find the masks of a photo for a crop encoder, and how to open one."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...config import EmbedConfig
from ...errors import EncoderError
from ...progress import Progress, silent
from .segments import Segments


class Segmenter(Protocol):
    """Divides a photo into masks at several levels, from small to large."""

    @property
    def identity(self) -> str:
        """Name and, for a model, fingerprint of its weights; masks of another identity are not reused."""
        ...

    def segment(self, image: NDArray[np.uint8], *, progress: Progress = silent) -> Segments:
        """(H, W, 3) sRGB → masks with labels of (L, H, W). Raises Cancelled if `progress` requests it."""
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
