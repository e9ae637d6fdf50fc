"""COLMAP models, binary or text, with their photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config import SceneConfig
from ..errors import SceneError
from ..progress import Progress, silent
from .camera import FloatArray, Scene
from .lens import Lens
from .photo import PosedPhoto, make_scene, posed_photos
from .records import MODEL_FILES, RIG_FILES, check_binary, check_text

LAYOUTS = ("sparse", ".", "colmap/sparse")
"""Where a model lies in a scene's folder; numbered sub-models (`0`, `1`, …) inside each are looked at first."""


@dataclass(frozen=True)
class ModelFiles:
    """The files of one sparse model: folder, `.bin` or `.txt`, and how many images it says it has."""

    folder: Path
    suffix: str
    images: int

    def file(self, stem: str) -> Path:
        return self.folder / f"{stem}{self.suffix}"


def read_colmap(
    path: Path,
    config: SceneConfig = SceneConfig(),  # noqa: B008 - frozen
    *,
    images: Path | None = None,
    masks: Path | None = None,
    progress: Progress = silent,
) -> Scene:
    """Read a COLMAP model and the headers of its photos; pixels load when asked for, undistorted and resized.

    path: a folder with a model in `sparse/0`, `sparse`, itself or `colmap/sparse/0`; of several sub-models the one with
    the most images is taken (`progress` says which). images: the folder of the photos, by default `images` in the
    model's folder or in the nearest of the three above it. masks: a folder of masks by the same names (or with `.png`
    appended), black where a photo may not be used; by default `masks` beside the photos' folder, if there is one.

    The scene's cameras and photos are in name order, its points in id order (there may be none), its frame the model's,
    its scale unknown. Points that are not finite are left out (`progress` says how many).

    Raises:
        SceneError: no model, an incomplete, damaged or empty one, a pose that is not finite, a missing photo, or a
            photo of another shape than its camera.
    """
    path = Path(path)
    model = find_model(path, progress)
    if model is None:
        raise SceneError(
            f"{path} holds no COLMAP model (cameras, images and points3D as .bin or .txt) in sparse/0, sparse, itself or "
            "colmap/sparse/0; give a folder that does"
        )
    progress(0.0, f"reading {model.folder}")
    _check_files(model)
    reconstruction = _read(model)
    posed = sorted(
        ((image.name, reconstruction.cameras[image.camera_id], _world_to_camera(image, model)) for image in
         reconstruction.images.values() if image.has_pose),
        key=lambda entry: entry[0],
    )  # fmt: skip
    if not posed:
        raise SceneError(f"no image in {model.folder} has a pose; run COLMAP's mapper first")
    names = [name for name, _, _ in posed]
    photo_folder = images or _photo_folder(model.folder, names)
    photo_paths = _photo_paths(photo_folder, names)
    mask_paths = _mask_paths(masks, photo_folder, names)
    views: list[PosedPhoto] = []
    for index, (name, camera, world_to_camera) in enumerate(posed):
        progress(0.2 + 0.8 * index / len(posed), "reading photo headers")
        views += posed_photos(
            photo_paths[index],
            name=name,
            lens=Lens(camera.model_name, tuple(float(p) for p in camera.params), camera.width, camera.height),
            world_to_camera=world_to_camera,
            mask_path=mask_paths[index],
            downscale=config.downscale,
        )
    points, colors = _points(reconstruction, progress)
    return make_scene(views, points, colors)


def find_model(path: Path, progress: Progress = silent) -> ModelFiles | None:
    """The model in a scene's folder: the first layout of `LAYOUTS` that has one, its largest sub-model; None without.

    Raises:
        SceneError: a model lacks a file or its images file is damaged.
    """
    for layout in LAYOUTS:
        folder = path / layout
        numbered = sorted((f for f in folder.glob("*") if f.name.isdigit()), key=lambda f: int(f.name))
        models = [model for f in numbered if (model := _model_in(f))]
        if not models and (model := _model_in(folder)):
            models = [model]
        if models:
            largest = max(models, key=lambda m: m.images)
            if len(models) > 1:
                progress(0.0, f"{largest.folder} is the largest of {len(models)} models ({largest.images} images)")
            return largest
    return None


def _model_in(folder: Path) -> ModelFiles | None:
    for suffix in (".bin", ".txt"):
        found = [stem for stem in MODEL_FILES if (folder / f"{stem}{suffix}").is_file()]
        if len(found) == len(MODEL_FILES):
            check = check_binary if suffix == ".bin" else check_text
            return ModelFiles(folder, suffix, check(folder / f"images{suffix}"))
    for suffix in (".bin", ".txt"):
        missing = [stem for stem in MODEL_FILES if not (folder / f"{stem}{suffix}").is_file()]
        if 0 < len(missing) < len(MODEL_FILES) and (folder / f"cameras{suffix}").is_file():
            raise SceneError(f"{folder / (missing[0] + suffix)} is missing; copy the whole model")
    return None


def _check_files(model: ModelFiles) -> None:
    check = check_binary if model.suffix == ".bin" else check_text
    for stem in (*MODEL_FILES, *RIG_FILES):
        file = model.file(stem)
        if stem in RIG_FILES and not file.is_file():
            continue
        if check(file) == 0 and stem in ("cameras", "images"):
            raise SceneError(
                f"{file} is empty (0 {stem}); COLMAP found no reconstruction, take more overlapping photos"
            )


def _read(model: ModelFiles) -> Any:
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    try:
        (reconstruction.read_binary if model.suffix == ".bin" else reconstruction.read_text)(str(model.folder))
    except (ValueError, RuntimeError, KeyError, IndexError) as error:
        raise SceneError(f"{model.folder} cannot be read as a COLMAP model ({error}); export it again") from error
    return reconstruction


def _world_to_camera(image: Any, model: ModelFiles) -> FloatArray:
    pose = image.cam_from_world
    pose = pose() if callable(pose) else pose  # a property before pycolmap 3.12
    matrix = np.eye(4)
    matrix[:3] = pose.matrix()
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3]) - 1.0) > 1e-3:
        raise SceneError(
            f"the pose of {image.name} in {model.file('images')} is no rigid motion; export the model again"
        )
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


def _photo_folder(model: Path, names: Sequence[str]) -> Path:
    """The nearest `images` folder that has one of the photos, else the nearest `images` folder."""
    above = [model, *model.resolve().parents[:3]]
    folders = [folder / "images" for folder in above if (folder / "images").is_dir()]
    if not folders:
        raise SceneError(f"no folder images beside {model}; put the {len(names)} photos there or name their folder")
    return next((folder for folder in folders if any((folder / name).is_file() for name in names)), folders[0])


def _photo_paths(folder: Path, names: Sequence[str]) -> list[Path]:
    paths = [folder / name for name in names]
    missing = [path for path in paths if not path.is_file()]
    if missing:
        which = "none of the" if len(missing) == len(paths) else f"{len(missing)} of the"
        raise SceneError(
            f"{which} {len(paths)} photos of the model cannot be found; first {missing[0]}; put them there"
        )
    return paths


def _mask_paths(masks: Path | None, photo_folder: Path, names: Sequence[str]) -> list[Path | None]:
    """A mask file for each photo, None where there is none."""
    folder = masks or photo_folder.parent / "masks"
    paths: list[Path | None] = []
    for name in names:
        candidates = (folder / name, folder / f"{name}.png", (folder / name).with_suffix(".png"))
        paths.append(next((path for path in candidates if path.is_file()), None))
    if masks is not None and not any(paths):
        raise SceneError(f"{masks} has no mask for any photo; name them like the photos, or with .png appended")
    return paths
