"""Which Python packages the engine needs and this Blender's Python lacks, and the command that installs them."""

from __future__ import annotations

import importlib.util
import sys

import bpy
import numpy as np

REQUIRED = {
    "torch": "torch",
    "numba": "numba",
    "pycolmap": "pycolmap",
    "safetensors": "safetensors",
    "plyfile": "plyfile",
    "psutil": "psutil",
    "trimesh": "trimesh",
    "scipy": "scipy",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "PIL": "pillow",
}
"""{module: pip package} of what the panel needs; the command line also needs tyro and tqdm, and says so."""


def missing_packages() -> list[str]:
    """pip names of what cannot be imported; looked up, not imported, so a panel may ask at every draw."""
    return [package for module, package in REQUIRED.items() if importlib.util.find_spec(module) is None]


def install_command(packages: list[str]) -> str:
    """A line for a terminal. Blender's own NumPy is pinned, because replacing it breaks other add-ons."""
    return f'"{sys.executable}" -m pip install {" ".join(packages)} numpy=={np.__version__}'


class FRUITLANGS_OT_copy_install_command(bpy.types.Operator):
    bl_idname = "fruitlangs.copy_install_command"
    bl_label = "Copy Install Command"
    bl_description = (
        "Copy the command that installs the missing Python packages; run it in a terminal, then restart Blender"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bool(missing_packages())

    def execute(self, context: bpy.types.Context) -> set[str]:
        context.window_manager.clipboard = install_command(missing_packages())
        self.report({"INFO"}, "Copied; run it in a terminal, then restart Blender")
        return {"FINISHED"}


CLASSES = (FRUITLANGS_OT_copy_install_command,)
