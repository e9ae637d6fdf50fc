"""Errors that a user of the generator can cause."""

from __future__ import annotations

from ..engine.errors import FruitLangsError


class OrchardError(FruitLangsError):
    """An orchard cannot be generated, rendered or written."""
