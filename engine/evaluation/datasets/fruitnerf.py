"""FruitNeRF (Meyer et al. 2024): nerfstudio folders with one fruit mask per photo, and a mesh of the true fruit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config import SceneConfig
from ...errors import FormatError, SceneError, VocabularyError
from ...language.vocabulary import FRUITS, parse
from ...scene.camera import Camera
from ...scene.formats.transforms import extra_fields, find_named_files, read_transforms
from ...scene.photos.photo import FilePhoto, read_header
from .imported import ImportedTruth, assume_visible
from .wavefront import read_objects

FloatArray = NDArray[np.float64]

LAYOUT = "fruitnerf"
FIELD = "semantic_path"
FOLDER = "semantics"

_JPEG = (".jpg", ".jpeg")
_LEAST_HITS = 0.25
"""Least share of centres on fruit in the correct frame; leaves hide some, and few lie on fruit by accident."""

_LEAST_THICKNESS = 1e-3
"""Least extent of an object across, relative to its length, for it to be a body."""


@dataclass(frozen=True, eq=False)
class FruitMask:
    """The published fruit mask of one view, read when needed; name: of its photo in the scene."""

    name: str
    file: FilePhoto

    def pixels(self) -> NDArray[np.bool_]:
        """(H, W) True on fruit, resized and undistorted like the view's photo.

        Raises:
            SceneError: the file is gone or cannot be decoded.
        """
        grey = self.file.pixels().max(axis=2)
        # Masks are 0 and 255; a lossless one without values above 1 contains class numbers instead.
        top = 1 if self.file.path.suffix.lower() not in _JPEG and grey.max(initial=0) <= 1 else 255
        return 2 * grey.astype(np.int64) > top


def read_fruit_masks(path: Path, config: SceneConfig = SceneConfig()) -> list[FruitMask]:  # noqa: B008 (frozen)
    """The fruit masks of a transforms.json, one per view, in the order of `read_transforms` with the same config.

    A frame names its mask as `semantic_path`; otherwise masks are searched in `semantics/` next to the JSON, under the
    photos' names. nerfstudio's `mask_path` has another meaning: the pixels that may be used.

    Raises:
        SceneError: the scene cannot be read, a mask is missing or has another shape than its photo.
    """
    photos = [photo for photo in read_transforms(path, config).images if isinstance(photo, FilePhoto)]
    files = [_mask_header(photo, file) for photo, file in zip(photos, _mask_files(path, photos), strict=True)]
    return [FruitMask(photo.name, file) for photo, file in zip(photos, files, strict=True)]


def read_fruitnerf_truth(folder: Path, *, label: str | None = None, fruits: Path | None = None) -> ImportedTruth:
    """Read the true fruit of a synthetic tree: the objects of its .obj mesh, one each.

    The centre of a fruit is the centre of mass of its convex hull, its diameter that of the sphere of equal volume. The
    frame of the mesh is not published, so the masks decide among common rotations and scales: the one is used in which
    most centres lie on fruit. Without masks the mesh is used unchanged.

    label: of the fruit (default: the JSON's `semantics`); fruits: the mesh (default: the only .obj).

    Raises:
        SceneError: the photos, cameras or masks cannot be read.
        FormatError: there is no mesh or it is malformed, or its fruit lie on the masks in none of the frames.
    """
    mesh = fruits if fruits is not None else _only_mesh(folder)
    centers, diameters, names = _fruit_of(mesh)
    imported = ImportedTruth(
        layout=LAYOUT,
        label=_one_fruit(label if label is not None else _said_to_be(folder), folder),
        truth=assume_visible(centers, diameters),
        names=names,
    )
    scene = read_transforms(folder)
    if not _has_masks(folder):
        return replace(imported, remarks=("no fruit masks: the frame of the mesh could not be checked",))
    masks = [mask.pixels() for mask in read_fruit_masks(folder)]
    frames = _frames()
    shares = [hit_share(centers @ frame.T, scene.cameras, masks) for frame in frames]
    best = int(np.argmax(shares))
    if not shares[best] >= _LEAST_HITS:
        raise FormatError(
            f"{mesh} could not be aligned with the masks of {folder} ({shares[best]:.0%} of centres at "
            "best). Expected the mesh of this tree: align it and give the aligned one"
        )
    frame = frames[best]
    scale = float(np.cbrt(np.linalg.det(frame)))
    return replace(
        imported,
        truth=assume_visible(centers @ frame.T, scale * diameters),
        remarks=(f"{shares[best]:.0%} of centres lie on the fruit masks, with the mesh {_said(best)}",),
    )


def hit_share(centers: FloatArray, cameras: Sequence[Camera], masks: Sequence[NDArray[np.bool_]]) -> float:
    """Share of the (M, 3) centres within pictures that lie on fruit; 0 if fewer than half are ever in a picture."""
    hits, within = 0, 0
    seen = np.zeros(len(centers), dtype=bool)
    for camera, mask in zip(cameras, masks, strict=True):
        pixels, depths = camera.project(centers)
        column, row = np.floor(pixels).T
        inside = (depths > 0.0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        hits += int(mask[row[inside].astype(np.int64), column[inside].astype(np.int64)].sum())
        within += int(inside.sum())
        seen |= inside
    return hits / within if within and seen.mean() >= 0.5 else 0.0


def _mask_files(path: Path, photos: Sequence[FilePhoto]) -> list[Path]:
    named = find_named_files(path, FIELD)
    if len(named) != len(photos):
        raise SceneError(f"{path}: has panoramas, which have no fruit masks. Expected plain photos")
    if not any(named):
        folder = (path if path.is_dir() else path.parent) / FOLDER
        by_stem = {file.stem: file for file in sorted(folder.glob("*")) if file.is_file()}
        named = [by_stem.get(photo.path.stem) for photo in photos]
    files = [file for file in named if file is not None]
    if len(files) < len(photos):
        missing = next(photo.name for photo, file in zip(photos, named, strict=True) if file is None)
        raise SceneError(f"{path}: {missing} has no fruit mask. Expected a {FIELD} a frame, or the folder {FOLDER}/")
    return files


def _has_masks(path: Path) -> bool:
    return any(find_named_files(path, FIELD)) or ((path if path.is_dir() else path.parent) / FOLDER).is_dir()


def _mask_header(photo: FilePhoto, file: Path) -> FilePhoto:
    header = read_header(file)
    shape, expected = (header.width, header.height), (photo.header.width, photo.header.height)
    if abs(shape[0] / expected[0] - shape[1] / expected[1]) > 1.0 / expected[0] + 1.0 / expected[1]:
        raise SceneError(
            f"Mask {file} has {shape[0]}x{shape[1]} pixels but its photo {expected[0]}x{expected[1]}. "
            "Expected one of the same shape"
        )
    return replace(photo, path=file, header=header, mask_path=None)


def _only_mesh(folder: Path) -> Path:
    base = folder if folder.is_dir() else folder.parent
    meshes = sorted(base.glob("*.obj"))
    if len(meshes) != 1:
        found = ", ".join(mesh.name for mesh in meshes) if meshes else "none"
        raise FormatError(
            f"{base}: expected one .obj with the true fruit, found {found}. Name it with --fruits (real trees have "
            "none: only their count is published)"
        )
    return meshes[0]


def _fruit_of(mesh: Path) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """Centres (M, 3), diameters (M,) and names of a mesh's objects, in the file's frame."""
    from trimesh.convex import convex_hull

    objects = read_objects(mesh)
    if not objects:
        raise FormatError(f"{mesh}: holds no vertex. Expected one object a fruit")
    centers, diameters = [], []
    for part in objects:
        spreads = np.linalg.svd(part.vertices - part.vertices.mean(axis=0), compute_uv=False)
        if len(spreads) < 3 or not spreads[2] > _LEAST_THICKNESS * spreads[0]:
            raise FormatError(f"{mesh}: object {part.name} is flat or a point. Expected a fruit's mesh")
        hull = convex_hull(part.vertices)
        centers.append(hull.center_mass)
        diameters.append(float(np.cbrt(6.0 * abs(hull.volume) / np.pi)))
    return np.array(centers, dtype=np.float64), np.array(diameters), tuple(part.name for part in objects)


def _frames() -> list[FloatArray]:
    """Possible transforms of the mesh into the frame of the cameras: unchanged or from y up to z up, at scale 1, 1/2 or
    2."""
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return [scale * turn for scale in (1.0, 0.5, 2.0) for turn in (np.eye(3), upright)]


def _said(frame: int) -> str:
    scale, turn = divmod(frame, 2)
    return f"{'turned from y up to z up' if turn else 'as it is'}, times {(1, 0.5, 2)[scale]:g}"


def _said_to_be(folder: Path) -> str:
    """The name in the JSON's `semantics` other than "stuff"; "" if there is not exactly one."""
    listed: Any = extra_fields(folder).get("semantics")
    entries = listed if isinstance(listed, list) else []
    words = [word for entry in entries for word in (entry if isinstance(entry, list) else [entry])]
    named = [word for word in words if isinstance(word, str) and word != "stuff"]
    return named[0] if len(named) == 1 else ""


def _one_fruit(word: str, folder: Path) -> str:
    """The vocabulary's word for a single kind of fruit; evaluate.py compares these."""
    try:
        concepts = parse(word).concepts if word else ()
    except VocabularyError:
        concepts = ()
    if len(concepts) != 1 or concepts[0] not in FRUITS:
        kinds = ", ".join(FRUITS)
        raise FormatError(f"{folder}: {word!r} is not one kind of fruit. Expected --label with one of {kinds}")
    return concepts[0]
