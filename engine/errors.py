"""The error hierarchy of the engine.

Every message says what is wrong, where (file, view, option) and what to do about it, in one line.
"""

from __future__ import annotations


class FruitLangsError(Exception):
    """An error that the user can act on; the command line prints it and exits with 1."""


class SceneError(FruitLangsError):
    """The photos, cameras or the sparse model cannot be used."""


class TrainingError(FruitLangsError):
    """The Gaussians could not be trained or a checkpoint could not be used."""


class GpuError(FruitLangsError):
    """A graphics card cannot be used, or failed."""


class FormatError(FruitLangsError):
    """A file does not have the format that its name or place suggests."""


class VocabularyError(FruitLangsError):
    """A prompt contains a word that the encoder does not know."""


class EncoderError(FruitLangsError):
    """The encoder or its weights cannot be used."""


class CountingError(FruitLangsError):
    """The selected Gaussians cannot be counted."""


class OutputError(FruitLangsError):
    """Results cannot be written or read back."""


class ConfigError(FruitLangsError):
    """A setting has a value that makes no sense."""


class Cancelled(Exception):
    """Raised by a `Progress` when the user wants to stop; not an error (exit code 130)."""
