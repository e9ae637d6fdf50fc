"""Opens the encoder that the settings name."""

from __future__ import annotations

from pathlib import Path

from ...config import EmbedConfig
from ...errors import EncoderError
from ...user_folders import words_folder
from .encoder import CropEncoder, DenseEncoder


def open_encoder(config: EmbedConfig) -> DenseEncoder | CropEncoder:
    """The encoder that the settings name, with the taught words of their folder; one with `encode_crops` needs masks
    (see `masks.segmenter.open_segmenter`).

    Raises:
        EncoderError: its weights are missing, unsafe or unreadable.
    """
    words = folder_of_words(config)
    if config.encoder == "embedded":
        from .embedded import EmbeddedEncoder

        return EmbeddedEncoder.open(words=words)
    if config.encoder == "clip":
        from .clip import ClipEncoder

        return ClipEncoder.open(config.clip, allow_download=config.allow_download, words=words)
    raise EncoderError(f"Unknown encoder '{config.encoder}'. Use 'embedded' or 'clip'")


def folder_of_words(config: EmbedConfig) -> Path:
    """The folder of taught words that the settings name, else the user's."""
    return Path(config.words) if config.words else words_folder()
