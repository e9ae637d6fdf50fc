"""Objects in the Blender scene at hand, for tests."""

from __future__ import annotations

import bpy


def written(counted, probability=True):
    """The Gaussians of `counted`, as a count writes them."""
    from fruitlangs.operators.write_gaussians import write_gaussians
    from fruitlangs.operators.write_root import write_root

    scene, gaussians, values, fruit_count = counted.parts()
    root = write_root(bpy.context.scene, scene)
    return write_gaussians(
        bpy.context.scene, scene, gaussians, values if probability else None, fruit_count.fruits, root
    )


def imported(counted):
    """The sparse points of a scene, as an import writes them."""
    from fruitlangs.operators.write_points import write_points
    from fruitlangs.operators.write_root import write_root

    scene = counted.parts()[0]
    return write_points(bpy.context.scene, scene, write_root(bpy.context.scene, scene))
