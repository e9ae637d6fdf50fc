"""What a pixel can show, by the numbers of the class masks."""

from __future__ import annotations

from .surroundings.things import WORDS

FRUIT = "fruit"
"""Stands for the species' word."""
CLASSES = ("sky", "leaf", "branch", "trunk", "soil", "grass", "post", FRUIT, "tag", "flower", "hedge", *WORDS)
"""Class words by number. Ground is soil until `render` tells grass from it."""
