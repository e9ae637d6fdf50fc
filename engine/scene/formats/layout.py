"""Locations of a COLMAP model, its photos and its masks in a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...errors import SceneError
from ...progress import Progress, silent
from .colmap_records import MODEL_FILES, check_records

LAYOUTS = ("sparse", ".", "colmap/sparse")
"""Locations of a model in a scene's folder; numbered sub-models (`0`, `1`, …) inside each come first."""


@dataclass(frozen=True)
class ModelFiles:
    """The files of one sparse model: its folder, and `.bin` or `.txt`."""

    folder: Path
    suffix: str

    def file(self, stem: str) -> Path:
        return self.folder / f"{stem}{self.suffix}"


def find_model(path: Path, progress: Progress = silent) -> ModelFiles | None:
    """The model in a scene's folder: the first layout of `LAYOUTS` that has one, its largest sub-model; None without.

    Binary files are preferred to text files. `progress` reports which of several sub-models is used.

    Raises:
        SceneError: a model lacks a file, or one of several has a damaged images file.
    """
    for layout in LAYOUTS:
        folder = path / layout
        numbered = sorted((f for f in folder.glob("*") if f.name.isdecimal()), key=lambda f: int(f.name))
        models = [model for f in [*numbered, folder] if (model := _model_in(f))]
        if models:
            if len(models) == 1:
                return models[0]
            images = {model: check_records(model.file("images")) for model in models}
            largest = max(models, key=images.__getitem__)
            progress(0.0, f"{largest.folder} is the largest of {len(models)} models ({images[largest]} images)")
            return largest
    return None


def _model_in(folder: Path) -> ModelFiles | None:
    for suffix in (".bin", ".txt"):
        missing = [stem for stem in MODEL_FILES if not (folder / f"{stem}{suffix}").is_file()]
        if not missing:
            return ModelFiles(folder, suffix)
        if suffix == ".bin" and len(missing) < len(MODEL_FILES) and not (folder / "images.txt").is_file():
            raise SceneError(f"{folder / (missing[0] + suffix)} is missing. Copy the whole model")
    if len(missing) < len(MODEL_FILES):
        raise SceneError(f"{folder / (missing[0] + suffix)} is missing. Copy the whole model")
    return None


def photo_paths(model: Path, names: Sequence[str], images: Path | None) -> list[Path]:
    """Where the photos of a model are expected: in `images` or in the nearest folder of that name next to or above the
    model.

    Raises:
        SceneError: there is no such folder.
    """
    folder = images or _photo_folder(model, names)
    return [folder / name for name in names]


def _photo_folder(model: Path, names: Sequence[str]) -> Path:
    """The nearest folder `images` that contains one of the photos, else the nearest, at most three levels up."""
    above = [model, *model.resolve().parents[:3]]
    folders = [folder / "images" for folder in above if (folder / "images").is_dir()]
    if not folders:
        raise SceneError(f"No folder images next to {model}. Put the model's {len(names)} photos there")
    return next((folder for folder in folders if any((folder / name).is_file() for name in names)), folders[0])


def mask_paths(photos: Sequence[Path], names: Sequence[str], masks: Path | None) -> list[Path | None]:
    """One mask per photo, None without one: the same name, or with .png appended or as its suffix.

    Raises:
        SceneError: `masks` is given and has no mask at all.
    """
    folder = masks or photos[0].parents[len(Path(names[0]).parts) - 1].parent / "masks"
    paths: list[Path | None] = []
    for name in names:
        candidates = (folder / name, folder / f"{name}.png", (folder / name).with_suffix(".png"))
        paths.append(next((path for path in candidates if path.is_file()), None))
    if masks is not None and not any(paths):
        raise SceneError(f"{masks} has no mask for any photo. Name masks like the photos, or with .png appended")
    return paths
