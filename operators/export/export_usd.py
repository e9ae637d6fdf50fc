"""Exports the fruit objects with Blender's own USD writer, with their custom properties."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy

from ...engine.errors import OutputError
from ...engine.storage.files import replace_file
from ..data.fruit_objects import list_counted_fruit
from .export_file import ExportFile, Write, resolve_file

if TYPE_CHECKING:
    from ...engine.counting.fruit import FruitCount

WITHOUT = "This Blender was built without USD"
OPTIONS = {
    "export_animation": False,
    "export_hair": False,
    "export_lights": False,
    "export_cameras": False,
    "export_textures": False,
    "export_custom_properties": True,
    "convert_world_material": False,
    "visible_objects_only": False,
    "check_existing": False,
}
"""Options of Blender's USD writer; those that its version lacks are left out."""


def has_usd() -> bool:
    """Whether this Blender can write USD."""
    return bool(bpy.app.build_options.usd)


class FRUITLANGS_OT_export_usd(ExportFile, bpy.types.Operator):
    bl_idname = "fruitlangs.export_usd"
    bl_label = "Export USD"
    bl_description = "Write a USD file with every fruit object in world space"

    suffixes = (".usdc", ".usda", ".usd")

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if not has_usd():
            cls.poll_message_set(WITHOUT)
            return False
        return bool(super().poll(context))

    def prepare_write(self, context: bpy.types.Context, fruit_count: FruitCount) -> Write:
        return lambda path, progress: None

    def finish(self: Any, context: bpy.types.Context, result: Any) -> None:
        # Blender's writer works on the main thread only, which this is.
        write_usd(resolve_file(self.filepath, self.suffixes), context, self._target.scene(context))
        super().finish(context, result)


def write_usd(path: Path, context: bpy.types.Context, bpy_scene: bpy.types.Scene) -> None:
    """Write the current fruit of a Blender scene, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    items = list_counted_fruit(bpy_scene)
    known = bpy.ops.wm.usd_export.get_rna_type().properties.keys()
    options = {name: value for name, value in OPTIONS.items() if name in known}
    with ExitStack() as stack:
        part = stack.enter_context(replace_file(path))
        stack.enter_context(context.temp_override(scene=bpy_scene, view_layer=bpy_scene.view_layers[0]))
        stack.enter_context(_show_hidden(items))
        stack.enter_context(_use_plain_materials(items))
        collection = stack.enter_context(_link_together(items, bpy_scene))
        try:
            bpy.ops.wm.usd_export("EXEC_DEFAULT", filepath=str(part), collection=collection.name, **options)
        except RuntimeError as error:  # Blender's error for a file that cannot be written
            raise OutputError(f"{path} cannot be written ({str(error).strip()}). Choose another folder") from error


@contextmanager
def _link_together(items: list[bpy.types.Object], bpy_scene: bpy.types.Scene) -> Iterator[bpy.types.Collection]:
    """Make a collection of only these objects while the block runs."""
    collection = bpy.data.collections.new("Fruit for USD")
    bpy_scene.collection.children.link(collection)
    try:
        for item in items:
            collection.objects.link(item)
        yield collection
    finally:
        bpy.data.collections.remove(collection)


@contextmanager
def _show_hidden(items: list[bpy.types.Object]) -> Iterator[None]:
    """Show objects that the user hid while the block runs: they count."""
    hidden = [(item, item.hide_viewport, item.hide_render) for item in items if item.hide_viewport or item.hide_render]
    try:
        for item, _, _ in hidden:
            item.hide_viewport = item.hide_render = False
        yield
    finally:
        for item, viewport, render in hidden:
            item.hide_viewport, item.hide_render = viewport, render


@contextmanager
def _use_plain_materials(items: list[bpy.types.Object]) -> Iterator[None]:
    """Use one plain material per kind of fruit: USD does not support the material that uses the object colour."""
    meshes = {item.data: item.color for item in reversed(items) if len(item.data.materials)}
    before = {mesh: mesh.materials[0] for mesh in meshes}
    made = []
    try:
        for mesh, color in meshes.items():
            material = bpy.data.materials.new(mesh.name)
            made.append(material)
            material.use_nodes = True
            skin = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
            skin.inputs["Base Color"].default_value = tuple(color)
            mesh.materials[0] = material
        yield
    finally:
        for mesh, material in before.items():
            mesh.materials[0] = material
        bpy.data.batch_remove(made)
