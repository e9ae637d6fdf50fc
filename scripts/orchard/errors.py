"""What a user of the generator can get wrong."""

from __future__ import annotations

import _checkout  # noqa: F401

from fruitlangs.engine.errors import FruitLangsError


class OrchardError(FruitLangsError):
    """An orchard cannot be planted, rendered or written."""
