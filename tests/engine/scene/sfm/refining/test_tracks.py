"""Patches are found to a fraction of a pixel, and points in all photos that show them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fruitlangs.engine.config import PhotosConfig
from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm.job import Copy, Job
from fruitlangs.engine.scene.sfm.kernels.patches import find_patches
from fruitlangs.engine.scene.sfm.refining.tracks import lengthen_tracks
from fruitlangs.engine.scene.sfm.views import read_pictures

WIDTH, HEIGHT, FOCAL = 200, 160, 400.0
STEP = 0.15
"""Distance between two cameras, in metres; the wall that they look at is 4 m away."""


def wall(x: np.ndarray, y: np.ndarray, seed: int = 0) -> np.ndarray:
    """Grey levels of a wall of smooth spots at places in metres."""
    generator = np.random.default_rng(seed)
    waves = generator.normal(0.0, 25.0, (40, 2))
    phases = generator.uniform(0.0, 2.0 * np.pi, 40)
    sums = sum(np.sin(a * x + b * y + phase) for (a, b), phase in zip(waves, phases, strict=True))
    return np.clip(128.0 + 14.0 * np.asarray(sums), 0.0, 255.0)


def picture(shift: tuple[float, float] = (0.0, 0.0), seed: int = 0) -> np.ndarray:
    """What a camera sees that moved sideways, in metres."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    x, y = (u - WIDTH / 2) * 4.0 / FOCAL + shift[0], (v - HEIGHT / 2) * 4.0 / FOCAL + shift[1]
    return np.rint(wall(x, y, seed)).astype(np.uint8)


