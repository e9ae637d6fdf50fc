"""Cheap Cycles materials. A material's pass index is the class of the pixels that show it."""

from __future__ import annotations

from typing import Any

import bpy

from ..classes import CLASSES, FRUIT
from ..species import Species


class _Nodes:
    """Builds a node tree with little noise: `nodes("ShaderNodeX", Input=value or socket)`."""

    def __init__(self, tree: Any) -> None:
        self.tree = tree
        tree.nodes.clear()

    def __call__(self, kind: str, settings: dict[str, Any] | None = None, **inputs: Any) -> Any:
        node = self.tree.nodes.new(kind)
        for name, value in (settings or {}).items():
            setattr(node, name, value)
        for name, value in inputs.items():
            key: int | str = int(name[1:]) if name[0] == "_" else name.replace("_", " ")
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[key])
            else:
                node.inputs[key].default_value = value
        return node


def _material(name: str, index: int) -> tuple[Any, _Nodes]:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.pass_index = index
    return material, _Nodes(material.node_tree)


def _finish(nodes: _Nodes, shader: Any) -> None:
    nodes("ShaderNodeOutputMaterial", Surface=shader)


def leaf_material() -> Any:
    """Diffuse, translucent and waxy, in the colour of the object; matte and paler below, quilted between the side
    veins."""
    material, nodes = _material("leaf", CLASSES.index("leaf"))
    color, relief = _add_veins(nodes, _age(nodes))
    back = nodes("ShaderNodeNewGeometry").outputs["Backfacing"]
    pale = nodes("ShaderNodeMixRGB", {"blend_type": "MIX"}, _0=0.4, _1=color, _2=(0.33, 0.4, 0.24, 1)).outputs[0]
    front = nodes("ShaderNodeMixRGB", {"blend_type": "MIX"}, _0=back, _1=color, _2=pale).outputs[0]
    through = nodes("ShaderNodeMixRGB", {"blend_type": "MULTIPLY"}, _0=1.0, _1=color, _2=(2.0, 1.9, 0.55, 1)).outputs[0]
    diffuse = nodes("ShaderNodeBsdfDiffuse", Color=front, Normal=relief).outputs[0]
    translucent = nodes("ShaderNodeBsdfTranslucent", Color=through).outputs[0]
    matte = nodes("ShaderNodeMixShader", _0=0.45, _1=diffuse, _2=translucent).outputs[0]
    random = nodes("ShaderNodeObjectInfo").outputs["Random"]
    wax = nodes("ShaderNodeMapRange", _0=random, _1=0.0, _2=1.0, _3=0.3, _4=0.48).outputs[0]
    gloss = nodes("ShaderNodeBsdfGlossy", Color=(1, 1, 1, 1), Roughness=wax, Normal=relief).outputs[0]
    share = nodes("ShaderNodeFresnel", IOR=1.42).outputs[0]
    _finish(nodes, nodes("ShaderNodeMixShader", _0=share, _1=matte, _2=gloss).outputs[0])
    return material


def _age(nodes: _Nodes) -> Any:
    """Return the colour of the object; some leaves are yellower and a few brown, by the object's random number."""
    thing = nodes("ShaderNodeObjectInfo")
    age = nodes("ShaderNodeMapRange", _0=thing.outputs["Random"], _1=0.7, _2=1.0, _3=0.0, _4=0.55).outputs[0]
    color = nodes("ShaderNodeMixRGB", _0=age, _1=thing.outputs["Color"], _2=(0.3, 0.31, 0.035, 1)).outputs[0]
    dry = nodes("ShaderNodeMath", {"operation": "LESS_THAN"}, _0=thing.outputs["Random"], _1=0.012).outputs[0]
    return nodes("ShaderNodeMixRGB", _0=dry, _1=color, _2=(0.2, 0.13, 0.045, 1)).outputs[0]


def _add_veins(nodes: _Nodes, color: Any) -> tuple[Any, Any]:
    """Return the colour with a paler midrib along the leaf's own y axis and faint slanting side veins, and the relief
    of these."""

    def calculate(operation: str, a: Any, b: Any = 0.0) -> Any:
        return nodes("ShaderNodeMath", {"operation": operation}, _0=a, _1=b).outputs[0]

    place = nodes("ShaderNodeSeparateXYZ", _0=nodes("ShaderNodeTexCoord").outputs["Object"])
    aside = calculate("ABSOLUTE", place.outputs[0])
    rib = nodes("ShaderNodeMapRange", _0=aside, _1=0.006, _2=0.022, _3=0.5, _4=0.0).outputs[0]
    wave = calculate("SINE", calculate("MULTIPLY", calculate("SUBTRACT", place.outputs[1], aside), 52.0))
    vein = nodes("ShaderNodeMapRange", _0=wave, _1=0.9, _2=1.0, _3=0.0, _4=0.1).outputs[0]
    share = calculate("MAXIMUM", rib, vein)
    relief = nodes("ShaderNodeBump", {"invert": True}, Strength=0.28, Distance=0.0006, Height=wave).outputs[0]
    return nodes("ShaderNodeMixRGB", _0=share, _1=color, _2=(0.36, 0.44, 0.16, 1)).outputs[0], relief


