"""Camera poses from photos alone: a folder of photos → a COLMAP model, by pycolmap's structure from motion."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from ...child_process import ChildError, run_child, usable_cores
from ...config import PhotosConfig
from ...errors import OutputError, SceneError
from ...progress import Progress, part, silent
from ...storage.files import replace_file
from ..formats.colmap_records import check_records
from ..photos.focal import exif_focal
from ..photos.photo import DECODE_ERRORS, read_header
from ..photos.picture_file import convert_to_rgb, list_files, open_picture
from .job import FOUND, LEAST_PHOTOS, Copy, Job

PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".heic", ".heif", ".bmp"}
_MODEL, _WORK = "model", "work"
_ENLARGED, _LARGEST_SCALE = 270_000, 2.0
"""Photos of fewer pixels are enlarged to this many, at most by this factor: SIFT finds three times as many leaves."""


@dataclass(frozen=True, kw_only=True)
class FoundPoses:
    """A model of photos: its folder; messages for the user; whether it was in the cache."""

    model: Path
    notices: Sequence[str]
    reused: bool


def list_photos(folder: Path) -> list[Path]:
    """The photos directly in a folder, in name order; [] if the folder does not exist."""
    return list_files(folder, PHOTO_SUFFIXES)


def find_poses(
    photos: Path,
    out: Path,
    config: PhotosConfig = PhotosConfig(),  # noqa: B008 (frozen)
    *,
    threads: int | None = None,
    progress: Progress = silent,
) -> FoundPoses:
    """Estimate the cameras of the photos in the folder `photos` and write a COLMAP model (binary) to `out`/model.

    SIFT features, matching of neighbours in name order and of photos with similar content, incremental mapping, a
    refinement on points that are followed through all near photos, which also places missing ones, then points of
    surfaces by stereo; all in a child process that a cancel ends at once.
    Photos of one size share a SIMPLE_RADIAL camera unless EXIF gives them other focal lengths. EXIF orientation is
    ignored, as COLMAP does, except that photos of several orientations are not assumed to be upright; masks are not
    used.

    threads: all cores if not given; they need memory, and do not change the result.

    The model's frame and scale are arbitrary; names and pixels are those of the photos. Equal photos, settings and
    versions give equal models. `out` is for one set of photos and settings: a finished model in it is returned
    unchanged, and an interrupted run continues with its features and matches (mapping starts again). The model is
    written atomically.

    Raises:
        SceneError: fewer than 3 photos, one that cannot be decoded, no two that match, fewer than half of the photos
            (or than 3) in the largest model, or pycolmap missing or failing.
        OutputError: `out` cannot be written.
        Cancelled: `progress` asked for it.
    """
    files = list_photos(photos)
    if len(files) < LEAST_PHOTOS:
        raise SceneError(f"{photos} has {len(files)} photos. Take at least {LEAST_PHOTOS}, better 40, around the tree")
    orientations = {read_header(file).orientation for file in files}
    if len(orientations) > 1:
        config = dataclasses.replace(config, upright=False)
    model, work = out / _MODEL, out / _WORK
    reused = (model / FOUND).is_file()
    if not reused:
        try:
            _make_model(files, work, config, threads or usable_cores(), progress)
            os.replace(work / _MODEL, model)
            shutil.rmtree(work, ignore_errors=True)
        except OSError as error:
            raise OutputError(f"{out} cannot be written ({error.strerror or error}). Free space there") from error
    return FoundPoses(model=model, notices=_notices(files, model), reused=reused)


def _make_model(files: Sequence[Path], work: Path, config: PhotosConfig, threads: int, progress: Progress) -> None:
    (work / "copies").mkdir(parents=True, exist_ok=True)
    copies = []
    for index, file in enumerate(files):
        progress(0.1 * index / len(files), f"reading photo {index + 1} of {len(files)}")
        # Neutral names: pycolmap's list of pairs is separated by spaces.
        copies.append(_copy(file, work / "copies" / f"{index:06d}.png", config.max_side))
    for folder in ("models", _MODEL):
        shutil.rmtree(work / folder, ignore_errors=True)
    job = Job(folder=str(work.resolve()), photos=copies, config=config, threads=threads)
    try:
        run_child("scene.sfm.mapping", [str(job.write())], work / "log.txt", part(progress, 0.1, 1.0))
    except ChildError as error:
        raise SceneError(f"No cameras were found for the photos in {files[0].parent}: {error}") from error
    count = check_records(work / _MODEL / "images.bin")
    if count < max(LEAST_PHOTOS, len(files) / 2):
        raise SceneError(
            f"Only {count} of the {len(files)} photos in {files[0].parent} fit together. Take more photos in smaller "
            "steps (5 to 10 degrees) around the tree, without wind, or give a COLMAP model of them"
        )


def _copy(file: Path, copy: Path, max_side: int) -> Copy:
    """Write a copy with sides of at most `max_side` pixels, unless it exists.

    Raises:
        SceneError: the photo cannot be decoded.
    """
    header = read_header(file)
    enlarged = min((_ENLARGED / (header.width * header.height)) ** 0.5, _LARGEST_SCALE)
    share = min(max(enlarged, 1.0), max_side / max(header.width, header.height))
    size = max(round(header.width * share), 1), max(round(header.height * share), 1)
    if not copy.is_file():
        try:
            with open_picture(file) as image:
                pixels = convert_to_rgb(image)
        except DECODE_ERRORS as error:
            raise SceneError(f"{file} cannot be decoded ({error}). Replace it, or save it as JPEG") from error
        with replace_file(copy) as temporary:
            pixels.resize(size, Image.Resampling.LANCZOS).save(temporary, compress_level=1)
    return Copy(
        name=file.name,
        width=header.width,
        height=header.height,
        copy=copy.name,
        copy_width=size[0],
        copy_height=size[1],
        focal=round(exif_focal(file) or 0.0, 2),
    )


def _notices(files: Sequence[Path], model: Path) -> list[str]:
    """Messages for the user about a model: photos left out, other models."""
    found = json.loads((model / FOUND).read_text(encoding="utf-8"))
    notices = []
    missing = sorted({file.name for file in files} - set(found["placed"]))
    if missing:
        notices.append(
            f"{len(missing)} of {len(files)} photos could not be registered and were left out, first {missing[0]}. "
            "Take more photos in that area"
        )
    if len(found["models"]) > 1:
        notices.append(
            f"the photos fall into {len(found['models'])} parts that do not fit together. The largest, "
            f"of {found['models'][0]} photos, was taken. Take photos that lead from one part to the other"
        )
    return notices
