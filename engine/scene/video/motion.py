"""Motion of the picture between two small grey frames, and the length of the camera's path in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Grey = NDArray[np.float32]
"""(H, W) brightness, 0 to 255."""

_TILE = 64
_TEXTURE = 2.0
"""Standard deviation of brightness, within a tile, below which a tile shows no motion."""
_ALIKE = 0.35
"""Correlation from which a tile of one frame is recognised in the other."""
_RIGID, _EVEN = 0.25, 1.5
"""If this share of the tiles is recognised and moved evenly, to this many pixels, the camera only turned or rests."""
CHANGED = 0.055
"""Motion of a tile that is not recognised: it left the picture, or was covered or turned too far."""


@dataclass(frozen=True)
class Motion:
    """How far the picture moved, as a share of its longer side, and the share of the tiles that were recognised."""

    distance: float
    recognised: float


def motion(first: Grey, second: Grey) -> Motion:
    """The mean motion of the tiles of `first` in `second`; a frame of another size shows something else.

    The whole frames are aligned first, then each tile of 64 x 64 pixels, both by phase correlation (Kuglin and Hines
    1975). The mean over tiles includes parallax: a camera that turns around a tree and keeps it in the middle moves
    what is behind it one way and what is in front of it the other way.
    """
    if first.shape != second.shape:
        return Motion(CHANGED, 0.0)
    overall = _shift(first[None], second[None])[0]
    height, width = first.shape
    tile = min(_TILE, height, width)
    # Each tile is compared with the one where it would be if the whole picture moved evenly.
    places = [(row, column) for row in _starts(height, tile) for column in _starts(width, tile)]
    inside = [
        (row, column, row + overall[0], column + overall[1])
        for row, column in places
        if 0 <= row + overall[0] <= height - tile and 0 <= column + overall[1] <= width - tile
    ]
    if not inside:
        return Motion(CHANGED, 0.0)
    before = np.stack([first[r : r + tile, c : c + tile] for r, c, _, _ in inside])
    after = np.stack([second[r : r + tile, c : c + tile] for _, _, r, c in inside])
    textured = before.std(axis=(1, 2)) > _TEXTURE
    if not textured.any():
        return Motion(0.0, 1.0)
    before, after = before[textured], after[textured]
    shifts = _shift(before, after)
    alike = _correlation(before, after, shifts) > _ALIKE
    lengths = np.hypot(*(shifts + overall).T) / max(first.shape)
    if alike.mean() >= _RIGID and np.percentile(np.hypot(*shifts[alike].T), 75) <= _EVEN:
        return Motion(float(lengths[alike].mean()), 1.0)  # what is not recognised are leaves in the wind
    return Motion(float(np.where(alike, lengths, CHANGED).mean()), float(alike.mean()))


def _starts(length: int, tile: int) -> list[int]:
    """First pixels of evenly spread tiles that overlap by about half."""
    count = max(1, round(2 * length / tile) - 1)
    return np.linspace(0, length - tile, count).round().astype(int).tolist()


def _shift(first: Grey, second: Grey) -> NDArray[np.int64]:
    """(N, 2) rows and columns by which each (H, W) picture of the first stack moved to become the second's."""
    height, width = first.shape[1:]
    window = np.hanning(height)[:, None] * np.hanning(width)
    window = window.astype(np.float32)
    a, b = (fft.rfft2((stack - stack.mean(axis=(1, 2), keepdims=True)) * window) for stack in (first, second))
    cross = b * a.conj()
    cross /= np.abs(cross) + 1e-3 * np.abs(cross).mean() + 1e-9
    surface = fft.irfft2(cross, s=(height, width))
    peak = surface.reshape(len(surface), -1).argmax(axis=1)
    at = np.stack(np.unravel_index(peak, (height, width)), axis=1)
    return np.where(at > np.array([height, width]) // 2, at - np.array([height, width]), at)


def _correlation(first: Grey, second: Grey, shifts: NDArray[np.int64]) -> NDArray[np.float64]:
    found = np.empty(len(first))
    size = first.shape[1]
    for k, (dy, dx) in enumerate(shifts):
        a = first[k, max(0, -dy) : size - max(0, dy), max(0, -dx) : size - max(0, dx)]
        b = second[k, max(0, dy) : size - max(0, -dy), max(0, dx) : size - max(0, -dx)]
        a, b = a - a.mean(), b - b.mean()
        found[k] = (a * b).sum() / (np.sqrt((a * a).sum() * (b * b).sum()) + 1e-6)
    return found