def wood_material(name: str, colors: tuple[tuple[float, ...], tuple[float, ...]], *, scale: float, bump: float) -> Any:
    """Bark: noise stretched along the height, with relief, and lichen in patches."""
    material, nodes = _material(name, CLASSES.index(name))
    place = nodes("ShaderNodeTexCoord").outputs["Object"]
    stretched = nodes("ShaderNodeVectorMath", {"operation": "MULTIPLY"}, _0=place, _1=(scale, scale, 0.3 * scale))
    noise = nodes("ShaderNodeTexNoise", Vector=stretched.outputs[0], Scale=1.0, Detail=3.0, Roughness=0.6).outputs[0]
    ramp = nodes("ShaderNodeValToRGB", _0=noise)
    for element, color in zip(ramp.color_ramp.elements, colors, strict=True):
        element.color = color
    ramp.color_ramp.elements[0].position, ramp.color_ramp.elements[1].position = 0.35, 0.68
    relief = nodes("ShaderNodeBump", Strength=bump, Distance=0.01, Height=noise).outputs[0]
    spread = nodes("ShaderNodeTexNoise", Vector=place, Scale=0.4 * scale, Detail=2.0, Roughness=0.7).outputs[0]
    lichen = nodes("ShaderNodeMapRange", _0=spread, _1=0.56, _2=0.68, _3=0.0, _4=0.6).outputs[0]
    color = nodes("ShaderNodeMixRGB", _0=lichen, _1=ramp.outputs[0], _2=(0.33, 0.35, 0.25, 1)).outputs[0]
    _finish(nodes, nodes("ShaderNodeBsdfDiffuse", Color=color, Normal=relief).outputs[0])
    return material


def fruit_material(species: Species) -> Any:
    """Fruit surface: the mesh's own colours, with spots, dots and bloom of the species, under a glossy or a hairy
    layer."""
    material, nodes = _material("fruit", CLASSES.index(FRUIT))
    skin = nodes("ShaderNodeAttribute", {"attribute_name": "tint"}).outputs["Color"]
    place = nodes("ShaderNodeTexCoord").outputs["Object"]
    noise = nodes("ShaderNodeTexNoise", Vector=place, Scale=9.0 / species.diameter, Detail=1.0).outputs[0]
    speckle = nodes("ShaderNodeMapRange", _0=noise, _1=0.3, _2=0.7, _3=0.88, _4=1.1).outputs[0]
    color = nodes("ShaderNodeMixRGB", {"blend_type": "MULTIPLY"}, _0=1.0, _1=skin, _2=speckle).outputs[0]
    color, relief = _add_dots(nodes, species, place, color)
    if species.bloom > 0:
        color = _add_bloom(nodes, species, place, color)
    matte = nodes("ShaderNodeBsdfDiffuse", Color=color, **relief).outputs[0]
    if species.fuzz > 0:
        hair = nodes("ShaderNodeBsdfSheen", Color=(0.9, 0.8, 0.75, 1), Roughness=0.4).outputs[0]
        matte = nodes("ShaderNodeMixShader", _0=species.fuzz, _1=matte, _2=hair).outputs[0]
    gloss = nodes("ShaderNodeBsdfGlossy", Color=(1, 1, 1, 1), Roughness=species.roughness, **relief).outputs[0]
    share = nodes("ShaderNodeFresnel", IOR=1.45).outputs[0]
    _finish(nodes, nodes("ShaderNodeMixShader", _0=share, _1=matte, _2=gloss).outputs[0])
    return material


def _add_dots(nodes: _Nodes, species: Species, place: Any, color: Any) -> tuple[Any, dict[str, Any]]:
    """Return the colour with lenticels, and the input of the shaders, if any, that gives a peel its pores."""
    relief: dict[str, Any] = {}
    if species.lenticels > 0 or species.pores > 0:
        cells = nodes("ShaderNodeTexVoronoi", Vector=place, Scale=17.0 / species.diameter).outputs["Distance"]
        dot = nodes("ShaderNodeMapRange", _0=cells, _1=0.1, _2=0.26, _3=species.lenticels, _4=0.0).outputs[0]
        color = nodes("ShaderNodeMixRGB", _0=dot, _1=color, _2=(0.5, 0.42, 0.2, 1)).outputs[0]
        if species.pores > 0:
            depth = 0.01 * species.diameter
            pores = nodes("ShaderNodeBump", Strength=species.pores, Distance=depth, Height=cells)
            relief["Normal"] = pores.outputs[0]
    return color, relief


