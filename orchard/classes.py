"""The classes of pixels, by the numbers of the class masks."""

from __future__ import annotations

from .surroundings.objects import WORD
from .surroundings.things import WORDS

FRUIT = "fruit"
"""Placeholder of the species' word."""
CLASSES = ("sky", "leaf", "branch", "trunk", "soil", "grass", "post", FRUIT, "tag", "flower", "hedge", *WORDS, WORD)
"""Class words by number. Ground is soil until `render` separates grass."""