def find(
    pictures: np.ndarray, center: np.ndarray, start: np.ndarray, affine: np.ndarray | None = None, reach: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Patches of the first picture in the second: places and correlations."""
    count = len(center)
    found, correlation = np.full((count, 2), np.nan), np.empty(count)
    turned = np.broadcast_to(np.eye(2) if affine is None else affine, (count, 2, 2)).copy()
    zeros = np.zeros(count, np.int64)
    find_patches(
        pictures, 6, zeros, center, np.arange(count + 1), zeros + 1, start, turned, reach, 2.0, found, correlation
    )
    return found, correlation


def grid(margin: float = 40.0, step: float = 20.0) -> np.ndarray:
    u, v = np.meshgrid(np.arange(margin, WIDTH - margin, step), np.arange(margin, HEIGHT - margin, step))
    return np.column_stack([u.ravel(), v.ravel()]) + 0.3


def test_a_patch_is_found_to_a_twentieth_of_a_pixel() -> None:
    moved = np.array([2.37, -1.62])
    both = np.stack([picture(), picture(tuple(-moved * 4.0 / FOCAL))])
    found, correlation = find(both, grid(), grid())
    assert correlation.min() > 0.98
    assert np.abs(found - grid() - moved).max() < 0.05


def test_a_turned_and_larger_patch_is_found() -> None:
    angle = np.radians(20.0)
    turn = 1.2 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    middle = np.array([WIDTH / 2, HEIGHT / 2])
    back = (np.stack([u, v], -1) - middle) @ np.linalg.inv(turn).T
    both = np.stack([picture(), np.rint(wall(back[..., 0] * 4 / FOCAL, back[..., 1] * 4 / FOCAL)).astype(np.uint8)])
    center = grid(60.0)
    expected = (center - middle) @ turn.T + middle
    found, correlation = find(both, center, expected + [1.4, -0.8], turn)
    assert correlation.min() > 0.97
    assert np.abs(found - expected).max() < 0.05
    unturned, less = find(both, center, expected)
    assert less.max() < correlation.min()
    assert np.abs(unturned - expected).max() > 0.1


@pytest.mark.parametrize("other", ["flat", "another wall"])
def test_what_another_picture_does_not_show_is_not_found(other: str) -> None:
    second = np.full((HEIGHT, WIDTH), 90, np.uint8) if other == "flat" else picture(seed=1)
    _, correlation = find(np.stack([picture(), second]), grid(), grid())
    assert (correlation > 0.85).mean() < 0.05


def test_a_flat_patch_and_one_beyond_the_edge_are_not_searched() -> None:
    flat = np.full((HEIGHT, WIDTH), 90, np.uint8)
    assert (find(np.stack([flat, picture()]), grid(), grid())[1] == -1.0).all()
    edge = np.array([[2.0, 50.0], [100.0, HEIGHT - 2.0], [np.nan, 50.0]])
    assert (find(np.stack([picture(), picture()]), edge, edge)[1] == -1.0).all()


def row_of_cameras(folder: Path, count: int, off: float) -> tuple[Job, Any, np.ndarray]:
    """Cameras in a row that look at the wall, and points on it that the two middle photos show.

    off: by how much each camera of the model is off its place, in metres. Also the true (count, N, 2) pixels.
    """
    pycolmap = colmap_library()
    (folder / "copies").mkdir(parents=True)
    names = [f"{i:06d}.png" for i in range(count)]
    copies = [
        Copy(name=name, width=WIDTH, height=HEIGHT, copy=name, copy_width=WIDTH, copy_height=HEIGHT, focal=0.0)
        for name in names
    ]
    job = Job(folder=str(folder), photos=copies, config=PhotosConfig(), threads=1)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, WIDTH, HEIGHT)
    model.add_camera_with_trivial_rig(camera)
    places = STEP * (np.arange(count) - (count - 1) / 2)
    middle = grid() - [WIDTH / 2, HEIGHT / 2]
    points = np.column_stack([middle * 4.0 / FOCAL, np.full(len(middle), 4.0)])
    pixels = np.stack([grid() - [place * FOCAL / 4.0, 0.0] for place in places])
    for i, (name, place) in enumerate(zip(names, places, strict=True)):
        Image.fromarray(picture((place, 0.0))).save(folder / "copies" / name)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-place - off * (-1) ** i, 0.0, 0.0]))
        image = pycolmap.Image(name=name, keypoints=pixels[i], camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pose)
    for k, point in enumerate(points):
        track = pycolmap.Track()
        for i in (count // 2 - 1, count // 2):
            track.add_element(i + 1, k)
        model.add_point3D(point, track)
    return job, model, pixels


def test_points_of_two_photos_are_followed_to_all_others_and_stay_at_their_places(tmp_path: Path) -> None:
    job, model, pixels = row_of_cameras(tmp_path, 7, off=0.01)  # a pixel
    longer = lengthen_tracks(job, model, read_pictures(job), reach=4)
    assert longer.num_points3D() == model.num_points3D()
    assert longer.compute_mean_track_length() > 6.0
    for k, (_, point) in enumerate(sorted(longer.points3D.items())):
        for element in point.track.elements:
            pixel = longer.images[element.image_id].points2D[element.point2D_idx].xy
            assert np.abs(pixel - pixels[element.image_id - 1, k]).max() < 0.1


def test_points_that_no_third_photo_shows_are_dropped(tmp_path: Path) -> None:
    job, model, _ = row_of_cameras(tmp_path, 4, off=0.0)
    pictures = read_pictures(job)
    pictures[[0, 3]] = 90
    assert lengthen_tracks(job, model, pictures, reach=4).num_points3D() == 0


def test_photos_of_several_sizes_are_compared(tmp_path: Path) -> None:
    job, model, pixels = row_of_cameras(tmp_path, 4, off=0.0)
    smaller = Copy(**{**vars(job.photos[3]), "copy_width": WIDTH - 60, "copy_height": HEIGHT - 30})
    job = Job(folder=job.folder, photos=[*job.photos[:3], smaller], config=job.config, threads=1)
    with Image.open(job.copies / smaller.copy) as image:
        image.crop((0, 0, WIDTH - 60, HEIGHT - 30)).save(job.copies / smaller.copy)
    pictures = read_pictures(job)
    assert pictures.shape == (4, HEIGHT, WIDTH)
    assert (pictures[3, HEIGHT - 30 :] == 0).all()
    longer = lengthen_tracks(job, model, pictures, reach=4)
    assert longer.images[4].num_points3D == (pixels[3] + 7 < [WIDTH - 60, HEIGHT - 30]).all(1).sum()
