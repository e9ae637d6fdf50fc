"""Shows a fruit in the photos: through the camera with the best view, the next best, and back to the free view."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from typing import Any

import bpy

from ...engine.errors import FruitLangsError
from ..blender_data import find_owned_object, find_owned_objects, read_gaussian_attributes
from ..data.fruit_shape import fruit_ellipsoid
from ..data.photo_files import PHOTO, SIZE
from ..data.read_cameras import read_camera
from ..jobs.jobs import describe_error, is_editing
from ..scene_frame import scene_frame
from .photo_backgrounds import PROBLEM, keep_only, show_photo
from .photo_choice import Sight, Surface, find_best_views
from .photo_view import find_view_area, has_stored_view, look_through, restore_view


def find_active_fruit(context: bpy.types.Context) -> bpy.types.Object | None:
    """Find the active fruit of the list and the viewport."""
    item = context.view_layer.objects.active if context.view_layer else None
    return item if item is not None and item.get("fruitlangs") == "fruit" else None


def list_photo_cameras(bpy_scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """List the cameras of the photos, including those whose photos are missing."""
    return [item for item in find_owned_objects(bpy_scene, "camera") if SIZE in item]


def find_fruit_views(bpy_scene: bpy.types.Scene, item: bpy.types.Object) -> list[tuple[bpy.types.Object, Sight]]:
    """Find the cameras that show a fruit, best first."""
    cameras = list_photo_cameras(bpy_scene)
    if find_owned_object(bpy_scene, "root") is None or not cameras:
        return []
    frame = scene_frame(bpy_scene)
    fruit, views = fruit_ellipsoid(item, frame), [read_camera(camera, frame) for camera in cameras]
    sights = find_best_views(views, fruit.center, fruit.axes, _read_surface(bpy_scene))
    return [(cameras[sight.index], sight) for sight in sights]


def _read_surface(bpy_scene: bpy.types.Scene) -> Surface | None:
    found = read_gaussian_attributes(bpy_scene, "position", "scale", "quaternion", "opacity")
    return None if found is None else Surface(*found)


class _Look:
    """Mix-in of operators that show the active fruit through a photo's camera."""

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if is_editing(cls, context):
            return False
        if find_active_fruit(context) is None:
            cls.poll_message_set("Choose a fruit in the list or in the viewport")
            return False
        if not list_photo_cameras(context.scene):
            cls.poll_message_set("There are no photos' cameras: import the scene again")
            return False
        return True

    def look(self: Any, context: bpy.types.Context, step: int | None) -> set[str]:
        """Show the view of the best camera (None), or of the one this many places after the current one."""
        item = find_active_fruit(context)
        assert item is not None
        try:
            sights = find_fruit_views(context.scene, item)
        except FruitLangsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if not sights:
            self.report({"WARNING"}, f"{item.name} is hidden in all photos")
            return {"CANCELLED"}
        cameras = [camera for camera, _ in sights]
        place = 0
        if step is not None and context.scene.camera in cameras:
            place = (cameras.index(context.scene.camera) + step) % len(cameras)
        camera, sight = sights[place]
        if not item.hide_viewport:
            item.select_set(True)
        look_through(context, camera, sight.place, sight.pixels)
        keep_only([camera])
        try:
            show_photo(camera)
        except Exception as error:
            camera[PROBLEM] = describe_error(error)
            self.report({"WARNING"}, camera[PROBLEM])
            return {"FINISHED"}
        name = camera[PHOTO] or camera.name
        self.report(
            {"INFO"},
            f"{item.name} in {name}, photo {place + 1} of {len(cameras)} that show it: {sight.pixels:.0f} pixels wide, "
            f"{100.0 * sight.share:.0f} % visible{'' if sight.whole else ', cut by the edge of the photo'}",
        )
        return {"FINISHED"}


class FRUITLANGS_OT_best_photo(_Look, bpy.types.Operator):
    bl_idname = "fruitlangs.best_photo"
    bl_label = "Best Photo"
    bl_description = "Show the photo with the best view of the active fruit: whole, not hidden, large and central"
    bl_options = {"UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.look(context, None)


class FRUITLANGS_OT_next_photo(_Look, bpy.types.Operator):
    bl_idname = "fruitlangs.next_photo"
    bl_label = "Next Photo"
    bl_description = "Show the next best photo of the active fruit"
    bl_options = {"UNDO"}

    step: bpy.props.IntProperty(
        name="Step", default=1, options={"SKIP_SAVE"}, description="1 for the next photo, -1 for the previous photo"
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.look(context, self.step)


class FRUITLANGS_OT_free_view(bpy.types.Operator):
    bl_idname = "fruitlangs.free_view"
    bl_label = "Free View"
    bl_description = "Leave the photo and restore the previous view"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        area = find_view_area(context)
        through = area is not None and area.spaces.active.region_3d.view_perspective == "CAMERA"
        if context.scene is None or not (through or has_stored_view(context.scene)):
            cls.poll_message_set("No photo is shown")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        restore_view(context)
        keep_only([])
        return {"FINISHED"}


CLASSES = (FRUITLANGS_OT_best_photo, FRUITLANGS_OT_next_photo, FRUITLANGS_OT_free_view)
