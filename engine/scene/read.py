"""One door for every kind of scene that can be read."""

from __future__ import annotations

from pathlib import Path

from ..config import SceneConfig
from ..errors import SceneError
from ..progress import Progress, silent
from .camera import Scene
from .colmap import find_model, read_colmap
from .transforms import read_transforms

_READ_TODAY = "read are a COLMAP model's folder, a folder with transforms.json, and an earlier result's folder"
_VIDEOS = {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts"}
_CLOUDS = {".ply", ".spz", ".las", ".laz", ".pcd", ".splat", ".e57"}
_PHOTOS = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".heic", ".dng"}


def read_scene(
    path: Path,
    config: SceneConfig = SceneConfig(),  # noqa: B008 - frozen
    *,
    images: Path | None = None,
    masks: Path | None = None,
    progress: Progress = silent,
) -> Scene:
    """Read a COLMAP model's folder or a `transforms.json` (itself or its folder); a model goes first where both are.

    images, masks: folders for a COLMAP model whose photos or masks lie elsewhere (see `read_colmap`).

    Raises:
        SceneError: there is nothing there, it is another kind of scene, or it is damaged.
    """
    path = Path(path)
    if not path.exists():
        raise SceneError(f"{path} does not exist; {_READ_TODAY}")
    if path.is_file():
        if path.suffix.lower() == ".json":
            return read_transforms(path, config, progress=progress)
        raise SceneError(f"{path} is {_kind(path)}; {_READ_TODAY}")
    if find_model(path) is not None:
        return read_colmap(path, config, images=images, masks=masks, progress=progress)
    if (path / "transforms.json").is_file():
        return read_transforms(path, config, progress=progress)
    photos = sum(1 for file in path.iterdir() if file.suffix.lower() in _PHOTOS)
    if photos:
        raise SceneError(f"{path} is a folder of {photos} photos without a model; {_READ_TODAY}")
    raise SceneError(f"{path} holds no model in sparse/0, sparse, itself or colmap/sparse/0; {_READ_TODAY}")


def _kind(file: Path) -> str:
    suffix = file.suffix.lower()
    for suffixes, kind in ((_VIDEOS, "a video"), (_CLOUDS, "a point cloud or splat"), (_PHOTOS, "a single photo")):
        if suffix in suffixes:
            return kind
    return "a file"
