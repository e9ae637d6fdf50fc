"""Materials of tags, flowers and objects, each with its own class."""

from __future__ import annotations

from typing import Any

import bpy

from ..classes import CLASSES


def distractor_material(word: str, *, translucency: float) -> Any:
    """The mesh's own colours, matte; this share of the light passes through."""
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
        surface = nodes.new(kind)
        links.new(color.outputs["Color"], surface.inputs["Color"])
        links.new(surface.outputs[0], mix.inputs[slot])
    links.new(mix.outputs[0], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return material
