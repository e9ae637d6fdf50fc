"""The photos' cameras as Blender cameras."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import PurePath
from typing import TYPE_CHECKING

import bpy
import numpy as np
from mathutils import Matrix

from ..blender_data import ensure_owned_collection, find_original, find_owned_objects, make_object, remove_objects
from ..scene_frame import find_world_matrix, keep_pose
from .photo_files import ASPECT, FILE, LENS, PHOTO, SIZE, keep_photo, remove_backgrounds
from .write_root import find_focus

if TYPE_CHECKING:
    from ...engine.scene.camera import Camera, FloatArray, Photo, Scene

SENSOR_WIDTH = 36.0
"""Millimetres; only the ratio lens : sensor matters."""

BLENDER_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""COLMAP's camera looks along +z with y down, Blender's along -z with y up."""


def write_cameras(bpy_scene: bpy.types.Scene, scene: Scene, root: bpy.types.Object) -> list[bpy.types.Object]:
    """Write this Blender scene's photo cameras, into the existing one of each photo; without an active camera, one that
    shows the middle of the scene becomes active.

    A camera is named after its photo and stores in custom properties what is needed to show it (see `photo_files`).
    """
    earlier = _map_by_photo(find_owned_objects(bpy_scene, "camera"))
    # A scene read from a result whose photos are missing has cameras only.
    names = [photo.name for photo in scene.images] or [f"view {index + 1:03d}" for index in range(len(scene.cameras))]
    photos: list[Photo | None] = [*scene.images] or [None] * len(scene.cameras)
    objects = []
    for camera, photo, name in zip(scene.cameras, photos, names, strict=True):
        item = earlier.pop(name, None) or _make_camera(bpy_scene, scene, name, root)
        _write_camera(bpy_scene, item, camera, photo, root)
        objects.append(item)
    remove_backgrounds(earlier.values())
    remove_objects(earlier.values())
    if objects and bpy_scene.camera is None:
        show_through(bpy_scene, objects[find_middle_view(scene)])
    return objects


def _map_by_photo(items: Iterable[bpy.types.Object]) -> dict[str, bpy.types.Object]:
    """Return {photo: its camera}, without a photo by the name of the camera; copies of a camera are left to the
    user."""
    same: dict[str, list[bpy.types.Object]] = {}
    for item in items:
        same.setdefault(item.get(PHOTO) or item.name, []).append(item)
    found = {name: find_original(cameras) for name, cameras in same.items()}
    return {name: item for name, item in found.items() if item is not None}


def _make_camera(bpy_scene: bpy.types.Scene, scene: Scene, name: str, root: bpy.types.Object) -> bpy.types.Object:
    data = bpy.data.cameras.new(PurePath(name).name)
    size = 0.04 * scene.extent
    data.display_size = size
    # Unlike everything else below the root, clipping is in world units.
    scale = float(abs(find_world_matrix(root).to_3x3().determinant()) ** (1.0 / 3.0))
    data.clip_start, data.clip_end = 0.01 * size * scale, 1000.0 * max(size * scale, 1.0)
    collection = ensure_owned_collection(bpy_scene, "cameras", "Cameras")
    return make_object(PurePath(name).stem, data, "camera", collection, root)


def _write_camera(
    bpy_scene: bpy.types.Scene, item: bpy.types.Object, camera: Camera, photo: Photo | None, root: bpy.types.Object
) -> None:
    before = [item.get(FILE), item.get(LENS)]
    resized = SIZE in item and list(item[SIZE]) != [camera.width, camera.height]
    keep_photo(item, camera, photo)
    if [item.get(FILE), item.get(LENS)] != before:
        remove_backgrounds([item])
    item.data.type = "PERSP"
    set_intrinsics(item.data, camera)
    item.parent, item.matrix_parent_inverse = root, Matrix()
    item.matrix_basis = Matrix(blender_pose(camera).tolist())
    keep_pose(item)
    if resized and bpy_scene.camera == item:
        show_through(bpy_scene, item)


def find_middle_view(scene: Scene) -> int:
    """Find the number of the camera to begin with: the middle one of those that show the middle of the scene in the
    inner half of their photos, of all if none does. Half-way along a row and back, photos show its end."""
    middle = np.median(scene.points, axis=0) if len(scene.points) else find_focus(scene)
    shows = []
    for number, camera in enumerate(scene.cameras):
        pixel, depth = camera.project(middle)
        away = np.abs(pixel / [camera.width, camera.height] - 0.5)
        if depth > 0.0 and (away < 0.25).all():
            shows.append(number)
    numbers = shows or range(len(scene.cameras))
    return numbers[len(numbers) // 2]


def blender_pose(camera: Camera) -> FloatArray:
    """(4, 4) camera-to-scene transform with Blender's camera axes."""
    return np.linalg.inv(camera.world_to_camera) @ BLENDER_AXES


def set_intrinsics(data: bpy.types.Camera, camera: Camera) -> None:
    """Set lens and shift from K. Shifts are fractions of the width of the image (horizontal sensor fit)."""
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR_WIDTH
    data.lens = fx * SENSOR_WIDTH / camera.width
    data.shift_x = (0.5 * camera.width - cx) / camera.width
    data.shift_y = (cy - 0.5 * camera.height) / camera.width * (fx / fy)


def show_through(bpy_scene: bpy.types.Scene, item: bpy.types.Object) -> None:
    """Make a camera of ours active and render at the size and pixel aspect of its photo (fx ≠ fy is a pixel aspect)."""
    bpy_scene.camera = item
    render, ratio = bpy_scene.render, item[ASPECT]
    (render.resolution_x, render.resolution_y), render.resolution_percentage = item[SIZE], 100
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, 1.0 / ratio), max(1.0, ratio)
