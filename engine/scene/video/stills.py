"""Stills of a video: sharp frames in even steps along the camera's path, as pictures in a folder."""

from __future__ import annotations

import json
import os
import shutil
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from ...errors import OutputError, SceneError
from ...progress import Progress, part, silent
from .frames import Frame, Video
from .path import RULER, Step, follow

IMAGES, LIST = "images", "stills.json"
LEAST_STILLS, MOST_STILLS = 3, 300
SPACING = 0.05
"""Path between stills, if they are not too many: 60 to 70 for a circle around a tree."""
_REACH = 0.3
"""Distance on the path within which the sharpest frame is taken, in shares of the distance between stills."""
_LEAST = 0.5
"""Shortest distance between stills where no frame is near enough, in the same shares."""
_ENOUGH = 0.95
"""Share of the seconds that the header promises from which a video is complete."""
_QUALITY = 95
_EVERY = 10
"""Frames between two reports of the progress."""


@dataclass(frozen=True, kw_only=True)
class Stills:
    """The stills of a video: the folder of the pictures, messages for the user, and whether they were there before."""

    images: Path
    notices: Sequence[str]
    reused: bool


def choose_stills(video: Path, out: Path, *, progress: Progress = silent) -> Stills:
    """Choose stills of a video and write them as JPEG to `out`/images, with a list in `out`/stills.json.

    The video is decoded twice, frame by frame: once to follow the camera, once to write the stills. They are about
    `SPACING` of the picture apart on the camera's path, the sharpest frame near each such point, so their number does
    not depend on the frame rate and pauses add none. A longer path than `MOST_STILLS` gets them farther apart. `out`
    is for one video: finished stills in it are returned unchanged. It is written atomically.

    Raises:
        SceneError: the file is not a video, has no picture, or shows fewer than 3 different views.
        OutputError: `out` cannot be written.
        Cancelled: `progress` asked for it.
    """
    reused = _is_complete(out)
    if not reused:
        staging = out.with_name(f".{out.name}.part")
        try:
            for left in (staging, out):  # of a killed run, or with pictures that were deleted
                shutil.rmtree(left, ignore_errors=True)
            (staging / IMAGES).mkdir(parents=True)
            _write(video, staging, progress)
            os.replace(staging, out)
        except OSError as error:
            raise OutputError(f"{out} cannot be written ({error.strerror or error}). Free space there") from error
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    listed = json.loads((out / LIST).read_text(encoding="utf-8"))
    chosen = f"{len(listed['stills'])} stills were chosen from {video.name} ({listed['seconds']:.0f} s)"
    where = f"they are in {out.parent.name}/{out.name}"
    return Stills(images=out / IMAGES, notices=[f"{chosen}; {where}", *listed["notices"]], reused=reused)


def _is_complete(folder: Path) -> bool:
    """Whether all stills of an earlier run are there."""
    if not (folder / LIST).is_file():
        return False
    listed = json.loads((folder / LIST).read_text(encoding="utf-8"))
    return all((folder / IMAGES / still["file"]).is_file() for still in listed["stills"])


def select_stills(steps: Sequence[Step]) -> list[Step]:
    """Select the frames of a video to keep, in the order of time; at most about `MOST_STILLS`.

    At every point in even steps along the path, the sharpest frame that is near; if none is, because the picture moved
    fast, the nearest frame, and the next steps start from there.
    """
    length = max((step.path for step in steps), default=0.0)
    spacing = max(SPACING, length / (MOST_STILLS - 1))
    on_path = sorted(steps, key=lambda step: (step.path, step.index))
    paths = [step.path for step in on_path]
    found: list[Step] = []
    target, start = 0.0, 0
    while start < len(on_path):
        first, end = bisect_left(paths, target - _REACH * spacing), bisect_right(paths, target + _REACH * spacing)
        if first < end:
            found.append(max(on_path[first:end], key=lambda step: step.sharpness))
        elif end == len(on_path):
            break
        else:
            before = first - 1 if paths[first - 1] - found[-1].path > _LEAST * spacing else first
            nearest = min(before, first, key=lambda index: abs(paths[index] - target))
            found.append(on_path[nearest])
            target, end = paths[nearest], nearest + 1
        start = end
        target += spacing
    return sorted(found, key=lambda step: step.index)


def _write(path: Path, folder: Path, progress: Progress) -> None:
    """Write the stills and their list to `folder`."""
    video = Video(path)
    steps = list(follow(_report_frames(video, part(progress, 0.0, 0.6), "following the camera")))
    stills = select_stills(steps)
    _require_stills(path, steps, stills)
    seconds, notices = video.end, _notices(video, steps)
    missing = {step.index for step in stills}
    for frame in _report_frames(video, part(progress, 0.6, 1.0), "writing stills"):
        if frame.index in missing:
            Image.fromarray(frame.pixels()).save(folder / IMAGES / _name(frame), quality=_QUALITY)
            missing.remove(frame.index)
        if not missing:
            break
    listed = {
        "video": path.name,
        "seconds": round(seconds, 3),
        "notices": notices,
        "stills": [_describe_still(step, before) for step, before in zip(stills, [stills[0], *stills], strict=False)],
    }
    (folder / LIST).write_text(json.dumps(listed, indent=1), encoding="utf-8")


def _report_frames(video: Video, progress: Progress, task: str) -> Iterator[Frame]:
    for frame in video.frames():
        if frame.index % _EVERY == 0:
            of = f" of {video.duration:.0f}" if video.duration else ""
            progress(frame.time / (video.duration or frame.time + 60.0), f"{task}: {frame.time:.0f}{of} s")
        yield frame


def _name(frame: Frame | Step) -> str:
    """'frame_000123_00m04.100s.jpg'."""
    minutes, milliseconds = divmod(round(1000 * frame.time), 60_000)
    return f"frame_{frame.index:06d}_{minutes:02d}m{milliseconds / 1000:06.3f}s.jpg"


def _describe_still(step: Step, before: Step) -> dict[str, str | int | float]:
    return {
        "file": _name(step),
        "frame": step.index,
        "seconds": round(step.time, 3),
        "sharpness": round(step.sharpness, 2),
        "moved": round(step.path - before.path, 4),
    }


def _require_stills(video: Path, steps: Sequence[Step], stills: Sequence[Step]) -> None:
    """
    Raises:
        SceneError: the stills are too few.
    """
    if not steps:
        raise SceneError(f"{video} has no frame that can be decoded. Copy it again from the camera")
    if len(stills) >= LEAST_STILLS:
        return
    if max(step.path for step in steps) < RULER:
        raise SceneError(f"The camera does not move in {video}. Walk around the tree while you record")
    raise SceneError(
        f"{video} shows only {len(stills)} different views. Give a video of a walk around the tree; 40 views or more"
        " work best"
    )


def _notices(video: Video, steps: Sequence[Step]) -> list[str]:
    """Messages for the user about a video that was decoded."""
    notices = []
    if video.end < _ENOUGH * video.duration:
        notices.append(
            f"{video.path.name} is incomplete: {video.end:.0f} of {video.duration:.0f} s were read. Copy it again from"
            " the camera"
        )
    elif video.damaged:
        notices.append(f"{video.path.name} is damaged: some frames could not be decoded and were left out")
    longest = SPACING * (MOST_STILLS - 1)
    length = max(step.path for step in steps)
    if length > longest:
        notices.append(
            f"the camera path of {video.path.name} is {length / longest:.1f} times too long for {MOST_STILLS} stills,"
            " so they are farther apart. If photos cannot be registered, give a shorter video"
        )
    return notices
