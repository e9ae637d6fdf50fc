"""Structure from motion in a separate process (`child_process`): copies of photos → a COLMAP model."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...child_process import end_with_parent, give_up, tell
from ...errors import OutputError
from ...progress import part
from ...storage.lock import hold_lock
from ..pycolmap_import import colmap_library
from .features import add_photos, find_features, read_features
from .job import FOUND, Copy, Job
from .pairs import match_photos, read_verified_pairs
from .placing import register_photos
from .refining.refinement import refine
from .stereo import add_surfaces


def main(arguments: Sequence[str]) -> None:
    """The child: from the job file to a model in its folder, or a one-line reason why there is none."""
    end_with_parent()
    job = Job.read(Path(arguments[0]))
    try:
        colmap_library()
        # The child of a killed run may still write to the database.
        with hold_lock(Path(job.folder), Path(job.folder)):
            find_model(job)
    except ImportError as error:
        give_up(f"pycolmap cannot be imported ({error}); install it: pip install pycolmap")
    except OutputError as error:
        give_up(str(error))


def find_model(job: Job) -> None:
    """Features, matches, placed photos, refined cameras, points of surfaces; writes the largest model and a summary."""
    seconds: dict[str, float] = {}

    def time_stage(stage: str, work: Callable[..., Any], *arguments: Any) -> Any:
        start = time.perf_counter()
        result = work(*arguments)
        seconds[stage] = round(time.perf_counter() - start, 2)
        return result

    add_photos(job)
    time_stage("features", find_features, job, part(tell, 0.0, 0.2))
    features = read_features(job)
    time_stage("matching", match_photos, job, features, part(tell, 0.2, 0.5))
    pairs = len(read_verified_pairs(job))
    if not pairs:
        give_up("no two photos show the same objects. Take photos in smaller steps, with 70 % overlap")
    models = time_stage("placing", register_photos, job, features, part(tell, 0.5, 0.8))
    if not models:
        give_up("no two photos show enough of the same from two places; take more, in smaller steps around the tree")
    refined = time_stage("refining", refine, job, features, models, part(tell, 0.8, 0.95))
    best = time_stage("surfaces", add_surfaces, job, refined, part(tell, 0.95, 1.0))
    _write(job, best, {"models": part_sizes(best, models[1:]), "pairs": pairs, "seconds": seconds})


def part_sizes(model: Any, others: Sequence[Any]) -> list[int]:
    """The number of photos of a model, and of each other one that has photos which the model lacks."""
    placed = set(model.reg_image_ids())
    return [len(placed), *(each.num_reg_images() for each in others if not placed.issuperset(each.reg_image_ids()))]


def _write(job: Job, model: Any, summary: Mapping[str, Any]) -> None:
    """The model with the photos' own names and sizes, and a summary for `find_cameras`."""
    model.extract_colors_for_all_images(job.copies)
    _name_and_resize(model, job.photos)
    folder = Path(job.folder) / "model"
    folder.mkdir(exist_ok=True)
    model.write_binary(folder)
    placed = sorted(image.name for image in model.images.values() if image.has_pose)
    (folder / FOUND).write_text(json.dumps({"placed": placed, **summary}), encoding="utf-8")


def _name_and_resize(model: Any, photos: Sequence[Copy]) -> None:
    """Restore the photos' own names and sizes in a model of the copies."""
    by_copy = {photo.copy: photo for photo in photos}
    sizes = {}
    for image in model.images.values():
        photo = by_copy[image.name]
        image.name = photo.name
        sizes[image.camera_id] = photo
        for point in image.points2D:
            point.xy = point.xy * [photo.width / photo.copy_width, photo.height / photo.copy_height]
    for camera_id, photo in sizes.items():
        model.cameras[camera_id].rescale(photo.width, photo.height)
