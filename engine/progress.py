"""How functions report their progress and how they are cancelled, and durations as text."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with (fraction done in [0, 1], current task); may raise `Cancelled`."""


def silent(fraction: float, message: str) -> None:
    """Report nothing."""


def part(progress: Progress, start: float, end: float) -> Progress:
    """Map the 0…1 of a stage onto [start, end] of the progress of the whole job."""

    def report(fraction: float, message: str) -> None:
        progress(start + (end - start) * min(max(fraction, 0.0), 1.0), message)

    return report


def duration(seconds: float, step: int = 1) -> str:
    """A duration as text: '40 s', '3 min', '1 h 20 min'; seconds are multiples of `step`, except few of them. A step of
    a minute or more gives no seconds."""
    if seconds < 90 and step < 60:
        few = seconds <= 1.5 * step
        return f"{max(round(seconds) if few else round(seconds / step) * step, 1)} s"
    minutes = max(round(seconds / 60), 1)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
