"""COLMAP models, binary or text, with their photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config import SceneConfig
from ...errors import SceneError
from ...progress import Progress, silent
from ..camera import FloatArray, Scene
from ..photos.lens import Lens
from ..photos.photo import PosedPhoto, make_scene, read_posed_photos
from ..pycolmap_import import colmap_library
from .colmap_records import MODEL_FILES, RIG_FILES, check_records
from .layout import ModelFiles, find_model, mask_paths, photo_paths
from .missing_photos import note_missing


def read_colmap(
    path: Path,
    config: SceneConfig = SceneConfig(),  # noqa: B008 (frozen)
    *,
    images: Path | None = None,
    masks: Path | None = None,
    progress: Progress = silent,
) -> Scene:
    """Read a COLMAP model and the headers of its photos; pixels load on demand, undistorted and resized.

    path: a folder with a model in `sparse/0`, `sparse`, itself or `colmap/sparse/0`; of several sub-models the one with
    the most images is used (`progress` says which). images: the folder of the photos, by default the nearest `images`
    next to or above the model. masks: a folder of masks by the photos' names (or with `.png` appended), black where a
    photo may not be used; by default `masks` next to the photos' folder, if it exists.

    The scene's cameras and photos are in name order, its points in id order, its frame the model's, its scale unknown.
    A model without points gives a scene without points. Points that are not finite are left out (`progress` says how
    many), and so are images whose photo is missing.

    Raises:
        SceneError: no model, an incomplete, damaged or empty one, a pose that is not finite, too many missing
            photos, or a photo of another shape than its camera.
    """
    return open_colmap(Path(path), images=images, masks=masks, progress=progress).scene(config, progress)


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model read by pycolmap: its posed images whose photo is there, in name order, with their files; notices:
    messages for the user."""

    model: ModelFiles
    reconstruction: Any
    images: Sequence[Any]
    photos: Sequence[Path]
    masks: Sequence[Path | None]
    notices: Sequence[str] = ()

    def files(self) -> list[Path]:
        """Every file that the scene is read from: the model's, then photos and masks in name order."""
        stems = [stem for stem in (*MODEL_FILES, *RIG_FILES) if self.model.file(stem).is_file()]
        return [*map(self.model.file, stems), *self.photos, *(mask for mask in self.masks if mask)]

    def scene(self, config: SceneConfig, progress: Progress = silent) -> Scene:
        """The scene of the model; see `read_colmap`."""
        views: list[PosedPhoto] = []
        for index, image in enumerate(self.images):
            progress(0.2 + 0.8 * index / len(self.images), "reading photo headers")
            camera = self.reconstruction.cameras[image.camera_id]
            views += read_posed_photos(
                self.photos[index],
                name=image.name,
                lens=_lens(camera, self.model),
                world_to_camera=_world_to_camera(image, self.model),
                mask_path=self.masks[index],
                downscale=config.downscale,
                max_side=config.max_side,
            )
        points, colors = _points(self.reconstruction, progress)
        return make_scene(views, points, colors)


def open_colmap(
    path: Path, *, images: Path | None = None, masks: Path | None = None, progress: Progress = silent
) -> ColmapModel:
    """Read and check a COLMAP model and find its photos; arguments and errors as of `read_colmap`."""
    if not path.is_dir():
        raise SceneError(f"{path} is not a folder. Give the folder of a COLMAP model")
    files = find_model(path, progress)
    if files is None:
        raise SceneError(
            f"{path} holds no COLMAP model (cameras, images and points3D as .bin or .txt) in sparse/0, sparse, itself "
            "or colmap/sparse/0. Give a folder that does"
        )
    progress(0.0, f"reading {files.folder}")
    for stem in (*MODEL_FILES, *RIG_FILES):
        file = files.file(stem)
        if (stem in MODEL_FILES or file.is_file()) and check_records(file) == 0 and stem in ("cameras", "images"):
            raise SceneError(f"{file} is empty (0 {stem}). Reconstruct again from more or more overlapping photos")
    reconstruction = _read(files)
    try:
        posed = sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda i: i.name)
    except UnicodeDecodeError as error:
        file = files.file("images")
        raise SceneError(f"{file} has the image name {error.object!r}, which is not UTF-8. Rename it") from error
    names = [image.name for image in posed]
    if not names:
        raise SceneError(f"No image in {files.folder} has a pose. Reconstruct again from more overlapping photos")
    listed = photo_paths(files.folder, names, images)
    there = [path.is_file() for path in listed]
    notices = note_missing(files.file("images"), [path for path in listed if not path.is_file()], len(listed))
    posed, names, photos = (list(compress(each, there)) for each in (posed, names, listed))
    return ColmapModel(files, reconstruction, posed, photos, mask_paths(photos, names, masks), notices)


def _read(files: ModelFiles) -> Any:
    pycolmap = colmap_library()

    reconstruction = pycolmap.Reconstruction()
    try:
        (reconstruction.read_binary if files.suffix == ".bin" else reconstruction.read_text)(str(files.folder))
    except (ValueError, RuntimeError, LookupError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SceneError(f"{files.folder} is not a sound COLMAP model ({reason}). Export it again") from error
    return reconstruction


def _lens(camera: Any, files: ModelFiles) -> Lens:
    try:
        return Lens(camera.model.name, tuple(float(p) for p in camera.params), camera.width, camera.height)
    except SceneError as error:
        raise SceneError(f"Camera {camera.camera_id} in {files.file('cameras')}: {error}") from error


def _world_to_camera(image: Any, files: ModelFiles) -> FloatArray:
    pose = image.cam_from_world
    pose = pose() if callable(pose) else pose  # a property before pycolmap 3.12
    matrix = np.eye(4)
    matrix[:3] = pose.matrix()
    rotation = matrix[:3, :3]
    with np.errstate(all="ignore"):
        rigid = np.isfinite(matrix).all() and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3
    if not rigid:
        raise SceneError(f"The pose of {image.name} in {files.file('images')} is not a rigid motion. Export it again")
    return matrix


def _points(reconstruction: Any, progress: Progress) -> tuple[FloatArray, NDArray[np.uint8]]:
    """Finite points (P, 3) and their colours (P, 3), by id."""
    entries = sorted(reconstruction.points3D.items(), key=lambda entry: entry[0])
    points = np.array([point.xyz for _, point in entries], dtype=np.float64).reshape(-1, 3)
    colors = np.array([point.color for _, point in entries], dtype=np.uint8).reshape(-1, 3)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        progress(1.0, f"left out {(~finite).sum()} of {len(points)} points that are not finite")
    return points[finite], colors[finite]
