"""The check of a graphics card finds that a right card is right, and says what a wrong one does."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from splats import drawn_scene

from fruitlangs.benchmarks.training import card_check
from fruitlangs.benchmarks.training.card_check import BOUND, page
from fruitlangs.engine.splatting.gpu import card as card_module
from fruitlangs.engine.splatting.gpu.adapters import Adapter
from fruitlangs.engine.splatting.gpu.card import Card

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes and pictures so small that a program can play the card."""
    monkeypatch.setattr(card_check, "read_scene", lambda *_: drawn_scene())
    monkeypatch.setattr(card_check, "SMALL", 60)
    short = replace(card_check.SHORT, steps=30, densify_every=10, checkpoint_every=10, max_gaussians=200)
    monkeypatch.setattr(card_check, "SHORT", short)
    monkeypatch.setattr(card_check, "STOPPED_AFTER", 20)


def test_a_right_card_is_right_repeats_its_bytes_and_has_times(small: None, adapter: Adapter) -> None:
    report = card_check.check_card(adapter, ROOT, counts=[500], sizes=[(64, 48)], sample=False)
    assert report["right"]
    assert report["repeats"]["again"]
    assert report["repeats"]["resumed"]
    assert report["repeats"]["device"] == adapter.identity
    [step] = report["steps"]
    assert step["seconds"] > 0.0
    assert step["bytes"] > 500 * 59 * 4
    if "timestamp-query" in adapter.handle.features:
        assert sum(step["shares"].values()) == pytest.approx(1.0, abs=0.02)
        assert {"project", "sort", "blend", "loss", "backward", "optimiser"} <= step["shares"].keys()
    text = page(report)
    assert "**Right.**" in text
    assert "**no**" not in text


def test_a_wrong_card_is_wrong(small: None, adapter: Adapter, monkeypatch: pytest.MonkeyPatch) -> None:
    source = card_module._source
    monkeypatch.setattr(
        card_module, "_source", lambda name: source(name).replace("LOW_PASS: f32 = 0.3", "LOW_PASS: f32 = 0.4")
    )
    errors = card_check._measure_errors(Card.open(adapter))
    assert max(errors["card"].values()) > BOUND > max(errors["CPU"].values())


def test_a_step_that_does_not_fit_is_a_row_with_its_reason(adapter: Adapter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Adapter, "largest_buffer", 1000)
    [row] = card_check._time_steps(adapter, [500], [(64, 48)], lambda *_: None)
    assert row.seconds is None
    assert "holds buffers of at most" in row.reason


def test_a_missing_card_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, ROOT / "scripts" / "check_gpu.py", "--out", tmp_path / "out", "--device", "no such card"]
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "error: No graphics card is named 'no such card'." in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()
