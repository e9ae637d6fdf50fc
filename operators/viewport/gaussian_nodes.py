"""The Geometry Nodes group and the materials that show Gaussians and sparse points.

Separate from the writers because a node tree takes many lines: every function here builds one small piece.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy

from ..blender_data import OWNER, linear_from_srgb

VERSION = 3
"""Increase when a node tree or material changes: those in older files are then left alone and new ones created."""

GAUSSIAN_NODES, POINT_NODES = "gaussian nodes", "point nodes"

ELLIPSOID_LIMIT = 100_000
"""Above this number of Gaussians points are drawn; instances become too slow."""

PROBABILITY_RAMP = (
    # position, sRGB, coverage: how far the colour of the ramp replaces the Gaussian's own dimmed one.
    (0.00, (0.000, 0.135, 0.305), 0.00),
    (0.30, (0.255, 0.305, 0.425), 0.25),
    (0.50, (0.485, 0.480, 0.475), 0.75),
    (0.75, (0.735, 0.690, 0.400), 1.00),
    (1.00, (1.000, 0.910, 0.145), 1.00),
)
"""Cividis (Nuñez et al. 2018): its lightness rises evenly, so it is readable with any colour vision."""

RAMP_START = 0.5
"""Position of the threshold on the ramp; certainty is at its end. Gaussians below the threshold are not coloured."""

THRESHOLD, DIMMING = 0.5, 0.65
"""Defaults: least probability of a match, and how much to darken the others."""


@dataclass(frozen=True)
class Piece:
    """A node tree being built, left to right."""

    tree: bpy.types.NodeTree

    def node(
        self, kind: str, column: int, row: int, inputs: dict[str | int, Any] | None = None, **settings: Any
    ) -> Any:
        """Add a node; inputs are values, or sockets to link from."""
        node = self.tree.nodes.new(kind)
        node.location = (220 * column, -180 * row)
        for name, value in settings.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[key])
            else:
                node.inputs[key].default_value = value
        return node

    def attribute(self, name: str, data_type: str, column: int, row: int) -> Any:
        """The output socket of a named attribute."""
        return self.node("GeometryNodeInputNamedAttribute", column, row, {"Name": name}, data_type=data_type).outputs[0]

    def add_at_least(self, value: Any, bound: Any, column: int, row: int) -> Any:
        """Add value ≥ bound, numbers."""
        node = self.node("FunctionNodeCompare", column, row, {0: value, 1: bound}, operation="GREATER_EQUAL")
        return node.outputs[0]


def _ensure_block(name: str, role: str, blocks: Any, make: Callable[[], Any]) -> Any:
    """Return our data block with that role and version, created if this file has none."""
    mark = f"{role} {VERSION}"
    for block in blocks:
        if block.get(OWNER) == mark and block.library is None:
            return block
    block = make()
    block.name = name
    block[OWNER] = mark
    return block


def gaussian_node_group() -> bpy.types.GeometryNodeTree:
    """Points with our attributes → ellipsoids (up to `ELLIPSOID_LIMIT`) or points, coloured by probability."""
    return _ensure_block("FruitLangs Gaussians", GAUSSIAN_NODES, bpy.data.node_groups, _make_gaussian_group)


def point_node_group() -> bpy.types.GeometryNodeTree:
    """Points with `radiance:base` → small points in that colour."""
    return _ensure_block("FruitLangs Points", POINT_NODES, bpy.data.node_groups, _make_point_group)


def find_modifiers(item: bpy.types.Object) -> list[Any]:
    """Find the modifiers with our nodes, of any version, that show Gaussians or sparse points."""
    found = [modifier for modifier in item.modifiers if modifier.type == "NODES" and modifier.node_group is not None]
    return [one for one in found if str(one.node_group.get(OWNER, "")).startswith((GAUSSIAN_NODES, POINT_NODES))]


def probability_material(attribute_type: str) -> bpy.types.Material:
    """Probability as emission; `attribute_type`: INSTANCER for instances, GEOMETRY for points."""
    name = f"Gaussian probability ({attribute_type.lower()})"
    return _ensure_block(name, name, bpy.data.materials, lambda: _make_probability_material(attribute_type))


def color_material() -> bpy.types.Material:
    """`radiance:base` of points as emission."""
    return _ensure_block("Sparse point colour", "point colour", bpy.data.materials, _make_color_material)


def set_input(modifier: bpy.types.NodesModifier, name: str, value: Any) -> None:
    """Set an input of a Geometry Nodes modifier by its name."""
    identifier = _find_identifier(modifier, name)
    if hasattr(modifier, "properties"):  # Blender 5.2
        getattr(modifier.properties.inputs, identifier).value = value
    else:
        modifier[identifier] = value


def get_input(modifier: bpy.types.NodesModifier, name: str) -> Any:
    """An input of a Geometry Nodes modifier by its name: a number, or a tuple of them."""
    identifier = _find_identifier(modifier, name)
    if hasattr(modifier, "properties"):  # Blender 5.2
        value = getattr(modifier.properties.inputs, identifier).value
    else:
        value = modifier[identifier]
    return tuple(value) if hasattr(value, "__len__") else value


def _find_identifier(modifier: bpy.types.NodesModifier, name: str) -> str:
    for socket in modifier.node_group.interface.items_tree:
        if socket.name == name and socket.in_out == "INPUT":
            return str(socket.identifier)
    raise KeyError(f"{modifier.node_group.name} has no input {name}")


def renew_nodes(modifier: bpy.types.NodesModifier) -> None:
    """Update the nodes of one of the `find_modifiers` modifiers if they are of an older version; inputs stay."""
    old = modifier.node_group
    group = point_node_group() if str(old[OWNER]).startswith(POINT_NODES) else gaussian_node_group()
    if old == group:
        return
    names = [item.name for item in old.interface.items_tree if item.in_out == "INPUT" and item.name != "Geometry"]
    kept = {name: get_input(modifier, name) for name in names}
    modifier.node_group = group
    for name, value in kept.items():
        set_input(modifier, name, value)


def _add_input(group: Any, name: str, kind: str, default: Any, low: Any, high: Any, description: str) -> None:
    socket = group.interface.new_socket(name, in_out="INPUT", socket_type=kind, description=description)
    socket.default_value = default
    if low is not None:
        socket.min_value, socket.max_value = low, high


def _make_group() -> Any:
    group = bpy.data.node_groups.new("FruitLangs", "GeometryNodeTree")
    group.is_modifier = True
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    return group


def _make_gaussian_group() -> bpy.types.GeometryNodeTree:
    group = _make_group()
    number, whole = "NodeSocketFloat", "NodeSocketInt"
    _add_input(group, "Size", number, 1.5, 0.0, 5.0, "Half axes of an ellipsoid, in standard deviations")
    _add_input(group, "Lowest Probability", number, 0.0, 0.0, 1.0, "Hide Gaussians less likely than this")
    _add_input(group, "Lowest Opacity", number, 0.1, 0.0, 1.0, "Hide Gaussians more transparent than this")
    _add_input(group, "Reach", number, 1e9, 0.0, 1e9, "Hide Gaussians farther than this from the centre, as of the sky")
    _add_input(group, "Centre", "NodeSocketVector", (0.0, 0.0, 0.0), -1e9, 1e9, "What the cameras look at")
    _add_input(
        group,
        "Highlight",
        "NodeSocketBool",
        False,
        None,
        None,
        "Highlight Gaussians that match the prompt, from grey at the threshold to yellow",
    )
    _add_input(
        group, "Threshold", number, THRESHOLD, 0.0, 1.0, "Least probability at which a Gaussian matches the prompt"
    )
    _add_input(group, "Dimming", number, DIMMING, 0.0, 1.0, "How much to darken Gaussians below the threshold")
    _add_viewport_input(group)
    _add_input(
        group, "Ellipsoids up to", whole, ELLIPSOID_LIMIT, 0, 10_000_000, "Draw points when there are more than this"
    )

    piece = Piece(group)
    given = piece.node("NodeGroupInput", 0, 0).outputs
    scale = piece.attribute("scale", "FLOAT_VECTOR", 0, 2)
    likely = piece.add_at_least(piece.attribute("probability", "FLOAT", 0, 3), given["Lowest Probability"], 1, 2)
    solid = piece.add_at_least(piece.attribute("opacity", "FLOAT", 0, 4), given["Lowest Opacity"], 1, 3)
    position = piece.node("GeometryNodeInputPosition", 0, 5).outputs[0]
    away = piece.node("ShaderNodeVectorMath", 1, 4, {0: position, 1: given["Centre"]}, operation="DISTANCE").outputs[1]
    near = piece.add_at_least(given["Reach"], away, 2, 4)
    both = piece.node("FunctionNodeBooleanMath", 2, 2, {0: likely, 1: solid}, operation="AND").outputs[0]
    shown = piece.node("FunctionNodeBooleanMath", 3, 2, {0: both, 1: near}, operation="AND").outputs[0]
    axes = piece.node("ShaderNodeVectorMath", 2, 3, {0: scale, "Scale": given["Size"]}, operation="SCALE").outputs[0]
    radius = piece.node("ShaderNodeVectorMath", 3, 3, {0: axes, 1: (1 / 3,) * 3}, operation="DOT_PRODUCT").outputs[1]
    points = piece.node(
        "GeometryNodeMeshToPoints", 4, 1, {"Mesh": given["Geometry"], "Selection": shown, "Radius": radius}
    ).outputs[0]
    points = _highlight(piece, points, given)

    ellipsoids = _add_ellipsoids(piece, points, axes)
    dots = piece.node(
        "GeometryNodeSetMaterial", 7, 0, {"Geometry": points, "Material": probability_material("GEOMETRY")}
    ).outputs[0]
    size = piece.node("GeometryNodeAttributeDomainSize", 5, -1, {"Geometry": points}, component="POINTCLOUD")
    # As floats: the sockets of integer comparison differ between Blender's versions.
    counts: dict[str | int, Any] = {0: size.outputs["Point Count"], 1: given["Ellipsoids up to"]}
    many = piece.node("FunctionNodeCompare", 6, -1, counts, operation="GREATER_THAN").outputs[0]
    chosen = piece.node(
        "GeometryNodeSwitch", 8, 0, {"Switch": many, "False": ellipsoids, "True": dots}, input_type="GEOMETRY"
    ).outputs[0]
    piece.node("NodeGroupOutput", 11, 0, {0: _switch_where_shown(piece, chosen, given, 8)})
    return group


def _add_viewport_input(group: Any) -> None:
    _add_input(
        group, "In Viewport", "NodeSocketBool", True, None, None, "Show Gaussians in viewports as well as in renders"
    )


def _switch_where_shown(piece: Piece, geometry: Any, given: Any, column: int) -> Any:
    """Return the geometry, or none in viewports where "In Viewport" is off.

    The modifier's own display setting is not used: the bare mesh would then appear as black dots.
    """
    viewport = piece.node("GeometryNodeIsViewport", column, 2).outputs[0]
    hidden = piece.node(
        "FunctionNodeBooleanMath", column + 1, 1, {0: viewport, 1: given["In Viewport"]}, operation="NIMPLY"
    ).outputs[0]
    return piece.node(
        "GeometryNodeSwitch", column + 2, 0, {"Switch": hidden, "False": geometry}, input_type="GEOMETRY"
    ).outputs[0]


def _highlight(piece: Piece, points: Any, given: Any) -> Any:
    """Return points with the attributes `ramp` (position on `PROBABILITY_RAMP`, 0 for none) and `brightness` of the
    material.

    Computes the same as the highlight in `splat_shader`.
    """
    probability = piece.attribute("probability", "FLOAT", 3, 8)
    fits = piece.add_at_least(probability, given["Threshold"], 4, 8)
    lit = piece.node("FunctionNodeBooleanMath", 5, 8, {0: fits, 1: given["Highlight"]}, operation="AND").outputs[0]
    place = piece.node(
        "ShaderNodeMapRange", 5, 9, {"Value": probability, 1: given["Threshold"], 2: 1.0, 3: RAMP_START, 4: 1.0}
    ).outputs[0]
    ramp = piece.node("ShaderNodeMath", 6, 8, {0: lit, 1: place}, operation="MULTIPLY").outputs[0]
    dim = piece.node("FunctionNodeBooleanMath", 5, 10, {0: given["Highlight"], 1: fits}, operation="NIMPLY").outputs[0]
    lost = piece.node("ShaderNodeMath", 6, 10, {0: dim, 1: given["Dimming"]}, operation="MULTIPLY").outputs[0]
    brightness = piece.node("ShaderNodeMath", 7, 10, {0: 1.0, 1: lost}, operation="SUBTRACT").outputs[0]
    for column, (name, value) in enumerate((("ramp", ramp), ("brightness", brightness))):
        points = piece.node(
            "GeometryNodeStoreNamedAttribute",
            5 + column,
            6,
            {"Geometry": points, "Name": name, "Value": value},
            data_type="FLOAT",
            domain="POINT",
        ).outputs[0]
    return points


def _add_ellipsoids(piece: Piece, points: Any, axes: Any) -> Any:
    """Add a small smooth sphere instanced on every point, rotated and scaled."""
    ball = piece.node("GeometryNodeMeshIcoSphere", 4, 3, {"Radius": 1.0, "Subdivisions": 2}).outputs[0]
    smooth = piece.node("GeometryNodeSetShadeSmooth", 5, 3, {"Geometry": ball}).outputs[0]
    lit = piece.node(
        "GeometryNodeSetMaterial", 6, 3, {"Geometry": smooth, "Material": probability_material("INSTANCER")}
    ).outputs[0]
    turned = piece.attribute("quaternion", "QUATERNION", 4, 4)
    return piece.node(
        "GeometryNodeInstanceOnPoints", 7, 2, {"Points": points, "Instance": lit, "Rotation": turned, "Scale": axes}
    ).outputs[0]


def _make_point_group() -> bpy.types.GeometryNodeTree:
    group = _make_group()
    _add_input(group, "Radius", "NodeSocketFloat", 0.01, 0.0, 1e6, "Radius of a point, in units of the scene")
    _add_viewport_input(group)
    piece = Piece(group)
    given = piece.node("NodeGroupInput", 0, 0).outputs
    points = piece.node("GeometryNodeMeshToPoints", 1, 0, {"Mesh": given["Geometry"], "Radius": given["Radius"]})
    shown = piece.node("GeometryNodeSetMaterial", 2, 0, {"Geometry": points.outputs[0], "Material": color_material()})
    piece.node("NodeGroupOutput", 6, 0, {0: _switch_where_shown(piece, shown.outputs[0], given, 3)})
    return group


def _make_light_material() -> tuple[bpy.types.Material, Piece, Any]:
    """Make a material of emission only: the photos already contain the light."""
    material = bpy.data.materials.new("FruitLangs")
    material.use_nodes = True
    material.node_tree.nodes.clear()
    piece = Piece(material.node_tree)
    light = piece.node("ShaderNodeEmission", 4, 0)
    piece.node("ShaderNodeOutputMaterial", 5, 0, {"Surface": light.outputs[0]})
    return material, piece, light


def _make_color_material() -> bpy.types.Material:
    material, piece, light = _make_light_material()
    own = piece.node("ShaderNodeAttribute", 2, 0, attribute_name="radiance:base", attribute_type="GEOMETRY")
    piece.tree.links.new(own.outputs["Color"], light.inputs["Color"])
    return material


def _make_probability_material(attribute_type: str) -> bpy.types.Material:
    material, piece, light = _make_light_material()
    likely = piece.node("ShaderNodeAttribute", 0, 0, attribute_name="ramp", attribute_type=attribute_type)
    bright = piece.node("ShaderNodeAttribute", 0, 2, attribute_name="brightness", attribute_type=attribute_type)
    own = piece.node("ShaderNodeAttribute", 0, 1, attribute_name="radiance:base", attribute_type=attribute_type)
    ramp = piece.node("ShaderNodeValToRGB", 1, 0, {"Fac": likely.outputs["Fac"]})
    _set_ramp(ramp.color_ramp)
    dim = piece.node("ShaderNodeVectorMath", 1, 2, {0: own.outputs["Vector"]}, operation="SCALE")
    piece.tree.links.new(bright.outputs["Fac"], dim.inputs["Scale"])
    mix = piece.node("ShaderNodeMix", 3, 0, data_type="RGBA")
    for source, target in ((ramp.outputs["Alpha"], 0), (dim.outputs[0], 6), (ramp.outputs["Color"], 7)):
        piece.tree.links.new(source, mix.inputs[target])
    piece.tree.links.new(mix.outputs[2], light.inputs["Color"])
    return material


def _set_ramp(ramp: bpy.types.ColorRamp) -> None:
    while len(ramp.elements) < len(PROBABILITY_RAMP):
        ramp.elements.new(0.5)
    for element, (position, srgb, cover) in zip(ramp.elements, PROBABILITY_RAMP, strict=True):
        element.position = position
        element.color = (*(float(value) for value in linear_from_srgb(srgb)), cover)
