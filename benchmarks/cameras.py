"""Seconds of finding cameras for growing numbers of photos, by stage."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from ..engine.config import PhotosConfig
from ..engine.errors import SceneError
from ..engine.progress import Progress, part
from ..engine.scene.sfm.find_cameras import find_poses, list_photos
from ..engine.scene.sfm.job import FOUND
from .markdown import markdown

SEARCH_STAGES = ("features", "matching", "placing", "refining", "surfaces")


@dataclass(frozen=True, kw_only=True)
class CameraSearch:
    """One camera search: photos, how many were placed, pairs that show the same, seconds in all and by stage."""

    photos: int
    placed: int
    pairs: int
    seconds: float
    stages: Mapping[str, float]


def measure_cameras(folder: Path, counts: Sequence[int], *, progress: Progress) -> list[CameraSearch]:
    """Find the cameras of the first photos in a folder, for each of these numbers of photos.

    Raises:
        SceneError: the folder has fewer photos, or their cameras are not found.
    """
    files = list_photos(folder)
    if len(files) < max(counts):
        raise SceneError(f"{folder} has {len(files)} photos. Ask for at most as many")
    rows = []
    for number, count in enumerate(counts):
        with TemporaryDirectory() as temporary:
            photos = Path(temporary) / "photos"
            photos.mkdir()
            for file in files[:count]:
                os.symlink(file.resolve(), photos / file.name)
            start = time.perf_counter()
            share = part(progress, number / len(counts), (number + 1) / len(counts))
            model = find_poses(photos, Path(temporary), PhotosConfig(), progress=share).model
            seconds = time.perf_counter() - start
            found = json.loads((model / FOUND).read_text(encoding="utf-8"))
        placed = len(found["placed"])
        row = CameraSearch(photos=count, placed=placed, pairs=found["pairs"], seconds=seconds, stages=found["seconds"])
        rows.append(row)
    return rows


def camera_table(rows: Sequence[CameraSearch]) -> str:
    """One line per number of photos."""
    lines = [["photos", "placed", "pairs", *SEARCH_STAGES, "in all", "seconds a photo"]]
    for row in rows:
        stages = [f"{row.stages[stage]:.0f} s" for stage in SEARCH_STAGES]
        whole = [f"{row.seconds:.0f} s", f"{row.seconds / row.photos:.1f}"]
        lines.append([str(row.photos), str(row.placed), str(row.pairs), *stages, *whole])
    return markdown(lines)
