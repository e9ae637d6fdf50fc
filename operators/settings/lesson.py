"""The word that is taught in a Blender scene, as plain values for threads and tools."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

from ...engine.language.taught.name import refines


@dataclass(frozen=True)
class LessonText:
    """name: as typed; places: of each example whether it shows the word, and x y z in the scene frame."""

    name: str
    places: tuple[tuple[bool, tuple[float, float, float]], ...]

    @property
    def mark(self) -> str:
        """A text that differs for other examples."""
        return hashlib.sha256(repr(self).encode()).hexdigest()[:12]


def read_lesson(settings: Any) -> LessonText | None:
    """The word and its examples; None before there is a positive one, or any one that corrects a built-in word."""
    teach = settings.teach
    places = tuple((bool(example.positive), _to_triple(example.place)) for example in teach.examples)
    enough = any(positive for positive, _ in places) or (bool(places) and refines(teach.word))
    if not teach.word.strip() or not enough:
        return None
    return LessonText(teach.word.strip(), places)


def _to_triple(place: Any) -> tuple[float, float, float]:
    x, y, z = (float(each) for each in place)
    return x, y, z
