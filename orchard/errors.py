"""What a user of the generator can get wrong."""

from __future__ import annotations

from ..engine.errors import FruitLangsError


class OrchardError(FruitLangsError):
    """An orchard cannot be planted, rendered or written."""
