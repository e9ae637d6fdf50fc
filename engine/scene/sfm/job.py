"""The job of the process that finds cameras: small copies of photos, in a folder with a database."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ...config import PhotosConfig
from ..pycolmap_import import colmap_library

JOB, FOUND = "job.json", "poses.json"
LEAST_PHOTOS = 3
"""Photos that a model needs."""


@dataclass(frozen=True, kw_only=True)
class Copy:
    """One photo to be placed.

    name, width, height: of the photo, in pixels; copy, copy_width, copy_height: of its smaller copy; focal: focal
    length from EXIF over the longer side of the photo, 0 without EXIF.
    """

    name: str
    width: int
    height: int
    copy: str
    copy_width: int
    copy_height: int
    focal: float

    @property
    def copy_focal(self) -> float:
        """Focal length from EXIF in pixels of the copy; 0 without EXIF."""
        return self.focal * max(self.copy_width, self.copy_height)


@dataclass(frozen=True, kw_only=True)
class Job:
    """Copies in `folder`/copies in name order; the child writes `folder`/model with up to `threads` threads."""

    folder: str
    photos: Sequence[Copy]
    config: PhotosConfig
    threads: int

    def write(self) -> Path:
        path = Path(self.folder) / JOB
        path.write_text(json.dumps(asdict(self)), encoding="utf-8")
        return path

    @classmethod
    def read(cls, path: Path) -> Job:
        document = json.loads(path.read_text(encoding="utf-8"))
        photos = [Copy(**photo) for photo in document["photos"]]
        return cls(**{**document, "photos": photos, "config": PhotosConfig(**document["config"])})

    @property
    def database(self) -> Path:
        return Path(self.folder) / "database.db"

    @property
    def copies(self) -> Path:
        return Path(self.folder) / "copies"

    def open_database(self) -> Any:
        return colmap_library().Database.open(self.database)
