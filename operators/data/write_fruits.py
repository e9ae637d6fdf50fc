"""Counted fruit as Blender objects that share one mesh per label."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import bmesh
import bpy
import numpy as np
from mathutils import Matrix

from ...engine.report.words import fruit_name
from ..blender_data import (
    OWNER,
    ensure_owned_collection,
    find_owned_objects,
    find_unlinked_fruit,
    list_local_collections,
    make_object,
    remove_objects,
)
from ..scene_frame import SceneFrame, keep_pose, read_stored_pose
from ..viewport.fruit_colours import colour_fruit
from .fruit_shape import is_unit_sphere

if TYPE_CHECKING:
    from ...engine.counting.fruit import Fruit, FruitCount

REVIEW, MADE = "review", "made_by_user"
"""Custom properties of a fruit: 'confirmed', 'rejected' or 'added' if it was reviewed; set if the user made it."""
REJECTED = "rejected"
SHOWN = "fruitlangs_shown"
"""Custom property of a fruit that Next Uncertain showed since its last start."""
TREE = "tree"
"""Custom property of a fruit, and of the collection of a tree: the number of the tree."""
LENGTHS = ("length", "width", "thickness")
MEASURED = ("diameter", "diameter_sd", *LENGTHS)
"""Custom properties that are lengths."""
WRITTEN = (
    *("id", "label", *MEASURED, "probability", "visible_fraction", "views", "color", "kind", "fallen", TREE),
    *(REVIEW, MADE, SHOWN),
)
"""All custom properties that a count and its review store in a fruit."""


def write_fruits(
    bpy_scene: bpy.types.Scene,
    fruit_count: FruitCount,
    root: bpy.types.Object,
    *,
    metres_per_unit: float | None = None,
) -> list[bpy.types.Object]:
    """Write this Blender scene's fruit objects, into the existing one of each fruit, and delete the others.

    Each is named label.id (`apple.001`), is at the fruit's centre in the scene frame (the root places it in the world),
    has its axes as rotation and scale, and has the custom properties of its entry in `fruits.json`: id, label,
    diameter, length, width and thickness (metres if metres_per_unit is known, else scene units), probability, views,
    color and kind; if known also diameter_sd (in the same unit), visible_fraction, fallen and tree. The fruit of a tree
    of a row are also in a collection of their own.
    """
    earlier = find_owned_objects(bpy_scene, "fruit")
    again = _find_reused(earlier, fruit_count.fruits)
    meshes = {
        label: _make_sphere_like(label, earlier) for label in sorted({fruit.label for fruit in fruit_count.fruits})
    }
    kept = set(again.values())
    remove_objects([*(item for item in earlier if item not in kept), *find_unlinked_fruit(root)])
    frame, collection = SceneFrame(root, Matrix()), ensure_owned_collection(bpy_scene, "fruits", "Fruits")
    items = []
    for fruit in fruit_count.fruits:
        item = again.get(fruit.id)
        if item is None:
            item = _make_fruit(bpy_scene, fruit, collection, meshes)
        else:
            _forget(item)
            _show_sphere(item, meshes[fruit.label])
        items.append(_write(bpy_scene, item, fruit, frame, collection, metres_per_unit))
    _clean(bpy_scene, meshes)
    return items


def _make_sphere_like(label: str, earlier: Sequence[bpy.types.Object]) -> bpy.types.Mesh:
    """Make a new sphere, with the materials of the earlier fruit of that label."""
    mesh = _make_unit_sphere(label)
    old = next((item.data for item in earlier if item.get("label") == label), None)
    if old is not None:
        mesh.materials.clear()
        for material in old.materials:
            mesh.materials.append(material)
    return mesh


def _find_reused(earlier: Sequence[bpy.types.Object], fruits: Sequence[Fruit]) -> dict[int, bpy.types.Object]:
    """Return {id: object} of the fruit that an earlier count found too: number, label and position are the same."""
    from ...engine.counting.fruit import NEAR

    named, found = {(item.get("id"), item.get("label")): item for item in earlier}, dict[int, bpy.types.Object]()
    for fruit in fruits:
        item = named.get((fruit.id, fruit.label))
        pose = None if item is None else read_stored_pose(item)
        away = np.inf if pose is None else float(np.linalg.norm(pose[:3, 3] - fruit.center))
        if item is not None and away <= NEAR * fruit.diameter:
            found[fruit.id] = item
    return found


def _forget(item: bpy.types.Object) -> None:
    """Remove what an earlier count and the review stored in a fruit object."""
    if item.get(REVIEW) == REJECTED:
        item.hide_viewport = item.hide_render = False
    for key in WRITTEN:
        item.pop(key, None)


def _clean(bpy_scene: bpy.types.Scene, meshes: Mapping[str, bpy.types.Mesh]) -> None:
    """Delete the collections of trees without fruit, and give new meshes the names of those that they replaced."""
    for role in ("tree", "trees"):
        for each in [each for each in list_local_collections(bpy_scene) if each.get(OWNER) == role]:
            if not len(each.objects) and not len(each.children):
                bpy.data.collections.remove(each)
    for label, mesh in meshes.items():
        if bpy.data.meshes.get(label) is None:
            mesh.name = label


def _show_sphere(item: bpy.types.Object, mesh: bpy.types.Mesh) -> None:
    old, item.data = item.data, mesh
    if old.users == 0:
        bpy.data.meshes.remove(old)


def write_fruit(
    bpy_scene: bpy.types.Scene, fruit: Fruit, frame: SceneFrame, *, metres_per_unit: float | None = None
) -> bpy.types.Object:
    """Add one fruit object to the existing ones, as `write_fruits` creates them, also where the root's transform was
    applied."""
    others = find_owned_objects(bpy_scene, "fruit")
    meshes = {item["label"]: item.data for item in others if "label" in item and is_unit_sphere(item)}
    collection = ensure_owned_collection(bpy_scene, "fruits", "Fruits")
    item = _make_fruit(bpy_scene, fruit, collection, meshes)
    return _write(bpy_scene, item, fruit, frame, collection, metres_per_unit)


def label_fruit(item: bpy.types.Object, label: str, bpy_scene: bpy.types.Scene) -> None:
    """Give a fruit object another label, with its name, colour and mesh; a mesh that has the size of the fruit, after
    Apply Transform, stays."""
    if is_unit_sphere(item):
        old = item.data
        others = (each for each in find_owned_objects(bpy_scene, "fruit") if each.get("label") == label)
        item.data = next((each.data for each in others if is_unit_sphere(each)), None) or _make_unit_sphere(label)
        if old.users == 0:
            bpy.data.meshes.remove(old)
    item["label"] = label
    item.name = _choose_name(label, item["id"], bpy_scene, item)
    colour_fruit(item)


def _make_fruit(
    bpy_scene: bpy.types.Scene, fruit: Fruit, collection: bpy.types.Collection, meshes: dict[str, bpy.types.Mesh]
) -> bpy.types.Object:
    mesh = meshes.get(fruit.label) or meshes.setdefault(fruit.label, _make_unit_sphere(fruit.label))
    return make_object(_choose_name(fruit.label, fruit.id, bpy_scene), mesh, "fruit", collection, None)


def _write(
    bpy_scene: bpy.types.Scene,
    item: bpy.types.Object,
    fruit: Fruit,
    frame: SceneFrame,
    collection: bpy.types.Collection,
    metres_per_unit: float | None,
) -> bpy.types.Object:
    item.parent, item.matrix_parent_inverse = frame.root, frame.in_root
    item.delta_location, item.delta_scale = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    item.delta_rotation_euler, item.delta_rotation_quaternion = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    item.location = tuple(np.asarray(fruit.center, dtype=float))
    item.scale = tuple(fruit.lengths.tolist())
    item.rotation_mode = "QUATERNION"
    item.rotation_quaternion = Matrix((2.0 * fruit.axes / fruit.lengths[:, None]).T.tolist()).to_quaternion()
    keep_pose(item)
    _set_properties(item, fruit, metres_per_unit)
    colour_fruit(item)
    put_on_tree(bpy_scene, item)
    if not item.users_collection:
        collection.objects.link(item)
    return item


def put_on_tree(bpy_scene: bpy.types.Scene, item: bpy.types.Object) -> None:
    """Link a fruit into the collection of its tree too, if it has one."""
    for each in [each for each in item.users_collection if each.get(OWNER) == "tree"]:
        if each.get(TREE) != item.get(TREE):
            each.objects.unlink(item)
    if TREE not in item:
        return
    trees, name = ensure_owned_collection(bpy_scene, "trees", "Trees"), f"Tree {item['tree']}"
    own = next((each for each in trees.children if each.get(TREE) == item["tree"]), None)
    if own is None:
        own = bpy.data.collections.new(name)
        own[OWNER], own[TREE] = "tree", item["tree"]
        trees.children.link(own)
    if own not in item.users_collection:
        own.objects.link(item)


def _choose_name(label: str, number: int, bpy_scene: bpy.types.Scene, own: bpy.types.Object | None = None) -> str:
    """Choose the name of a fruit; `own` if it already has it."""
    name = fruit_name(label, number)
    # Taken by another Blender scene's fruit or by the user: Blender would continue numbering with another fruit's id.
    return name if bpy.data.objects.get(name) in (None, own) else f"{bpy_scene.name} {name}"


def _set_properties(item: bpy.types.Object, fruit: Fruit, metres_per_unit: float | None) -> None:
    item["id"] = int(fruit.id)
    item["label"] = fruit.label
    item["diameter"] = float(fruit.diameter) * (metres_per_unit or 1.0)
    if math.isfinite(fruit.diameter_sd):
        item["diameter_sd"] = float(fruit.diameter_sd) * (metres_per_unit or 1.0)
    for key, length in zip(LENGTHS, fruit.lengths, strict=True):
        item[key] = float(length) * (metres_per_unit or 1.0)
    item["probability"] = float(fruit.probability)
    if fruit.visible_fraction is not None:
        item["visible_fraction"] = float(fruit.visible_fraction)
    item["views"] = int(fruit.views)
    item["color"] = [float(value) / 255.0 for value in fruit.color]
    item["kind"] = str(fruit.kind)
    for key, known in (("fallen", fruit.fallen), ("tree", fruit.tree)):
        if known is not None:
            item[key] = known
    for key, text in (
        ("probability", "Probability of being a fruit of the prompt"),
        ("visible_fraction", "Largest share of it that any photo shows"),
    ):
        if key in item:
            item.id_properties_ui(key).update(min=0.0, max=1.0, description=text)
    item.id_properties_ui("views").update(min=0, description="Number of photos that show at least a tenth of the fruit")
    item.id_properties_ui("color").update(subtype="COLOR", min=0.0, max=1.0, description="Mean colour of its surface")
    set_unit(item, metres_per_unit)


def set_unit(item: bpy.types.Object, metres_per_unit: float | None) -> None:
    """Store the unit of its lengths in the custom properties of a fruit."""
    for key in (key for key in MEASURED if key in item):
        item.id_properties_ui(key).update(min=0.0, description="Metres" if metres_per_unit else "Scene units")


def _make_unit_sphere(label: str) -> bpy.types.Mesh:
    """Make a smooth sphere of diameter 1, so that the scale of an object is its length, width and thickness."""
    mesh = bpy.data.meshes.new(label)
    shape = bmesh.new()
    bmesh.ops.create_icosphere(shape, subdivisions=3, radius=0.5)
    shape.to_mesh(mesh)
    shape.free()
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), dtype=bool))
    mesh.materials.append(_ensure_fruit_material())
    return mesh


def _ensure_fruit_material() -> bpy.types.Material:
    """Return the material of fruit, in the colour of the object."""
    return ensure_matt_material("Fruit", "fruit", lambda tree: tree.nodes.new("ShaderNodeObjectInfo"))


def ensure_matt_material(name: str, role: str, color: Callable[[bpy.types.NodeTree], Any]) -> bpy.types.Material:
    """Return our matt material with that role, made if this file has none; color: adds the node whose Color it
    shows."""
    for material in bpy.data.materials:
        if material.get(OWNER) == role:
            return material
    material = bpy.data.materials.new(name)
    material[OWNER] = role
    material.use_nodes = True
    tree = material.node_tree
    skin = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    skin.inputs["Roughness"].default_value = 0.4
    source = color(tree)
    source.location = (skin.location.x - 200, skin.location.y)
    tree.links.new(source.outputs["Color"], skin.inputs["Base Color"])
    return material
