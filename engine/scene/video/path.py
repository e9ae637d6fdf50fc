"""The camera's path through a video: how far the picture has moved since the first frame, and how sharp it is."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .frames import Frame
from .motion import Grey, Motion, motion

RULER = 0.025
"""Path is added in pieces of at least this share of the picture: a camera that rests in a hand shakes by less."""
_MOST = 0.75
"""Share of the picture that is recognised in a frame near enough to the anchor."""
_RATE = 16.0
"""Frames a second that are compared; all of them where the picture moves fast."""
_MOST_SKIPPED = 7
"""Frames between two compared ones: decoded frames are large."""
_FAST = 0.03
"""Motion between compared frames above which those in between are compared too."""
_SHARP_SIDE, _SMALL_SIDE = 960, 320
"""Pixels of the longer side with which sharpness and motion are measured."""


@dataclass(frozen=True)
class Step:
    """A compared frame: index and time in the video, path since the first frame in shares of the longer side of the
    picture, and sharpness (mean squared gradient of brightness)."""

    index: int
    time: float
    path: float
    sharpness: float


@dataclass(frozen=True, eq=False)
class _View:
    """A small picture of a frame."""

    index: int
    time: float
    small: Grey
    sharpness: float


def follow(frames: Iterable[Frame]) -> Iterator[Step]:
    """The path of the camera at the compared frames.

    A frame is compared with an anchor, and becomes the anchor when it is at least `RULER` away. So a camera that rests
    adds nothing, however many frames show it, and the sum does not depend on the frame rate.
    """
    follower, last = _Follower(), -np.inf
    skipped: list[Frame] = []
    for frame in frames:
        if frame.time - last < 0.99 / _RATE and len(skipped) < _MOST_SKIPPED:
            skipped.append(frame)
            continue
        view = _view(frame)
        if skipped and follower.is_far(view):
            for between in skipped:
                yield follower.add(_view(between))
        yield follower.add(view)
        skipped.clear()
        last = frame.time


class _Follower:
    """The state of `follow`: the anchor and the last frame, with the path at each."""

    def __init__(self) -> None:
        self.anchor: _View | None = None
        self.last: _View | None = None
        self.anchor_path = self.last_path = 0.0
        self._compared: tuple[_View, _View, Motion] | None = None

    def is_far(self, view: _View) -> bool:
        """Whether the picture moved fast since the last frame."""
        if self.anchor is None:
            return False
        moved = self._measure_from_anchor(self.anchor, view)
        return moved.recognised < _MOST or self.anchor_path + moved.distance - self.last_path > _FAST

    def add(self, view: _View) -> Step:
        """The path at the next frame."""
        if self.anchor is None or self.last is None:
            return self._set_anchor(view, 0.0)
        moved = self._measure_from_anchor(self.anchor, view)
        if moved.recognised < _MOST and self.last is not self.anchor:
            since = motion(self.last.small, view.small)
            if since.recognised > moved.recognised:
                return self._set_anchor(view, self.last_path + since.distance)
        path = self.anchor_path + moved.distance
        return self._step(view, path) if moved.distance < RULER else self._set_anchor(view, path)

    def _measure_from_anchor(self, anchor: _View, view: _View) -> Motion:
        """Measure the motion from the anchor, once for a frame."""
        if self._compared is None or self._compared[0] is not anchor or self._compared[1] is not view:
            self._compared = anchor, view, motion(anchor.small, view.small)
        return self._compared[2]

    def _set_anchor(self, view: _View, path: float) -> Step:
        self.anchor, self.anchor_path = view, path
        return self._step(view, path)

    def _step(self, view: _View, path: float) -> Step:
        self.last, self.last_path = view, path
        return Step(view.index, view.time, path, view.sharpness)


def _view(frame: Frame) -> _View:
    grey = Image.fromarray(frame.grey(_SHARP_SIDE))
    share = min(1.0, _SMALL_SIDE / max(grey.size))
    small = grey.resize((round(grey.width * share), round(grey.height * share)), Image.Resampling.BOX)
    sharpness = _sharpness(np.asarray(grey, dtype=np.float32))
    return _View(frame.index, frame.time, np.asarray(small, dtype=np.float32), sharpness)


def _sharpness(grey: NDArray[np.float32]) -> float:
    """Mean squared difference between neighbouring pixels."""
    return float(sum(np.mean(np.diff(grey, axis=axis) ** 2) for axis in (0, 1) if grey.shape[axis] > 1))
