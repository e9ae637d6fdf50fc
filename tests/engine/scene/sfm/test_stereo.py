"""Surfaces get points where photos agree on them, and nowhere else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from PIL import Image

from fruitlangs.engine.config import PhotosConfig
from fruitlangs.engine.progress import silent
from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm.job import Copy, Job
from fruitlangs.engine.scene.sfm.stereo import add_surfaces

from .refining.test_tracks import wall

WIDTH, HEIGHT, FOCAL, DISTANCE, STEP, CAMERAS = 300, 240, 400.0, 4.0, 0.3, 6
"""Cameras in a row, `STEP` apart, that look at a surface `DISTANCE` ahead, in metres."""
KNOWN_ABOVE = 0.4
"""The model has points in this share of the pictures, from their upper border."""


def rays() -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    return (u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL


def depth(y: np.ndarray, steep: float) -> np.ndarray:
    """Of a surface that rises by `steep` metres a metre towards the camera, like ground seen from above."""
    return DISTANCE / (1.0 + steep * y)


def shown(camera: Any, pose: Any, steep: float, seed: int = 0) -> np.ndarray:
    """What a camera shows of the surface, of the size WIDTH × HEIGHT."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = np.asarray(camera.cam_from_img(np.column_stack([u.ravel(), v.ravel()]) * camera.width / WIDTH))
    ahead = np.column_stack([rays, np.ones(len(rays))]) @ pose.rotation.matrix()
    center = pose.inverse().translation
    away = (DISTANCE - center @ [0.0, steep, 1.0]) / (ahead @ [0.0, steep, 1.0])
    x, y, _ = (center + ahead * away[:, None]).T
    return np.rint(wall(x, y, seed)).astype(np.uint8).reshape(HEIGHT, WIDTH)


def scene(
    folder: Path, steep: float, seeds: Sequence[int | None] = (0,) * CAMERAS, scale: int = 1, turned: bool = False
) -> tuple[Job, Any]:
    """Photos of a surface with their true cameras, and with points in its upper part only.

    seeds: of what each photo shows, None for a plain picture; scale: by how much the photos are larger; turned: cameras
    are turned by some degrees, and their lens has distortion.
    """
    pycolmap = colmap_library()
    (folder / "copies").mkdir(parents=True)
    names = [f"{i:06d}.png" for i in range(CAMERAS)]
    size = {"copy_width": scale * WIDTH, "copy_height": scale * HEIGHT}
    copies = [Copy(name=name, width=WIDTH, height=HEIGHT, copy=name, focal=0.0, **size) for name in names]
    job = Job(folder=str(folder), photos=copies, config=PhotosConfig(), threads=1)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", scale * FOCAL, scale * WIDTH, scale * HEIGHT)
    camera.params = [*camera.params[:3], -0.1 if turned else 0.0]
    model.add_camera_with_trivial_rig(camera)
    x, y = (each[10 : int(KNOWN_ABOVE * HEIGHT) : 12, 80:-80:12].ravel() for each in rays())
    points = np.column_stack([x, y, np.ones(len(x))]) * depth(y, steep)[:, None]
    for i, (name, seed) in enumerate(zip(names, seeds, strict=True)):
        roll, pan = np.radians([4.0 * i - 10.0, 2.0 * (-1) ** i]) if turned else (0.0, 0.0)
        turn = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
        turn = turn @ [[np.cos(pan), 0.0, -np.sin(pan)], [0.0, 1.0, 0.0], [np.sin(pan), 0.0, np.cos(pan)]]
        center = np.array([STEP * (i - (CAMERAS - 1) / 2), 0.0, 0.0])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ center)
        picture = np.full((HEIGHT, WIDTH), 90, np.uint8) if seed is None else shown(camera, pose, steep, seed)
        Image.fromarray(picture).resize((scale * WIDTH, scale * HEIGHT)).save(folder / "copies" / name)
        pixels = np.asarray(camera.img_from_cam(pose * points))
        image = pycolmap.Image(name=name, keypoints=pixels, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pose)
    for k, point in enumerate(points):
        track = pycolmap.Track()
        for i in range(CAMERAS):
            track.add_element(i + 1, k)
        model.add_point3D(point, track)
    return job, model


def places(model: Any) -> np.ndarray:
    return np.array([point.xyz for _, point in sorted(model.points3D.items())])