def _add_bloom(nodes: _Nodes, species: Species, place: Any, color: Any) -> Any:
    """Return the colour under a pale film that is wiped off in places."""
    wiped = nodes("ShaderNodeTexNoise", Vector=place, Scale=2.2 / species.diameter, Detail=2.0).outputs[0]
    film = nodes("ShaderNodeMapRange", _0=wiped, _1=0.38, _2=0.6, _3=0.0, _4=species.bloom).outputs[0]
    return nodes("ShaderNodeMixRGB", _0=film, _1=color, _2=(0.24, 0.27, 0.42, 1)).outputs[0]


def ground_material() -> Any:
    """The mesh's own colours, drier in patches, with variation by clumps a hand wide and by shaded blades and clods."""
    material, nodes = _material("ground", CLASSES.index("soil"))
    base = nodes("ShaderNodeAttribute", {"attribute_name": "tint"}).outputs["Color"]
    place = nodes("ShaderNodeTexCoord").outputs["Object"]
    patches = nodes("ShaderNodeTexNoise", Vector=place, Scale=2.5, Detail=2.0).outputs[0]
    dry = nodes("ShaderNodeMapRange", _0=patches, _1=0.4, _2=0.75, _3=0.1, _4=0.65).outputs[0]
    color = nodes("ShaderNodeMixRGB", _0=dry, _1=base, _2=(0.21, 0.18, 0.08, 1)).outputs[0]
    for scale, detail, low, high in ((9.0, 3.0, 0.25, 1.1), (75.0, 3.0, 0.3, 1.45)):
        noise = nodes("ShaderNodeTexNoise", Vector=place, Scale=scale, Detail=detail, Roughness=0.75).outputs[0]
        mottle = nodes("ShaderNodeMapRange", _0=noise, _1=0.36, _2=0.64, _3=low, _4=high).outputs[0]
        color = nodes("ShaderNodeMixRGB", {"blend_type": "MULTIPLY"}, _0=1.0, _1=color, _2=mottle).outputs[0]
    _finish(nodes, nodes("ShaderNodeBsdfDiffuse", Color=color).outputs[0])
    return material


def grass_material() -> Any:
    """Diffuse and translucent in the object's colour."""
    material, nodes = _material("grass", CLASSES.index("grass"))
    color = nodes("ShaderNodeObjectInfo").outputs["Color"]
    diffuse = nodes("ShaderNodeBsdfDiffuse", Color=color).outputs[0]
    translucent = nodes("ShaderNodeBsdfTranslucent", Color=color).outputs[0]
    _finish(nodes, nodes("ShaderNodeMixShader", _0=0.4, _1=diffuse, _2=translucent).outputs[0])
    return material


def backdrop_material() -> Any:
    """Distant bushes and trees: the mesh's own colours."""
    material, nodes = _material("backdrop", CLASSES.index("hedge"))
    base = nodes("ShaderNodeAttribute", {"attribute_name": "tint"}).outputs["Color"]
    place = nodes("ShaderNodeTexCoord").outputs["Object"]
    noise = nodes("ShaderNodeTexNoise", Vector=place, Scale=2.2, Detail=6.0, Roughness=0.8).outputs[0]
    foliage = nodes("ShaderNodeMapRange", _0=noise, _1=0.36, _2=0.66, _3=0.12, _4=1.6).outputs[0]
    color = nodes("ShaderNodeMixRGB", {"blend_type": "MULTIPLY"}, _0=1.0, _1=base, _2=foliage).outputs[0]
    _finish(nodes, nodes("ShaderNodeBsdfDiffuse", Color=color).outputs[0])
    return material


def make_sky(
    scene: Any,
    *,
    horizon: tuple[float, ...],
    zenith: tuple[float, ...],
    cloud: tuple[float, ...],
    clouds: float,
    strength: float,
) -> None:
    """Make a sky from horizon to zenith colour with soft clouds, which cover a share of it from 0 to 1."""
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    nodes = _Nodes(world.node_tree)
    direction = nodes("ShaderNodeTexCoord").outputs["Generated"]
    height = nodes("ShaderNodeSeparateXYZ", _0=direction).outputs[2]
    rise = nodes("ShaderNodeMapRange", _0=height, _1=-0.02, _2=0.55, _3=0.0, _4=1.0).outputs[0]
    clear = nodes("ShaderNodeMixRGB", _0=rise, _1=(*horizon, 1), _2=(*zenith, 1)).outputs[0]
    noise = nodes("ShaderNodeTexNoise", Vector=direction, Scale=2.6, Detail=4.0, Roughness=0.55).outputs[0]
    cover = nodes("ShaderNodeMapRange", _0=noise, _1=0.72 - 0.4 * clouds, _2=0.85 - 0.3 * clouds).outputs[0]
    color = nodes("ShaderNodeMixRGB", _0=cover, _1=clear, _2=(*cloud, 1)).outputs[0]
    background = nodes("ShaderNodeBackground", Color=color, Strength=strength).outputs[0]
    nodes("ShaderNodeOutputWorld", Surface=background)
    # A smooth sky is sampled well by the surfaces alone, which saves one shadow ray per bounce.
    world.cycles.sampling_method = "NONE"
    scene.world = world
