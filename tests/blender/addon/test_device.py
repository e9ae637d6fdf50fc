"""Step 2 and the preferences name what trains, without waiting for drivers."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import pytest

from fruitlangs.engine.errors import GpuError
from fruitlangs.engine.splatting.gpu import adapters
from fruitlangs.operators.steps import device
from fruitlangs.operators.steps.device import ON_CPU, describe_device


@pytest.fixture(autouse=True)
def forgotten():
    device._start_answer.cache_clear()
    yield
    device._start_answer.cache_clear()


def answer(wanted: str) -> str:
    end = time.monotonic() + 10
    while not describe_device(wanted):
        assert time.monotonic() < end
        time.sleep(0.01)
    return describe_device(wanted)


def test_the_card_is_named_once_its_driver_has_answered(monkeypatch):
    answered, asked = threading.Event(), []

    def choose(wanted):
        asked.append(wanted)
        assert answered.wait(10)
        return SimpleNamespace(name="Radeon 780M", backend="Vulkan")

    monkeypatch.setattr(adapters, "choose_adapter", choose)
    assert describe_device("auto") == describe_device("auto") == ""
    answered.set()
    assert answer("auto") == "Trains on Radeon 780M (Vulkan)"
    assert describe_device(" ") == "Trains on Radeon 780M (Vulkan)"  # an empty setting is auto
    assert asked == ["auto"]


def test_without_a_card_the_cpu_is_named_and_a_missing_card_is_a_sentence(monkeypatch):
    def choose(wanted):
        if wanted == "RTX":
            raise GpuError("No graphics card is named 'RTX'. Found: none")
        return None

    monkeypatch.setattr(adapters, "choose_adapter", choose)
    assert answer("auto") == ON_CPU
    assert answer("RTX").startswith("No graphics card is named 'RTX'")
