"""Nerfstudio's `transforms.json`: cameras with OpenGL axes, and an optional point cloud."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config import SceneConfig
from ...errors import SceneError
from ...progress import Progress, silent
from ..camera import FloatArray, Scene
from ..photos.lens import Lens
from ..photos.photo import PosedPhoto, make_scene, read_header, read_posed_photos
from .missing_photos import note_missing

TRANSFORMS = "transforms.json"

_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp", ".tif", ".tiff")
_DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # COLMAP's order in FULL_OPENCV
_FISHEYE = ("k1", "k2", "k3", "k4")
_GREY = 128


def read_transforms(
    path: Path,
    config: SceneConfig = SceneConfig(),  # noqa: B008 (frozen)
    *,
    progress: Progress = silent,
) -> Scene:
    """Read a `transforms.json` (its path or its folder's) and the headers of its photos.

    Intrinsics are `fl_x, fl_y, cx, cy, w, h` (or `camera_angle_x, camera_angle_y`) and `k1…, p1, p2`, a frame's own
    before the file's; `camera_model` OPENCV (the default), OPENCV_FISHEYE or EQUIRECTANGULAR. `transform_matrix` is
    camera to world with OpenGL axes (x right, y up, z backward). Photos, `mask_path` and `ply_file_path` are relative
    to the file; a photo may lack its extension. Frames whose photo is missing are left out. The scene's frame is the
    file's; without a point cloud it has no points.

    Raises:
        SceneError: the file is missing or malformed, has no frames, a pose is no rigid motion, or too many photos are
            missing.
    """
    return open_transforms(Path(path)).scene(config, progress)


def find_named_files(path: Path, key: str) -> list[Path | None]:
    """Find the file that each frame names under `key`, in the order of `read_transforms`; None without one.

    Raises:
        SceneError: as `open_transforms`, or such a file is missing.
    """
    source = open_transforms(Path(path))
    return [_find_named_file(frame.values, key, source.file) for frame in source.frames]


def extra_fields(path: Path) -> Mapping[str, Any]:
    """The entries of the JSON other than frames.

    Raises:
        SceneError: the JSON is missing or malformed.
    """
    content = _read_json(path / TRANSFORMS if path.is_dir() else path)
    return {key: value for key, value in content.items() if key != "frames"}


@dataclass(frozen=True, eq=False)
class _Frame:
    """One entry of `frames`; its own values override those of the file."""

    name: str
    values: Mapping[str, Any]
    photo: Path
    mask: Path | None


@dataclass(frozen=True, eq=False)
class Transforms:
    """A transforms.json with the files it names; frames whose photo is there, in name order; notices: messages for the
    user."""

    file: Path
    frames: Sequence[_Frame]
    cloud: Path | None
    notices: Sequence[str] = ()

    def files(self) -> list[Path]:
        """Every file that the scene is read from: the JSON, the point cloud, then photos and masks in name order."""
        clouds = [] if self.cloud is None else [self.cloud]
        photos = [frame.photo for frame in self.frames]
        return [self.file, *clouds, *photos, *(frame.mask for frame in self.frames if frame.mask)]

    def scene(self, config: SceneConfig, progress: Progress = silent) -> Scene:
        """The scene that the file describes; see `read_transforms`."""
        views: list[PosedPhoto] = []
        for index, frame in enumerate(self.frames):
            progress(index / len(self.frames), "reading photo headers")
            views += read_posed_photos(
                frame.photo,
                name=frame.name,
                lens=_lens(frame.values, frame.photo, f"{self.file}, {frame.name}"),
                world_to_camera=_world_to_camera(frame.values, f"{self.file}, {frame.name}"),
                mask_path=frame.mask,
                downscale=config.downscale,
                max_side=config.max_side,
            )
        points, colors = _no_cloud() if self.cloud is None else _cloud(self.cloud)
        return make_scene(views, points, colors)


def open_transforms(path: Path) -> Transforms:
    """Read a transforms.json (its path or its folder's) and find the files it names.

    Raises:
        SceneError: the JSON is missing or malformed, or a file that it names is missing; of the photos, too many.
    """
    file = path / TRANSFORMS if path.is_dir() else path
    content = _read_json(file)
    entries = content.pop("frames", None)
    if not isinstance(entries, list) or not entries:
        raise SceneError(f"{file} has no frames. Give a transforms.json with at least one posed photo")
    named = sorted(((_frame_name(entry, index, file), index) for index, entry in enumerate(entries)))
    photos = [_photo_path(file.parent / name) for name, _ in named]
    missing = [file.parent / name for (name, _), photo in zip(named, photos, strict=True) if photo is None]
    notices = note_missing(file, missing, len(named))
    frames = [
        _Frame(
            name=name.removeprefix("./"),
            values={**content, **entries[index]},
            photo=photo,
            mask=_find_named_file(entries[index], "mask_path", file),
        )
        for (name, index), photo in zip(named, photos, strict=True)
        if photo is not None
    ]
    return Transforms(file=file, frames=frames, cloud=_find_named_file(content, "ply_file_path", file), notices=notices)


def _read_json(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError(f"{file} cannot be read ({error.strerror}). Give a folder with a transforms.json") from error
    except ValueError as error:
        raise SceneError(f"{file} is not JSON ({error}). Export it again") from error
    if not isinstance(content, dict):
        raise SceneError(f"{file} is not a transforms.json: it holds no object. Export it again")
    return content


def _frame_name(frame: Any, index: int, file: Path) -> str:
    name = frame.get("file_path") if isinstance(frame, dict) else None
    if not isinstance(name, str) or not name:
        raise SceneError(f"{file}: frame {index} has no file_path. Export it again")
    return name.replace("\\", "/")


def _photo_path(path: Path) -> Path | None:
    """The photo at `path`, which may lack its extension; None if it is missing."""
    candidates = [path, *(path.with_name(path.name + suffix) for suffix in _SUFFIXES)]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _find_named_file(values: Mapping[str, Any], key: str, file: Path) -> Path | None:
    """Find the file that `values[key]` names, relative to the JSON; None without one."""
    if not values.get(key):
        return None
    path = file.parent / str(values[key]).replace("\\", "/")
    if not path.is_file():
        raise SceneError(f"{path} cannot be found. Put it there or take {key} out of {file}")
    return path


def _lens(values: Mapping[str, Any], photo: Path, where: str) -> Lens:
    def number(key: str) -> float:
        try:
            return float(values[key])
        except (TypeError, ValueError):
            raise SceneError(f"{where}: {key} is {values[key]!r}, not a number. Export it again") from None

    if "w" in values and "h" in values:
        width, height = int(number("w")), int(number("h"))
    else:
        header = read_header(photo)
        width, height = header.width, header.height
    model = values.get("camera_model", "OPENCV")
    if model == "EQUIRECTANGULAR":
        return Lens(model, (float(width), float(height)), width, height)
    if "fl_x" in values:
        fx = number("fl_x")
    elif "camera_angle_x" in values:
        fx = 0.5 * width / np.tan(0.5 * number("camera_angle_x"))
    else:
        raise SceneError(f"{where} has neither fl_x nor camera_angle_x. Export it with intrinsics")
    if "fl_y" in values:
        fy = number("fl_y")
    else:
        fy = 0.5 * height / np.tan(0.5 * number("camera_angle_y")) if "camera_angle_y" in values else fx
    cx = number("cx") if "cx" in values else width / 2
    cy = number("cy") if "cy" in values else height / 2
    if model not in ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        raise SceneError(f"{where} has the camera_model {model!r}. Known are OPENCV, OPENCV_FISHEYE, EQUIRECTANGULAR")
    fisheye = model == "OPENCV_FISHEYE"
    distortion = tuple(number(key) if key in values else 0.0 for key in (_FISHEYE if fisheye else _DISTORTION))
    if fisheye:
        return Lens("OPENCV_FISHEYE", (fx, fy, cx, cy, *distortion), width, height)
    if not any(distortion):
        return Lens("PINHOLE", (fx, fy, cx, cy), width, height)
    return Lens("FULL_OPENCV", (fx, fy, cx, cy, *distortion), width, height)


def _world_to_camera(frame: Mapping[str, Any], where: str) -> FloatArray:
    try:
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
    except (KeyError, TypeError, ValueError):
        matrix = np.zeros((0, 0))
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise SceneError(f"{where} has no transform_matrix of 4x4 finite numbers. Export it again")
    u, s, vt = np.linalg.svd(matrix[:3, :3])
    if np.linalg.det(matrix[:3, :3]) <= 0.0 or np.abs(s - 1.0).max() > 1e-2:
        raise SceneError(f"{where}: transform_matrix is not a rigid motion (it scales or mirrors). Export it again")
    camera_axes = u @ vt * [1.0, -1.0, -1.0]  # OpenGL's y up, z backward to y down, z forward
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = camera_axes.T
    world_to_camera[:3, 3] = -camera_axes.T @ matrix[:3, 3]
    return world_to_camera


def _no_cloud() -> tuple[FloatArray, NDArray[np.uint8]]:
    return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8)


def _cloud(path: Path) -> tuple[FloatArray, NDArray[np.uint8]]:
    """(P, 3) finite points and their (P, 3) colours (grey if the file has none)."""
    from plyfile import PlyData, PlyParseError

    try:
        vertex = PlyData.read(str(path))["vertex"].data
        points = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
    except (OSError, PlyParseError, KeyError, ValueError) as error:
        raise SceneError(f"{path} cannot be read as a point cloud ({error}). Export it again") from error
    if {"red", "green", "blue"} <= set(vertex.dtype.names):
        colors = np.stack([vertex[channel] for channel in ("red", "green", "blue")], axis=1).astype(np.uint8)
    else:
        colors = np.full((len(points), 3), _GREY, dtype=np.uint8)
    finite = np.isfinite(points).all(axis=1)
    return points[finite], colors[finite]
