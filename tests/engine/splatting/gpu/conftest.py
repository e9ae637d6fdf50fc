"""What the tests of a graphics card's kernels draw with."""

from __future__ import annotations

import pytest

from fruitlangs.engine.splatting.gpu.adapters import Adapter
from fruitlangs.engine.splatting.gpu.card import Card
from fruitlangs.engine.splatting.gpu.drawing import Canvas


@pytest.fixture(scope="session")
def card(adapter: Adapter) -> Card:
    return Card.open(adapter)


@pytest.fixture
def canvas(card: Card) -> Canvas:
    return Canvas(card)
