"""Writes the overview of a block: a collection for each tree, its fruit as one mesh, and a few of its Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..blender_data import (
    OWNER,
    Role,
    ensure_owned_collection,
    find_owned_objects,
    get_attribute,
    linear_from_srgb,
    make_object,
    remove_objects,
    rgba,
    set_attribute,
)
from ..data.write_fruits import ensure_matt_material
from ..data.write_points import make_colored_points, show_points
from ..root_placement import place_root, placement_of
from ..scene_frame import SceneFrame
from ..viewport.fruit_colours import probability_colours, tree_colour
from .overview import ShownResult, ShownTree

FloatArray = NDArray[np.float64]
Colors = Literal["TREE", "PROBABILITY"]

COLORS = "fruit color"
"""Colour attribute of the fruit meshes."""
RESULT = "fruitlangs_result"
"""Custom property of a root: the folder of its result in the block."""
SHOWN: tuple[Role, ...] = ("block-fruit", "block-points", "block-root")
"""Roles of the objects of the overview."""
TREE, PROBABILITIES = "fruitlangs_tree", "probability"
"""Custom property of a tree's fruit: its name; and the attribute of the probability of each vertex' fruit."""
SUBDIVISIONS = 2
"""Subdivisions of the icosphere that stands for a fruit: 42 vertices."""
POINT_RADIUS = 0.004
"""Radius of a point, in widths of what is shown."""


def write_overview(bpy_scene: bpy.types.Scene, results: Sequence[ShownResult], colors: Colors) -> None:
    """Replace what this Blender scene shows of a block; of the same results, what the user placed or hid stays so."""
    placements, hidden = _read_placements(bpy_scene, results), _read_hidden(bpy_scene)
    remove_overview(bpy_scene)
    parent = ensure_owned_collection(bpy_scene, "block", "Orchard")
    number = 0
    for result in results:
        root = make_object(result.folder, None, "block-root", _make_collection(result.folder, parent), None)
        root.empty_display_size = 0.1 * result.width or 0.1
        root[RESULT] = result.folder
        upright = Matrix.Translation((*result.place, 0.0)) @ Matrix(result.matrix.tolist())
        place_root(SceneFrame(root, Matrix()), upright, placements.get(result.folder))
        several = len(result.trees) > 1
        for tree in result.trees:
            own = root.users_collection[0]
            collection = _make_collection(tree.name, own) if several else own
            _write_fruit(tree, number, collection, root, colors)
            number += 1
        if len(result.points):
            _write_points(result, root)
    for item in _find_shown(bpy_scene):
        state = hidden.get(item.name, Hidden(viewport=False, render=False))
        item.hide_viewport, item.hide_render = state.viewport, state.render


@dataclass(frozen=True)
class Hidden:
    """Whether an object is hidden in viewports and in renders."""

    viewport: bool
    render: bool


def _find_shown(bpy_scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Find all objects of the overview."""
    return [item for role in SHOWN for item in find_owned_objects(bpy_scene, role)]


def _read_hidden(bpy_scene: bpy.types.Scene) -> dict[str, Hidden]:
    """Return {name of an object: whether the user hid it}."""
    return {item.name: Hidden(item.hide_viewport, item.hide_render) for item in _find_shown(bpy_scene)}


def _read_placements(bpy_scene: bpy.types.Scene, results: Sequence[ShownResult]) -> dict[str, Matrix]:
    """Return {folder of a result: how the user placed its root}; none if most of those shown are not in this block."""
    frames = {str(item.get(RESULT)): SceneFrame(item, Matrix()) for item in find_owned_objects(bpy_scene, "block-root")}
    if 2 * len(set(frames) & {result.folder for result in results}) < len(frames):
        return {}
    found = {folder: placement_of(frame) for folder, frame in frames.items()}
    return {folder: placement for folder, placement in found.items() if placement is not None}


def remove_overview(bpy_scene: bpy.types.Scene) -> None:
    """Remove what this Blender scene shows of a block."""
    remove_objects(_find_shown(bpy_scene))
    for collection in [each for each in bpy_scene.collection.children_recursive if each.get(OWNER) == "block-tree"]:
        bpy.data.collections.remove(collection)


def color_fruit(bpy_scene: bpy.types.Scene, colors: Colors) -> None:
    """Colour all fruit by their tree, or by their probability."""
    for number, item in enumerate(find_owned_objects(bpy_scene, "block-fruit")):
        _color(item, number, colors)


def _make_collection(name: str, parent: bpy.types.Collection) -> bpy.types.Collection:
    collection = bpy.data.collections.new(name)
    collection[OWNER] = "block-tree"
    parent.children.link(collection)
    return collection


def _write_fruit(
    tree: ShownTree, number: int, collection: bpy.types.Collection, root: bpy.types.Object, colors: Colors
) -> None:
    """One mesh of all fruit of a tree: a sphere stretched along the axes of each."""
    vertices, faces = _sphere()
    each = tree.centers[:, None] + np.einsum("vk,fkj->fvj", vertices, tree.axes)
    steps = np.arange(len(tree.centers))[:, None, None] * len(vertices)
    mesh = bpy.data.meshes.new(tree.name)
    mesh.from_pydata(each.reshape(-1, 3).tolist(), [], (faces + steps).reshape(-1, 3).tolist())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    set_attribute(mesh, PROBABILITIES, "FLOAT", np.repeat(tree.probabilities, len(vertices)))
    mesh.materials.append(_material())
    mesh.update()
    item = make_object(f"{tree.name} fruit", mesh, "block-fruit", collection, root)
    item[TREE] = tree.name
    _color(item, number, colors)


def _color(item: bpy.types.Object, number: int, colors: Colors) -> None:
    mesh, count = item.data, len(item.data.vertices)
    if colors == "TREE":
        shown = np.tile(tree_colour(number), (count, 1))
    else:
        shown = probability_colours(get_attribute(mesh, PROBABILITIES))
    set_attribute(mesh, COLORS, "FLOAT_COLOR", rgba(linear_from_srgb(shown)))
    mesh.attributes.active_color = mesh.attributes[COLORS]
    mesh.update()


def _write_points(result: ShownResult, root: bpy.types.Object) -> None:
    mesh = make_colored_points(f"{result.folder} Gaussians", result.points, result.colors)
    item = make_object(mesh.name, mesh, "block-points", root.users_collection[0], root)
    item.hide_select = True
    show_points(item, POINT_RADIUS * result.width / float(np.linalg.norm(result.matrix[0, :3])))


@cache
def _sphere() -> tuple[FloatArray, NDArray[np.int64]]:
    """(V, 3) vertices of a unit sphere and (T, 3) its triangles."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS - 1)
    return np.asarray(ball.vertices, np.float64), np.asarray(ball.faces, np.int64)


def _material() -> bpy.types.Material:
    """The material of fruit, in the colour attribute."""

    def color(tree: bpy.types.NodeTree) -> Any:
        node = tree.nodes.new("ShaderNodeVertexColor")
        node.layer_name = COLORS
        return node

    return ensure_matt_material("Fruit of a block", "block-fruit", color)
