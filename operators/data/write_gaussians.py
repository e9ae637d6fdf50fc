"""Gaussians as a Blender point object: a mesh of points with attributes, shown as ellipsoids by Geometry Nodes.

The attributes are the stored truth. Their names follow Blender's native splats where it has one: `scale` (standard
deviations), `quaternion` (w, x, y, z), `radiance:base` (linear colour without view dependence); and also `opacity`,
`probability`, `fruit_id` (-1 if the Gaussian belongs to no fruit) and `gaussian_index` (its number in the
reconstruction, so that Gaussians that the user deletes are noticed). View-dependent colour is in `gaussians.ply`. The
custom properties of the mesh say how they are drawn (`ANTIALIASED`), to which prompt `probability` belongs (`ASKED`),
and how many Gaussians were written (`NUMBER`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..blender_data import (
    adopt,
    ensure_owned_collection,
    find_original,
    find_owned_objects,
    linear_from_srgb,
    make_object,
    make_point_mesh,
    replace_mesh,
    rgba,
    set_attribute,
    to_array,
)
from ..viewport.gaussian_nodes import gaussian_node_group, set_input
from ..viewport.splats import ANTIALIASED
from .write_root import find_focus

if TYPE_CHECKING:
    from torch import Tensor

    from ...engine.counting.fruit import Fruit
    from ...engine.scene.camera import Scene
    from ...engine.splatting.gaussians import Gaussians

ASKED = "fruitlangs_asked"
"""Custom property of the mesh: the prompt of its attribute `probability`, from `join_asked_words`."""
INDEX, NUMBER = "gaussian_index", "fruitlangs_number"
"""Attribute and custom property of the mesh: the number of each Gaussian in the reconstruction, and of all of them."""
REACH = 1.2
"""Distance from the centre up to which Gaussians are shown, in extents of the scene (about the cameras' distance)."""


def write_gaussians(
    bpy_scene: bpy.types.Scene,
    scene: Scene,
    gaussians: Gaussians,
    probability: Tensor | NDArray[Any] | None,  # (N,) of the prompt
    fruits: Sequence[Fruit],
    root: bpy.types.Object,
    asked: str = "",
) -> bpy.types.Object:
    """Create this Blender scene's Gaussian object, or replace the mesh of the existing one.

    Gaussians outside the cameras' ring (sky, distant background) are hidden by the modifier's Reach, but stay in the
    mesh. asked: the prompt of the probability, from `join_asked_words`.
    """
    own, mesh = (
        find_original(find_owned_objects(bpy_scene, "gaussians")),
        make_gaussian_mesh(gaussians, probability, fruits),
    )
    mesh[ASKED] = asked
    if own is not None:
        adopt(own, root)
        replace_mesh(own, mesh)
        return own
    collection = ensure_owned_collection(bpy_scene, "scene", "FruitLangs")
    item = make_object("Gaussians", mesh, "gaussians", collection, root)
    modifier = item.modifiers.new("Gaussians", "NODES")
    modifier.node_group = gaussian_node_group()
    set_input(modifier, "Centre", find_focus(scene).tolist())
    if len(scene.cameras):
        set_input(modifier, "Reach", REACH * scene.extent)
    set_input(modifier, "Highlight", probability is not None)
    item.visible_shadow = False  # their colour includes light already; the fruit among them need lights
    return item


def join_asked_words(prompts: Sequence[str], negatives: Sequence[str]) -> str:
    """Return 'apple, plum | leaf': prompts and negatives."""
    return f"{', '.join(prompts)} | {', '.join(negatives)}"


def make_gaussian_mesh(
    gaussians: Gaussians, probability: Tensor | NDArray[Any] | None, fruits: Sequence[Fruit]
) -> bpy.types.Mesh:
    """Make points at the means, in the scene frame, with the attributes named above."""
    from ...engine.counting.fruit import member_ids

    count = len(gaussians)
    mesh = make_point_mesh("Gaussians", to_array(gaussians.means))
    quats = to_array(gaussians.quats)
    quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
    set_attribute(mesh, "scale", "FLOAT_VECTOR", to_array(gaussians.scales))
    set_attribute(mesh, "quaternion", "QUATERNION", quats)
    set_attribute(mesh, "radiance:base", "FLOAT_COLOR", rgba(linear_from_srgb(to_array(gaussians.base_colors))))
    set_attribute(mesh, "opacity", "FLOAT", to_array(gaussians.opacities))
    set_attribute(mesh, "probability", "FLOAT", np.zeros(count) if probability is None else to_array(probability))
    set_attribute(mesh, "fruit_id", "INT", member_ids(count, fruits))
    set_attribute(mesh, INDEX, "INT", np.arange(count))
    mesh[NUMBER] = count
    mesh[ANTIALIASED] = bool(gaussians.antialiased)
    mesh.update()
    return mesh
