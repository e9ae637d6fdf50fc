"""Blender's cameras as the engine's: the inverse of `write_cameras`, and the user's own camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy
import numpy as np

from ...engine.errors import SceneError
from ..blender_data import find_owned_object, find_owned_objects, get_attribute, point_positions, srgb_from_linear
from ..root_placement import upright_of
from ..scene_frame import SceneFrame, scene_frame
from .fruit_objects import metres_per_unit
from .photo_files import ASPECT, SIZE
from .write_cameras import BLENDER_AXES

if TYPE_CHECKING:
    from ...engine.scene.camera import Camera, FloatArray, Scene


def read_scene(bpy_scene: bpy.types.Scene) -> Scene:
    """The photos' cameras and the sparse points that are shown, in the scene frame, without the photos.

    Raises:
        SceneError: nothing was imported, or a camera is not perspective.
    """
    from ...engine.scene.camera import Scene

    points, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    sparse = find_owned_object(bpy_scene, "points")
    if sparse is not None and sparse.mode != "EDIT":
        points = point_positions(sparse).astype(np.float64)
        shown = srgb_from_linear(get_attribute(sparse.data, "radiance:base")[:, :3])
        colors = np.round(255.0 * shown.clip(0.0, 1.0)).astype(np.uint8)
    return Scene(read_cameras(bpy_scene), [], points, colors, read_up(bpy_scene), metres_per_unit(bpy_scene))


def read_up(bpy_scene: bpy.types.Scene) -> FloatArray:
    """(3,) unit vector away from the ground, in the scene frame.

    Raises:
        SceneError: nothing was imported.
    """
    up = np.array(upright_of(_frame(bpy_scene)).to_3x3().row[2], np.float64)
    return up / np.linalg.norm(up)


def read_cameras(bpy_scene: bpy.types.Scene) -> list[Camera]:
    """The photos' cameras, at their current poses.

    Raises:
        SceneError: a camera is not perspective.
    """
    frame = _frame(bpy_scene)
    return [read_camera(item, frame) for item in find_owned_objects(bpy_scene, "camera") if SIZE in item]


def read_camera(item: bpy.types.Object, frame: SceneFrame) -> Camera:
    """One photo's camera, at its current pose.

    Raises:
        SceneError: it is not perspective.
    """
    width, height = (int(side) for side in item[SIZE])
    return _make_camera(item, frame, width, height, float(item[ASPECT]))


def read_active_camera(bpy_scene: bpy.types.Scene) -> Camera:
    """Read the camera of a Blender render, at the size of the render.

    Raises:
        SceneError: there is none, it is not perspective, or nothing was imported.
    """
    item, render = bpy_scene.camera, bpy_scene.render
    if item is None:
        raise SceneError("The scene has no active camera. Set one, or choose the automatic view")
    for layer in bpy_scene.view_layers:
        layer.update()  # a camera that was just moved or added has no world matrix yet
    share = render.resolution_percentage / 100.0
    width, height = (max(round(side * share), 1) for side in (render.resolution_x, render.resolution_y))
    return _make_camera(item, _frame(bpy_scene), width, height, render.pixel_aspect_y / render.pixel_aspect_x)


def _make_camera(item: bpy.types.Object, frame: SceneFrame, width: int, height: int, aspect: float) -> Camera:
    """Return the camera of an object that makes pictures of width × height pixels, which are `aspect` times as high as
    wide."""
    from ...engine.scene.camera import Camera

    if item.type != "CAMERA" or item.data.type != "PERSP":
        raise SceneError(f"The camera {item.name} is not a perspective one. Set its type to Perspective")
    place, turned, _ = frame.of(item).decompose()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.array(turned.to_matrix()), np.array(place)
    return Camera(
        _compute_intrinsics(item.data, width, height, aspect), np.linalg.inv(pose @ BLENDER_AXES), width, height
    )


def _compute_intrinsics(data: bpy.types.Camera, width: int, height: int, aspect: float) -> FloatArray:
    """Compute K (3, 3). Blender fits the sensor to one side of the picture, and its shifts are fractions of that
    side."""
    upright = data.sensor_fit == "VERTICAL" or (data.sensor_fit == "AUTO" and width < height * aspect)
    side = height * aspect if upright else width
    sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
    focal = data.lens * side / sensor
    middle = (0.5 * width - data.shift_x * side, 0.5 * height + data.shift_y * side / aspect)
    return np.array([[focal, 0.0, middle[0]], [0.0, focal / aspect, middle[1]], [0.0, 0.0, 1.0]])


def _frame(bpy_scene: bpy.types.Scene) -> SceneFrame:
    if find_owned_object(bpy_scene, "root") is None:
        raise SceneError("No scene is imported yet. Import one first")
    return scene_frame(bpy_scene)