def off(points: np.ndarray, steep: float) -> np.ndarray:
    """Relative distance along the ray of points from the surface."""
    return np.abs(points[:, 2] / depth(points[:, 1] / points[:, 2], steep) - 1.0)


@pytest.mark.parametrize(("steep", "scale"), [(0.0, 1), (1.0, 1), (0.0, 3)])
def test_the_part_of_a_surface_without_points_gets_points_on_the_surface(
    tmp_path: Path, steep: float, scale: int
) -> None:
    job, model = scene(tmp_path, steep, scale=scale)
    known = places(model)
    points = places(add_surfaces(job, model, silent))
    assert np.allclose(points[: len(known)], known)
    new = points[len(known) :]
    assert (off(new, steep) < 0.01).mean() > 0.85
    y = new[:, 1] / new[:, 2] * FOCAL + HEIGHT / 2
    assert (y > KNOWN_ABOVE * HEIGHT).sum() > 60
    assert y.max() > 0.85 * HEIGHT


def test_turned_cameras_and_distortion_change_nothing(tmp_path: Path) -> None:
    job, model = scene(tmp_path, 0.5, turned=True)
    new = places(add_surfaces(job, model, silent))[model.num_points3D() :]
    assert len(new) > 100
    assert (off(new, 0.5) < 0.01).mean() > 0.85


def test_new_points_are_seen_where_the_photos_show_them(tmp_path: Path) -> None:
    job, model = scene(tmp_path, 0.0)
    filled = add_surfaces(job, model, silent)
    errors = []
    for _, point in sorted(filled.points3D.items())[model.num_points3D() :]:
        assert point.track.length() >= 2
        for element in point.track.elements:
            image = filled.images[element.image_id]
            errors.append(image.points2D[element.point2D_idx].xy - image.project_point(point.xyz))
    assert np.abs(errors).max() < 1e-6


def test_new_points_are_apart_from_known_ones_and_from_each_other(tmp_path: Path) -> None:
    job, model = scene(tmp_path, 0.0)
    points = places(add_surfaces(job, model, silent))
    apart = np.linalg.norm(points[:, None] - points, axis=2) + 1e9 * np.eye(len(points))
    assert apart[model.num_points3D() :].min() > 5 * DISTANCE / FOCAL


@pytest.mark.parametrize(("seeds", "chance"), [([None] * CAMERAS, 0.0), (range(CAMERAS), 0.008)])
def test_what_photos_do_not_agree_on_gets_hardly_any_points(
    tmp_path: Path, seeds: Sequence[int | None], chance: float
) -> None:
    job, model = scene(tmp_path, 0.0, seeds)
    new = add_surfaces(job, model, silent).num_points3D() - model.num_points3D()
    assert new <= chance * CAMERAS * WIDTH * HEIGHT / 8**2


def test_the_number_of_threads_does_not_change_the_points(tmp_path: Path) -> None:
    job, model = scene(tmp_path, 1.0)
    before = numba.get_num_threads()
    found = []
    for threads in (1, min(2, before)):
        numba.set_num_threads(threads)
        found.append(places(add_surfaces(job, model, silent)))
    numba.set_num_threads(before)
    assert np.array_equal(*found)


def test_three_photos_are_enough(tmp_path: Path) -> None:
    job, model = scene(tmp_path, 0.0)
    for number in (1, 5, 6):
        model.deregister_frame(model.images[number].frame_id)
    assert add_surfaces(job, model, silent).num_points3D() > model.num_points3D() + 30


def test_a_lens_whose_distortion_has_no_inverse_at_the_border_gives_points_elsewhere(tmp_path: Path) -> None:
    job, model = scene(tmp_path, 0.0)
    model.cameras[1].params = [0.6 * WIDTH, WIDTH / 2, HEIGHT / 2, -0.3]
    assert np.isnan(model.cameras[1].cam_from_img(np.array([[1.0, 1.0]]))).any()
    assert np.isfinite(places(add_surfaces(job, model, silent))).all()


def test_a_model_without_points_stays_as_it_is(tmp_path: Path) -> None:
    job, model = scene(tmp_path, 0.0)
    for number in list(model.points3D):
        model.delete_point3D(number)
    assert add_surfaces(job, model, silent).num_points3D() == 0
