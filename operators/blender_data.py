"""Basic operations on Blender data: attributes from arrays, and finding our own data.

Data blocks of this extension have the custom property `OWNER` with their role. So they are found whatever their name
is, in this Blender scene only, and the user's data are never replaced.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Any, Literal

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..engine.errors import SceneError

OWNER = "fruitlangs"
"""Custom property that names the role of an object, collection, node group or material of ours."""

EXTENT = "fruitlangs_extent"
"""Custom property of a mesh of points: their number, and their lowest and highest coordinates as written."""
SAME_PLACE = 1e-5
"""Largest change of these coordinates without a move, relative to the largest."""

Role = Literal[
    "root", "gaussians", "points", "camera", "cameras", "fruit", "fruits", "scene", "region", "light", "world",
    "trees", "block", "block-root", "block-fruit", "block-points",
]  # fmt: skip
MESHES = ("gaussians", "points", "fruit", "block-fruit", "block-points")
"""Roles of objects that are meshes."""
AttributeType = Literal["FLOAT", "INT", "FLOAT_VECTOR", "FLOAT_COLOR", "QUATERNION"]

_FIELDS: dict[AttributeType, tuple[str, int]] = {
    "FLOAT": ("value", 1),
    "INT": ("value", 1),
    "FLOAT_VECTOR": ("vector", 3),
    "FLOAT_COLOR": ("color", 4),
    "QUATERNION": ("value", 4),
}


def to_array(values: Any, dtype: type = np.float32) -> NDArray[Any]:
    """Return `values` as a contiguous NumPy array: a torch tensor on any device, an array or a sequence."""
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    return np.ascontiguousarray(values, dtype=dtype)


def make_point_mesh(name: str, positions: NDArray[Any]) -> bpy.types.Mesh:
    """Make a mesh of loose vertices at `positions`, (N, 3)."""
    mesh = bpy.data.meshes.new(name)
    if len(positions):
        mesh.vertices.add(len(positions))
        mesh.attributes["position"].data.foreach_set("vector", to_array(positions).ravel())
        corners = np.stack([to_array(positions).min(axis=0), to_array(positions).max(axis=0)])
        mesh[EXTENT] = [len(positions), *corners.ravel().tolist()]
    return mesh


def point_positions(item: bpy.types.Object) -> NDArray[np.float32]:
    """(N, 3) positions of the Gaussians or points of an object, in the scene frame.

    Raises:
        SceneError: Apply Transform or an edit has moved them within the mesh.
    """
    positions = get_attribute(item.data, "position")
    if EXTENT in item.data and len(positions):
        number, *corners = item.data[EXTENT]
        low, high = np.reshape(corners, (2, 3))
        outside = np.array([low - positions.min(axis=0), positions.max(axis=0) - high])
        moved = np.abs(outside) if len(positions) == int(number) else outside  # some may have been deleted
        if moved.max() > SAME_PLACE * np.abs(corners).max():
            raise SceneError(
                f"The points of {item.name} were moved within its mesh, for example by Apply Transform. Undo that, or "
                "import the result again"
            )
    return positions


def set_attribute(mesh: bpy.types.Mesh, name: str, kind: AttributeType, values: NDArray[Any]) -> None:
    """Write `values`, one row per vertex, as the named point attribute; an attribute of that name is replaced."""
    old = mesh.attributes.get(name)
    if old is not None:
        mesh.attributes.remove(old)
    attribute = mesh.attributes.new(name, kind, "POINT")
    field, width = _FIELDS[kind]
    flat = to_array(values, np.int32 if kind == "INT" else np.float32).ravel()
    if flat.size != len(mesh.vertices) * width:
        raise ValueError(f"attribute {name}: {flat.size} numbers for {len(mesh.vertices)} points of {width}")
    if flat.size:
        attribute.data.foreach_set(field, flat)


def get_attribute(mesh: bpy.types.Mesh, name: str) -> NDArray[Any]:
    """The named attribute as (N,) or (N, width)."""
    attribute = mesh.attributes[name]
    field, width = _FIELDS[attribute.data_type]
    values = np.empty(len(attribute.data) * width, np.int32 if attribute.data_type == "INT" else np.float32)
    attribute.data.foreach_get(field, values)
    return values if width == 1 else values.reshape(-1, width)


def linear_from_srgb(srgb: NDArray[Any] | Sequence[float]) -> NDArray[Any]:
    """Blender's attributes and materials contain scene-linear colour; photos and Gaussians contain sRGB."""
    values = np.asarray(srgb, dtype=np.float32)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: NDArray[Any] | Sequence[float]) -> NDArray[Any]:
    """The inverse of `linear_from_srgb`."""
    values = np.asarray(linear, dtype=np.float32)
    return np.where(values <= 0.04045 / 12.92, values * 12.92, 1.055 * np.maximum(values, 0.0) ** (1 / 2.4) - 0.055)


def rgba(rgb: NDArray[Any]) -> NDArray[Any]:
    """(N, 4) with alpha 1."""
    return np.concatenate([rgb, np.ones((len(rgb), 1), np.float32)], axis=1)


