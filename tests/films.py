"""Small videos: a camera that pans over a large picture."""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from scipy.ndimage import gaussian_filter

WIDTH, HEIGHT = 320, 180


@functools.cache
def ground() -> np.ndarray:
    """(HEIGHT, 8 * WIDTH, 3) random spots of several sizes."""
    noise = np.random.default_rng(0).normal(size=(HEIGHT, 8 * WIDTH, 3))
    spots = sum(gaussian_filter(noise, (size, size, 0)) * size for size in (1.0, 3.0, 9.0))
    return np.clip(128 + 60 * spots, 0, 255).astype(np.uint8)


def picture(at: float) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) what the camera shows after a path of `at` widths."""
    left = round(at * WIDTH)
    return ground()[:, left : left + WIDTH]


def write_film(
    path: Path,
    pictures: Iterable[np.ndarray],
    *,
    rate: int = 30,
    times: Sequence[float] | None = None,
    codec: str = "libx264",
    kind: str = "yuv420p",
    transfer: int | None = None,
) -> Path:
    """Write 8-bit sRGB or 16-bit BT.2020 pictures; times: in seconds, evenly spaced by default."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream: Any = None
        for index, pixels in enumerate(pictures):
            if stream is None:
                stream = container.add_stream(codec, rate=rate)
                stream.height, stream.width = pixels.shape[:2]
                stream.pix_fmt = kind
                stream.options = {"preset": "ultrafast", "crf": "18"} if codec == "libx264" else {}
                stream.codec_context.time_base = Fraction(1, 1000) if times else Fraction(1, rate)
                if transfer is not None:
                    stream.codec_context.color_trc = transfer
                    stream.codec_context.colorspace = stream.codec_context.color_primaries = 9
                    stream.codec_context.color_range = 1
            matrix = 5 if transfer is None else 9
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24" if pixels.dtype == np.uint8 else "rgb48le")
            frame = frame.reformat(format=kind, src_colorspace=matrix, dst_colorspace=matrix)
            frame.pts = index if times is None else round(times[index] * 1000)
            frame.time_base = stream.codec_context.time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def write_sound(path: Path) -> Path:
    """A file with sound and without pictures."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def turn(path: Path) -> Path:
    """Make a player turn the pictures of an .mp4 by 90 degrees clockwise, as a phone that was held upright does."""
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 44
    content[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    return path
