"""Materials of tags, flowers and objects, each with its own class."""

from __future__ import annotations

from typing import Any

import bpy

from ..classes import CLASSES


def distractor_material(word: str, *, translucency: float, gloss: float = 0.0) -> Any:
    """The mesh's own colours; these shares of the light pass through, and are mirrored as by a smooth paint."""
    material = bpy.data.materials.new(word)
    material.use_nodes = True
    material.pass_index = CLASSES.index(word)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    color = nodes.new("ShaderNodeAttribute")
    color.attribute_name = "tint"
    mix = nodes.new("ShaderNodeMixShader")
    mix.inputs[0].default_value = translucency
    for slot, kind in ((1, "ShaderNodeBsdfDiffuse"), (2, "ShaderNodeBsdfTranslucent")):
        matte = nodes.new(kind)
        links.new(color.outputs["Color"], matte.inputs["Color"])
        links.new(matte.outputs[0], mix.inputs[slot])
    surface = mix
    if gloss > 0.0:
        mirror = nodes.new("ShaderNodeBsdfGlossy")
        mirror.inputs["Roughness"].default_value = 0.2
        surface = nodes.new("ShaderNodeMixShader")
        surface.inputs[0].default_value = gloss
        links.new(mix.outputs[0], surface.inputs[1])
        links.new(mirror.outputs[0], surface.inputs[2])
    links.new(surface.outputs[0], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return material
