"""Structure from motion by pycolmap, in a separate process (`child_process`): copies of photos → a COLMAP model."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...child_process import end_with_parent, give_up, tell
from ...config import PhotosConfig
from ...errors import OutputError
from ...progress import Progress, part
from ...storage.lock import only_writer
from ..pycolmap_import import colmap_library

JOB, FOUND = "job.json", "poses.json"
_BLOCK = 10
"""Pairs are matched in blocks of this many by this many photos: the work a cancel loses, and a step of the progress."""
_MOST_FEATURES = 8192
"""Features per photo."""
_FEW_PIXELS = 400_000
"""Copies with at most this many pixels get descriptors pooled over sizes: 4 times as long, and they join more
photos."""
_LARGEST_PATCH = 1.0
"""Largest region of a pooled descriptor, in sizes of the feature: beyond the edge of a leaf lies the background."""
_LOST = 10.0
"""A photo this many times farther from the middle than most photos, and than the scene, is misplaced."""
_LEAST_INLIERS = (20, 8)
"""Points needed to place a photo, in the first attempt, and in a second one if the first did not place `ENOUGH`."""
ENOUGH = 0.97
"""Share of the photos that is placed at the first attempt: a second one takes as long, and places few more."""


@dataclass(frozen=True, kw_only=True)
class Copy:
    """One photo to be placed: its name and size in pixels, its copy (grey, smaller), and its file for EXIF."""

    name: str
    width: int
    height: int
    copy: str
    copy_width: int
    copy_height: int
    file: str


@dataclass(frozen=True, kw_only=True)
class Job:
    """The job of the child: copies in `folder`/copies in name order; it writes `folder`/model."""

    folder: str
    photos: Sequence[Copy]
    config: PhotosConfig

    def write(self) -> Path:
        path = Path(self.folder) / JOB
        path.write_text(json.dumps(asdict(self)), encoding="utf-8")
        return path

    @classmethod
    def read(cls, path: Path) -> Job:
        document = json.loads(path.read_text(encoding="utf-8"))
        photos = [Copy(**photo) for photo in document["photos"]]
        return cls(folder=document["folder"], photos=photos, config=PhotosConfig(**document["config"]))

    @property
    def database(self) -> Path:
        return Path(self.folder) / "database.db"

    @property
    def copies(self) -> Path:
        return Path(self.folder) / "copies"


def main(arguments: Sequence[str]) -> None:
    """The child: from the job file to a model in its folder, or a one-line reason why there is none."""
    end_with_parent()
    job = Job.read(Path(arguments[0]))
    try:
        colmap_library()
        # The child of a killed run may still write to the database.
        with only_writer(Path(job.folder), Path(job.folder)):
            _list_photos(job)
            _find_features(job)
            _match(job)
            _map(job)
    except ImportError as error:
        give_up(f"pycolmap cannot be imported ({error}); install it: pip install pycolmap")
    except OutputError as error:
        give_up(str(error))


def _list_photos(job: Job) -> None:
    """Add the photos and their cameras to the database, unless an earlier run did.

    Photos of one size share a camera, unless EXIF gives them other focal lengths; without EXIF the focal length starts
    at 1.2 times the longer side.
    """
    pycolmap = colmap_library()
    database = _open(job)
    listed = database.num_images()
    database.close()
    if listed == len(job.photos):
        return
    job.database.unlink()
    _open(job).close()
    focals = {photo.copy: _focal(photo) for photo in job.photos}
    for group in _by_camera(job.photos, focals):
        width, height, focal = group[0].copy_width, group[0].copy_height, focals[group[0].copy]
        options = pycolmap.ImageReaderOptions()
        options.camera_model = "SIMPLE_RADIAL"
        if focal:
            options.camera_params = f"{focal},{width / 2},{height / 2},0"
        pycolmap.import_images(
            job.database, job.copies, pycolmap.CameraMode.SINGLE, [photo.copy for photo in group], options
        )


def _open(job: Job) -> Any:
    return colmap_library().Database.open(job.database)


def _focal(photo: Copy) -> float:
    """The focal length from EXIF, in pixels of the copy (rounded to 1 %); 0 without EXIF."""
    try:
        camera = colmap_library().infer_camera_from_image(photo.file)
    except (ValueError, RuntimeError):  # a format that pycolmap does not read
        return 0.0
    if not camera.has_prior_focal_length:
        return 0.0
    share = camera.focal_length / max(camera.width, camera.height)
    return round(share, 2) * max(photo.copy_width, photo.copy_height)


def _by_camera(photos: Sequence[Copy], focals: Mapping[str, float]) -> list[list[Copy]]:
    """Photos of one camera: of the same size, and with the same focal length if EXIF gives it."""

    def camera(photo: Copy) -> tuple[int, int, float]:
        return photo.width, photo.height, focals[photo.copy]

    return [list(group) for _, group in itertools.groupby(sorted(photos, key=camera), camera)]


def _find_features(job: Job) -> None:
    """SIFT for photos that have no features yet; tuned for leaves a few pixels wide in small photos."""
    pycolmap = colmap_library()
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False  # another device finds other features
    options.sift.max_num_features = _MOST_FEATURES
    options.sift.peak_threshold = 0.002
    options.sift.edge_threshold = 15.0
    options.sift.octave_resolution = 4
    options.sift.upright = job.config.upright
    options.sift.dsp_max_scale = _LARGEST_PATCH
    options.sift.domain_size_pooling = max(p.copy_width * p.copy_height for p in job.photos) <= _FEW_PIXELS
    names = [photo.copy for photo in job.photos]
    for start in range(0, len(names), _BLOCK):
        tell(0.3 * start / len(names), f"finding features: photo {start + 1} of {len(names)}")
        chunk = names[start : start + _BLOCK]
        pycolmap.extract_features(job.database, job.copies, chunk, pycolmap.CameraMode.AUTO, extraction_options=options)


def pairs_to_match(count: int, config: PhotosConfig) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of photos to match, by position in name order.

    All pairs up to `exhaustive_up_to` photos. Above it, every photo with the next `overlap` ones and, to close the
    loop, an evenly spread subset of photos that are all matched with each other.
    """
    if count <= config.exhaustive_up_to:
        return list(itertools.combinations(range(count), 2))
    near = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + config.overlap, count))}
    stride = -(-count // config.exhaustive_up_to)
    return sorted(near | set(itertools.combinations(range(0, count, stride), 2)))


def _match(job: Job) -> None:
    """Match and verify the pairs that are not in the database. Every pair has its own seed, so the order does not
    matter."""
    pycolmap = colmap_library()
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.guided_matching = True  # twice the matches among leaves
    matching.sift.max_ratio = 0.8
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = 10
    verification.ransac.random_seed = job.config.seed
    verification.ransac.max_error = 2.0
    verification.ransac.max_num_trials = 1500  # pairs without common content need all of them
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = Path(job.folder) / "pairs.txt"
    pairs = pairs_to_match(len(job.photos), job.config)
    pairs.sort(key=lambda pair: (pair[0] // _BLOCK, pair[1] // _BLOCK, pair))
    done = 0
    for _, block in itertools.groupby(pairs, lambda pair: (pair[0] // _BLOCK, pair[1] // _BLOCK)):
        tell(0.3 + 0.4 * done / len(pairs), f"matching photos: pair {done + 1} of {len(pairs)}")
        lines = [f"{job.photos[i].copy} {job.photos[j].copy}" for i, j in block]
        pairing.match_list_path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        pycolmap.match_image_pairs(job.database, matching, pairing, verification)
        done += len(lines)
    database = _open(job)
    verified = sum(1 for count in database.read_two_view_geometry_num_inliers()[1] if count)
    database.close()
    if not verified:
        give_up("no two photos show the same objects. Take photos in smaller steps, with 70 % overlap")


def _map(job: Job) -> None:
    """Place one photo after the other; write the largest model with the photos' own names, and a summary."""
    best = best_models(job)
    if not best:
        give_up("no two photos show enough of the same from two places; take more, in smaller steps around the tree")
    largest = best[0]
    _name_and_resize(largest, job.photos)
    folder = Path(job.folder) / "model"
    folder.mkdir(exist_ok=True)
    largest.write_binary(folder)
    placed = sorted(image.name for image in largest.images.values() if image.has_pose)
    found = {"placed": placed, "models": [model.num_reg_images() for model in best]}
    (folder / FOUND).write_text(json.dumps(found), encoding="utf-8")


def best_models(job: Job) -> list[Any]:
    """The models of the photos, largest first, of the attempt that placed most; the second is made only if the first
    placed less than `ENOUGH`."""
    best: list[Any] = []
    for attempt, least_inliers in enumerate(_LEAST_INLIERS):
        start = 0.7 + 0.3 * attempt / len(_LEAST_INLIERS)
        models = _models(job, least_inliers, part(tell, start, start + 0.3 / len(_LEAST_INLIERS)))
        if not best or (models and models[0].num_reg_images() > best[0].num_reg_images()):
            best = models
        if best and best[0].num_reg_images() >= ENOUGH * len(job.photos):
            break
    return best


def _models(job: Job, least_inliers: int, report: Progress) -> list[Any]:
    """The models of the photos, largest first, with at least this many points per placed photo."""
    pycolmap = colmap_library()
    registered = itertools.count(3)

    def count() -> None:
        number = min(next(registered), len(job.photos))
        report(number / len(job.photos), f"placing photos: {number} of {len(job.photos)}")

    folder = Path(job.folder) / "models"
    folder.mkdir(exist_ok=True)
    report(0.0, f"placing photos: 0 of {len(job.photos)}")
    options = _mapping_options(job.config, least_inliers)
    models = pycolmap.incremental_mapping(job.database, job.copies, folder, options, next_image_callback=count)
    for model in models.values():
        drop_lost(model)
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


def drop_lost(model: Any) -> None:
    """Remove photos from a model that are absurdly far away: distant objects alone, or noise, placed them."""
    placed = [image for image in model.images.values() if image.has_pose]
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    if not placed or not len(points):
        return
    centers = np.array([image.projection_center() for image in placed])
    middle = np.median(centers, axis=0)
    away = np.linalg.norm(centers - middle, axis=1)
    usual = max(np.percentile(away, 75), np.median(np.linalg.norm(points - middle, axis=1)))
    for image, distance in zip(placed, away, strict=True):
        if not distance <= _LOST * usual:  # NaN is removed too
            model.deregister_frame(image.frame_id)


def _mapping_options(config: PhotosConfig, least_inliers: int) -> Any:
    """COLMAP's options, relaxed for trees: few matches per pair, and most leaves visible in two photos only; one
    thread, seeded."""
    options = colmap_library().IncrementalPipelineOptions()
    options.num_threads = 1  # several sum in another order each time
    options.random_seed = config.seed
    options.min_model_size = 3
    options.min_num_matches = 8
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.random_seed = config.seed
    options.mapper.random_seed = config.seed
    options.mapper.num_threads = 1
    options.mapper.init_min_num_inliers = 50
    options.mapper.init_min_tri_angle = 8.0
    options.mapper.abs_pose_min_num_inliers = least_inliers
    options.mapper.abs_pose_min_inlier_ratio = 0.1
    options.mapper.abs_pose_max_error = 6.0
    options.mapper.filter_max_reproj_error = 2.0
    return options


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
