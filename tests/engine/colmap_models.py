"""Tiny COLMAP models with photos, for tests of reading scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from fruitlangs.engine.scene.camera import look_along


def ring_of_poses(count: int, *, radius: float = 3.0, height: float = 0.5) -> list[np.ndarray]:
    """World-to-camera matrices (4, 4) of level cameras around the z axis (up), all looking at the origin."""
    poses = []
    for index in range(count):
        angle = 2.0 * np.pi * index / count
        center = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        poses.append(look_along(center, -center, np.array([0.0, 0.0, 1.0])))
    return poses


def write_photo(path: Path, width: int, height: int, seed: int = 0) -> None:
    """A photo of random pixels."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)


def write_model(
    root: Path,
    *,
    layout: str = "sparse/0",
    suffix: str = ".bin",
    images: int = 4,
    points: int = 5,
    model: str = "SIMPLE_PINHOLE",
    params: tuple[float, ...] = (20.0, 16.0, 12.0),
    names: tuple[str, ...] = (),
    photos: bool = True,
    rigs: bool = True,
) -> Path:
    """Write a model of a ring of 32x24 photos below `root` (photos in root/images); returns the model's folder."""
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=model, width=32, height=24, params=list(params))
    )
    names = names or tuple(f"photo_{index}.png" for index in range(images))
    for index, (name, pose) in enumerate(zip(names, ring_of_poses(len(names)), strict=True)):
        image = pycolmap.Image(
            name=name,
            camera_id=1,
            image_id=index + 1,
            points2D=pycolmap.Point2DList([pycolmap.Point2D(np.ones(2))] * 6),
        )
        reconstruction.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3])
        )
        if photos:
            write_photo(root / "images" / name, 32, 24, seed=index)
    for index in range(points):
        track = (
            pycolmap.Track([pycolmap.TrackElement(1, index), pycolmap.TrackElement(2, index)]) if images > 1 else None
        )
        color = np.array([10 * index, 100, 200], dtype=np.uint8)
        reconstruction.add_point3D(np.array([index, 0.5, -1.0]), track or pycolmap.Track(), color)
    folder = root / layout
    folder.mkdir(parents=True, exist_ok=True)
    (reconstruction.write_binary if suffix == ".bin" else reconstruction.write_text)(folder)
    if not rigs:
        for stem in ("rigs", "frames"):
            (folder / f"{stem}{suffix}").unlink()
    return folder
