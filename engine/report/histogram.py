"""A histogram of fruit diameters as SVG for the report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from .labels import round_length

FloatArray = NDArray[np.float64]

WIDTH, HEIGHT = 620.0, 220.0
"""Size of the drawing, in its own units."""
_BAR, _GRID, _INK = "#3d7d3f", "#d9dee3", "#4c555e"
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 24.0, 10.0, 44.0
_BARS = 14
"""Approximate maximum number of bars."""
_TICKS = 5


@dataclass(frozen=True, eq=False)
class Histogram:
    """edges: (B + 1,) of the bars, multiples of one round number; counts: (B,) values between edges."""

    edges: FloatArray
    counts: NDArray[np.int64]


def histogram(values: FloatArray) -> Histogram:
    """Sort at least one value above 0 into bars of a round width."""
    low, high = float(values.min()), float(values.max())
    step = round_length(max((high - low) / _BARS, 0.01 * high) * 2.5)
    first = np.floor(low / step + 1e-9)
    last = max(np.ceil(high / step - 1e-9), first + 1)
    edges = step * np.arange(first, last + 1)
    counts, _ = np.histogram(values, np.concatenate([[-np.inf], edges[1:-1], [np.inf]]))
    return Histogram(edges, counts.astype(np.int64))


def drawing(bars: Histogram, *, axis: str) -> Markup:
    """The bars as SVG with numbers at both axes; axis: label of the values, with their unit."""
    wide, high = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM
    most = int(bars.counts.max())
    step = max(round(round_length(max(most / _TICKS, 1.0) * 1.6)), 1)
    top = step * -(-most // step)
    floor = _TOP + high
    parts = []
    for count in range(0, top + 1, step):
        y = floor - high * count / top
        parts.append(f'<line stroke="{_GRID}" x1="{_LEFT:g}" x2="{WIDTH - _RIGHT:g}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 7:g}" y="{y + 4:.1f}" text-anchor="end">{count}</text>')
    bar = wide / len(bars.counts)
    for index, count in enumerate(bars.counts.tolist()):
        tall = high * count / top
        x = _LEFT + index * bar
        parts.append(
            f'<rect fill="{_BAR}" x="{x + 1:.1f}" y="{floor - tall:.1f}" width="{bar - 2:.1f}" height="{tall:.1f}"/>'
        )
    every = -(-len(bars.edges) // 9)
    for index in range(0, len(bars.edges), every):
        x = _LEFT + index * bar
        parts.append(f'<text x="{x:.1f}" y="{floor + 17:g}" text-anchor="middle">{bars.edges[index]:.6g}</text>')
    middle = _LEFT + wide / 2
    parts.append(f'<text x="{middle:g}" y="{HEIGHT - 6:g}" text-anchor="middle">{escape(axis)}</text>')
    upright = f'transform="rotate(-90 11 {_TOP + high / 2:g})"'
    parts.append(f'<text x="11" y="{_TOP + high / 2:g}" text-anchor="middle" {upright}>fruit</text>')
    name = escape(f"Histogram: {axis}")
    # Every text in it is a number or was escaped above.
    return Markup(
        f'<svg class="histogram" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" fill="{_INK}" role="img" aria-label="{name}">'
        f"{''.join(parts)}</svg>"
    )
