"""How the network sees a photo: at which scales, and in tiles if the image is large."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from .network import STRIDE, Network, levels_of
from .offsets import OffsetNetwork

Scales = tuple[float, ...]
"""Sizes relative to a photo, the largest first."""

BEST_WIDTH = 30.0
"""Width of fruit, in pixels of the image that the network sees, at which it finds them best."""
CLOSE_WIDTH, FEW_PIXELS = 44.0, 690_000
"""Width at which it sees fruit in photos that are quickly processed, where sizes and what is small in the photo are
better seen, and the pixels of the image that it sees up to which it is quick."""
MOST, MOST_PIXELS = 2.0, 16_000_000
"""Largest scale, and the most pixels of the image that the network sees."""
SIDE = 960
"""Longer side, in pixels, at which the network sees a photo if the width of its fruit is unknown."""
TILE, MARGIN = 2_600_000, 144
"""Most pixels of a tile, and the pixels around it that are processed with it, a multiple of STRIDE: what is farther
away changes no output by more than 1e-5. With 128, offsets change by up to 2e-4."""
NEAR = 32
"""Pixels around those that may be fruit that are processed at full size too."""


def scales_of(height: int, width: int, fruit: float | None = None) -> Scales:
    """The scales at which the network sees a photo of height × width pixels.

    fruit: their width in the photo, in pixels. If it is not known, the network sees the photo at half the size too,
    where large fruit fit its receptive field, unless the photo is so small that its fruit are small.
    """
    quick, largest = ((pixels / (height * width)) ** 0.5 for pixels in (FEW_PIXELS, MOST_PIXELS))
    finest = SIDE / max(height, width) if fruit is None else min(max(quick, BEST_WIDTH / fruit), CLOSE_WIDTH / fruit)
    finest = min(finest, largest)
    if finest >= MOST:
        return (MOST,)
    return (finest, finest / 2.0) if fruit is None else (finest,)


def map_size(height: int, width: int, scales: Sequence[float]) -> tuple[int, int]:
    """Height and width of the outputs for a photo of height × width pixels: those of the network at the largest scale,
    one for 2 × 2 pixels of the image that it sees, but no more than the photo has pixels."""
    rows, columns = _outputs(height, width, max(scales))
    return min(rows, height), min(columns, width)


def _outputs(height: int, width: int, scale: float) -> tuple[int, int]:
    """Rows and columns of the network's outputs for a photo at a scale."""
    return max(1, round(height * scale / 2.0)), max(1, round(width * scale / 2.0))


def tiles_of(rows: slice, columns: slice, most: int) -> Iterator[tuple[slice, slice]]:
    """Rows and columns of tiles that cover a part of an image once, of at most `most` pixels each. Their sides are
    multiples of STRIDE, except those of the last ones."""
    tall, wide, number = rows.stop - rows.start, columns.stop - columns.start, 1
    if tall == 0 or wide == 0:
        return
    while _side(tall, number) * _side(wide, number) > max(most, STRIDE**2):
        number += 1
    for top in range(rows.start, rows.stop, _side(tall, number)):
        for left in range(columns.start, columns.stop, _side(wide, number)):
            bottom, right = top + _side(tall, number), left + _side(wide, number)
            yield slice(top, min(bottom, rows.stop)), slice(left, min(right, columns.stop))


def _side(length: int, number: int) -> int:
    """Pixels of each of `number` parts of a length, a multiple of STRIDE."""
    return -(-length // (number * STRIDE)) * STRIDE


@dataclass(frozen=True, eq=False)
class Seen:
    """The outputs of the network for a photo at one scale. details: (C, h, w) the last features before the logits;
    offsets: (3, h, w), see `OffsetNetwork`, None if they were not requested."""

    details: Tensor
    offsets: Tensor | None


@dataclass(frozen=True, eq=False)
class Skimmed:
    """The outputs for a photo at a smaller scale. fruit: (h, w) where they show that fruit may be."""

    seen: Seen
    fruit: Tensor


@torch.inference_mode()
def see(
    network: Network,
    pixels: Tensor,
    scale: float,
    offsets: OffsetNetwork | None = None,
    skimmed: Skimmed | None = None,
) -> Seen:
    """Process a photo (3, H, W) in [0, 1] at a scale, tile by tile.

    skimmed: if given, only the smallest rectangle with everything that may be fruit is processed, NEAR pixels larger to
    each side; outside it the outputs are interpolated from these.
    """
    size = _outputs(pixels.shape[-2], pixels.shape[-1], scale)
    height, width = 2 * size[0], 2 * size[1]
    image, inside = resize(pixels, height, width), (slice(0, height), slice(0, width))
    details, off = torch.empty(network.head.in_channels, *size), torch.empty(3, *size)
    if skimmed is not None:
        inside = _rectangle(skimmed.fruit, height, width)
        details = resize(skimmed.seen.details, *size)
        off = off if skimmed.seen.offsets is None else resize(skimmed.seen.offsets, *size)
    for rows, columns in tiles_of(*inside, TILE):
        wide_rows, wide_columns = _add_margin(rows, height), _add_margin(columns, width)
        levels = levels_of(network, image[:, wide_rows, wide_columns])
        target = slice(None), _halve(rows), _halve(columns)
        own = slice(None), _halve(rows, wide_rows.start), _halve(columns, wide_columns.start)
        details[target] = network.compute_details(levels)[0][own]
        if offsets is not None:
            off[target] = offsets(levels)[0][own]
    return Seen(details, None if offsets is None else off)


def resize(values: Tensor, height: int, width: int) -> Tensor:
    """Resize (C, h, w) → (C, height, width), averaged when it shrinks."""
    if values.shape[-2:] == (height, width):
        return values
    image = functional.interpolate(values[None], (height, width), mode="bilinear", antialias=True, align_corners=False)
    return image[0]


def _rectangle(fruit: Tensor, height: int, width: int) -> tuple[slice, slice]:
    """Rows and columns of a (height, width) image around what may be fruit (h, w), NEAR pixels to each side, rounded
    outwards to multiples of STRIDE; empty if nothing may be fruit."""
    if not bool(fruit.any()):
        return slice(0, 0), slice(0, 0)
    return _slice_around(fruit.any(1), height), _slice_around(fruit.any(0), width)


def _slice_around(shown: Tensor, length: int) -> slice:
    """Slice, of `length` pixels, those from the first to the last of `shown` (n,), see `_rectangle`."""
    places, ratio = shown.nonzero()[:, 0].tolist(), length / len(shown)
    low, high = int(places[0] * ratio) - NEAR, math.ceil((places[-1] + 1) * ratio) + NEAR
    return slice(max(low // STRIDE * STRIDE, 0), min(-(-high // STRIDE) * STRIDE, length))


def _add_margin(inner: slice, length: int) -> slice:
    """Return the rows or columns of a tile with its margin, in an image of `length` rows or columns."""
    return slice(max(inner.start - MARGIN, 0), min(inner.stop + MARGIN, length))


def _halve(pixels: slice, start: int = 0) -> slice:
    """Return the outputs for a range of pixels, counted from that of pixel `start`; all numbers are even."""
    return slice((pixels.start - start) // 2, (pixels.stop - start) // 2)
