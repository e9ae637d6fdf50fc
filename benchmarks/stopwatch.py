"""Time and peak memory by stage."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

import psutil

T = TypeVar("T")
SAMPLING = 0.02
"""Seconds between two measurements of the memory."""


@dataclass(frozen=True)
class Stage:
    """pipeline: of the stages; seconds: in total; peak: most memory of the process in that time, bytes; times: number
    of runs."""

    pipeline: str
    name: str
    seconds: float
    peak: int
    times: int


@dataclass
class Stopwatch:
    """Time and peak memory by stage; a stage inside another one stops the outer one's clock."""

    seconds: dict[str, float] = field(default_factory=dict)
    peaks: dict[str, int] = field(default_factory=dict)
    times: dict[str, int] = field(default_factory=dict)
    _open: list[str] = field(default_factory=list)
    _since: float = 0.0

    @contextmanager
    def running(self) -> Iterator[None]:
        """Measure the memory while the block runs."""
        process, done = psutil.Process(), threading.Event()

        def look() -> None:
            while not done.wait(SAMPLING):
                if stages := self._open[-1:]:
                    self.peaks[stages[0]] = max(self.peaks.get(stages[0], 0), process.memory_info().rss)

        thread = threading.Thread(target=look)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block."""
        self._tick()
        self._open.append(name)
        self.times[name] = self.times.get(name, 0) + 1
        self.peaks[name] = max(self.peaks.get(name, 0), psutil.Process().memory_info().rss)
        try:
            yield
        finally:
            self._tick()
            self._open.pop()

    def each(self, name: str, items: Iterable[T]) -> Iterator[T]:
        """Time how long each item takes."""
        iterator = iter(items)
        while True:
            with self.stage(name):
                try:
                    item = next(iterator)
                except StopIteration:
                    self.times[name] -= 1
                    return
            yield item

    def rows(self, pipeline: str) -> list[Stage]:
        return [Stage(pipeline, name, self.seconds[name], self.peaks[name], self.times[name]) for name in self.times]

    def _tick(self) -> None:
        now = time.perf_counter()
        if self._open:
            self.seconds[self._open[-1]] = self.seconds.get(self._open[-1], 0.0) + now - self._since
        self._since = now
