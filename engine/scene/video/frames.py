"""Frames of a video: decoded one after the other, upright, as 8-bit sRGB or as small grey pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SceneError
from .hdr import TRANSFERS, to_srgb

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp", ".ogv"}
)
_UNSPECIFIED, _BT709, _BT601 = (0, 2), 1, 5
"""Colour matrices of ITU-T H.273; 0 is written for RGB, and by encoders that do not set it."""
_HD = 720
"""Shorter side from which a video that does not name its colour matrix has the one of BT.709."""


def video_library() -> ModuleType:
    """PyAV.

    Raises:
        SceneError: it is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise SceneError(f"Videos need the package av ({error}). Run: python -m pip install av") from error
    return av


@dataclass(frozen=True, eq=False)
class Frame:
    """A decoded frame: its number in the file from 0, its time in seconds, and the frame of PyAV."""

    index: int
    time: float
    decoded: Any
    pixel_aspect: float

    @property
    def is_hdr(self) -> bool:
        return self.decoded.color_trc in TRANSFERS

    def pixels(self) -> NDArray[np.uint8]:
        """(H, W, 3) upright sRGB with square pixels; PQ and HLG are tone-mapped."""
        kind = "rgb48le" if self.is_hdr else "rgb24"
        pixels = self._convert(kind, self._width, self.decoded.height).to_ndarray()
        if self.is_hdr:
            pixels = to_srgb(pixels, TRANSFERS[self.decoded.color_trc])
        return np.ascontiguousarray(np.rot90(pixels, round(self.decoded.rotation / 90)))

    def grey(self, side: int) -> NDArray[np.uint8]:
        """(h, w) brightness with a longer side of at most `side` pixels, not turned upright."""
        share = min(1.0, side / max(self._width, self.decoded.height))
        width, height = max(round(self._width * share), 1), max(round(self.decoded.height * share), 1)
        return self._convert("gray", width, height).to_ndarray()

    @property
    def _width(self) -> int:
        return max(round(self.decoded.width * self.pixel_aspect), 1)

    def _convert(self, kind: str, width: int, height: int) -> Any:
        matrix = self.decoded.colorspace
        if matrix in _UNSPECIFIED:
            matrix = _BT709 if min(self.decoded.width, self.decoded.height) >= _HD else _BT601
        return self.decoded.reformat(
            width, height, kind, src_colorspace=matrix, dst_colorspace=matrix, interpolation="AREA"
        )


@dataclass(eq=False)
class Video:
    """A video file. After `frames` has ended: the time that was read, and the number of damaged packets in it."""

    path: Path
    end: float = 0.0
    damaged: int = 0
    duration: float = field(default=0.0, init=False)
    """Seconds by the header of the file; 0 if it does not have them."""

    def frames(self) -> Iterator[Frame]:
        """Every frame in the order of time; what is damaged is left out, and one frame is in memory at a time.

        Raises:
            SceneError: the file is missing, is not a video, or has no picture.
        """
        av = video_library()
        self.end, self.damaged = 0.0, 0
        try:
            container = av.open(str(self.path))
        except (av.FFmpegError, OSError, ValueError) as error:
            raise SceneError(
                f"{self.path} cannot be read as a video ({_reason(error)}). Copy it again from the camera, or save it "
                "as .mp4"
            ) from error
        with container:
            stream = next((each for each in container.streams.video if not _is_cover(each)), None)
            if stream is None:
                raise SceneError(f"{self.path} has no video stream, only sound or data. Give a video of the tree")
            if stream.codec_context is None:
                raise SceneError(f"The format of {self.path} is not supported. Save it as .mp4 (H.264)")
            self.duration = _duration(container, stream)
            yield from self._decode(av, container, stream)

    def _decode(self, av: ModuleType, container: Any, stream: Any) -> Iterator[Frame]:
        stream.thread_type = "AUTO"
        rate = float(stream.average_rate or stream.guessed_rate or 25)
        aspect = float(stream.sample_aspect_ratio or 1) or 1.0
        first: float | None = None
        index = 0
        for packet in self._packets(av, container, stream):
            try:
                decoded = packet.decode()
            except av.FFmpegError:
                self.damaged += 1
                continue
            for frame in decoded:
                if frame.is_corrupt:
                    self.damaged += 1
                    continue
                stamp = index / rate if frame.time is None else float(frame.time)
                first = stamp if first is None else first
                self.end = max(self.end, stamp - first + 1.0 / rate)
                yield Frame(index, stamp - first, frame, aspect)
                index += 1

    def _packets(self, av: ModuleType, container: Any, stream: Any) -> Iterator[Any]:
        """The packets of the stream up to the end of the file, or up to where it cannot be read."""
        try:
            yield from container.demux(stream)
        except av.FFmpegError:
            self.damaged += 1


def _is_cover(stream: Any) -> bool:
    """Whether a stream is the still picture of a sound file."""
    return bool(int(stream.disposition) & 0x400)  # AV_DISPOSITION_ATTACHED_PIC


def _duration(container: Any, stream: Any) -> float:
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    return float(container.duration or 0) / 1e6


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