def find_owned_object(scene: bpy.types.Scene, role: Role) -> bpy.types.Object | None:
    """Find this Blender scene's object with that role."""
    return next((item for item in scene.objects if _has_role(item, role)), None)


def find_owned_objects(scene: bpy.types.Scene, role: Role) -> list[bpy.types.Object]:
    """Find all of this Blender scene's objects with that role."""
    return [item for item in scene.objects if _has_role(item, role)]


def find_edited_object(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Find an object of ours in this Blender scene that is not in Object Mode."""
    actives = (layer.objects.active for layer in scene.view_layers)
    if all(item is None or item.mode == "OBJECT" for item in actives):
        return None
    return next((item for item in scene.objects if item.mode != "OBJECT" and item.get(OWNER)), None)


def _has_role(item: bpy.types.Object, role: Role) -> bool:
    """Whether an object is ours and has that role: not if it is linked from another file, which cannot be changed, nor
    if the user turned it into something else than a mesh."""
    return item.get(OWNER) == role and item.library is None and (item.type == "MESH" or role not in MESHES)


def read_gaussian_attributes(scene: bpy.types.Scene, *names: str) -> list[NDArray[Any]] | None:
    """Read these attributes of this Blender scene's Gaussians; None if there are none, if they are being edited, or if
    one is missing.

    Raises:
        SceneError: positions are asked for, and were moved within the mesh.
    """
    item = find_owned_object(scene, "gaussians")
    if item is None or item.mode == "EDIT" or any(name not in item.data.attributes for name in names):
        return None
    return [point_positions(item) if name == "position" else get_attribute(item.data, name) for name in names]


def list_local_collections(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """List all collections of this Blender scene below its own, except those linked from another file."""
    return [each for each in scene.collection.children_recursive if each.library is None]


def ensure_owned_collection(scene: bpy.types.Scene, role: Role, name: str) -> bpy.types.Collection:
    """Return this Blender scene's collection with that role, created under its name if there is none."""
    for collection in list_local_collections(scene):
        if collection.get(OWNER) == role:
            return collection
    parent = scene.collection if role == "scene" else ensure_owned_collection(scene, "scene", "FruitLangs")
    collection = bpy.data.collections.new(name)
    collection[OWNER] = role
    parent.children.link(collection)
    return collection


def make_object(
    name: str, data: bpy.types.ID | None, role: Role, collection: bpy.types.Collection, parent: bpy.types.Object | None
) -> bpy.types.Object:
    """Make an object of ours, linked into its collection, with coordinates relative to `parent`."""
    item = bpy.data.objects.new(name, data)
    item[OWNER] = role
    item.parent = parent
    collection.objects.link(item)
    return item


def areas_of(context: bpy.types.Context, kind: str) -> Iterator[tuple[bpy.types.Window, bpy.types.Area]]:
    """Every area of that type in the open windows, each with its window."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == kind:
                yield window, area


def select_only(context: bpy.types.Context, items: Sequence[bpy.types.Object]) -> None:
    """Select only these, except hidden ones, and make the first active.

    Objects that this view layer excludes cannot be selected. Its list of objects is not iterated: in 5.0 it contains
    dangling ones after a deletion.
    """
    for item in context.scene.objects:
        if item.select_get():
            item.select_set(False)
    for item in items:
        with suppress(RuntimeError):  # this view layer excludes it
            item.select_set(not item.hide_viewport)
    if items:
        with suppress(RuntimeError):
            context.view_layer.objects.active = items[0]


def adopt(item: bpy.types.Object, root: bpy.types.Object) -> None:
    """Put an object of ours whose root was deleted below the new one."""
    if item.parent is None:
        item.parent, item.matrix_parent_inverse, item.matrix_basis = root, Matrix(), Matrix()


def replace_mesh(item: bpy.types.Object, mesh: bpy.types.Mesh) -> None:
    """Give an object another mesh, with the name and the materials of its old one, which is deleted if unused."""
    old, name = item.data, item.data.name
    for material in old.materials:
        mesh.materials.append(material)
    item.data = mesh
    if old.users == 0:
        bpy.data.meshes.remove(old)
    mesh.name = name


def find_original(items: Iterable[bpy.types.Object]) -> bpy.types.Object | None:
    """Find the object of ours among these that a writer uses again; copies of it belong to the user from now on and are
    neither replaced nor deleted."""
    first, *copies = sorted(items, key=lambda item: (len(item.name), item.name)) or [None]
    for item in copies:
        del item[OWNER]
    return first


def find_unlinked_fruit(root: bpy.types.Object) -> list[bpy.types.Object]:
    """Find the fruit below this root that are in no Blender scene, for example because their collection was
    unlinked."""
    own = (item for item in bpy.data.objects if item.parent == root and _has_role(item, "fruit"))
    return [item for item in own if not item.users_scene]


def remove_objects(objects: Iterable[bpy.types.Object]) -> None:
    """Delete objects, and their data if nothing else uses them."""
    doomed: Sequence[bpy.types.Object] = list(objects)
    data = {item.data for item in doomed if item.data is not None}
    bpy.data.batch_remove(doomed)
    bpy.data.batch_remove([block for block in data if block.users == 0])
