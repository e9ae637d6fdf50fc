"""Opens the encoder that the settings name."""

from __future__ import annotations

from ...config import EmbedConfig
from ...errors import EncoderError
from .encoder import CropEncoder, DenseEncoder


def open_encoder(config: EmbedConfig) -> DenseEncoder | CropEncoder:
    """The encoder that the settings name; one with `encode_crops` needs masks (see `masks.segmenter.open_segmenter`).

    Raises:
        EncoderError: its weights are missing, unsafe or unreadable.
    """
    if config.encoder == "embedded":
        from .embedded import EmbeddedEncoder

        return EmbeddedEncoder.open()
    if config.encoder == "clip":
        from .clip import ClipEncoder

        return ClipEncoder.open(config.clip, allow_download=config.allow_download)
    raise EncoderError(f"Unknown encoder '{config.encoder}'. Use 'embedded' or 'clip'")
