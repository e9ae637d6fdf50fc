"""The graphics card that `rasterize` draws on, where one was chosen: set for a run, used by everything below it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TypeVar

from ...errors import GpuError
from ..gpu.adapters import Adapter
from ..gpu.views import CardViews

T = TypeVar("T")


@dataclass
class DrawingCard:
    """A card that is opened when the first view is drawn. problem: why it is not used any more, else empty."""

    adapter: Adapter
    views: CardViews | None = None
    problem: str = ""


_chosen: ContextVar[DrawingCard | None] = ContextVar("drawing card", default=None)


@contextmanager
def use_card(adapter: Adapter | None) -> Iterator[DrawingCard | None]:
    """Draw views on this card as long as the block runs, None for the CPU. If it fails, the CPU draws the rest."""
    card = None if adapter is None else DrawingCard(adapter)
    token = _chosen.set(card)
    try:
        yield card
    finally:
        _chosen.reset(token)


def try_on_card(work: Callable[[CardViews], T]) -> T | None:
    """Return what `work` draws on the chosen card; None if the CPU must draw it."""
    card = _chosen.get()
    if card is None or card.problem:
        return None
    try:
        card.views = card.views or CardViews(card.adapter)
        return work(card.views)
    except GpuError as error:
        card.problem, card.views = str(error), None
        return None
