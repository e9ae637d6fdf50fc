"""The Gaussian object's attributes as engine values: the inverse of `write_gaussians`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.errors import FormatError
from ..blender_data import find_owned_object, get_attribute, point_positions, srgb_from_linear
from ..viewport.splats import ANTIALIASED
from .write_gaussians import INDEX, NUMBER

if TYPE_CHECKING:
    from ...engine.splatting.gaussians import Gaussians

NEEDED = ("scale", "quaternion", "radiance:base", "opacity")
"""Attributes that a picture needs."""
LEAST = 1e-6
"""Opacities are kept this far from 0 and 1, where logits are infinite."""


@dataclass(frozen=True, eq=False)
class StoredGaussians:
    """The N Gaussians of the mesh as NumPy arrays: reading them does not need PyTorch, whose import takes seconds.

    positions: (N, 3); scales: (N, 3); quaternions: (N, 4); colors: (N, 3) sRGB; opacities: (N,).
    """

    positions: NDArray[np.float32]
    scales: NDArray[np.float32]
    quaternions: NDArray[np.float32]
    colors: NDArray[np.float32]
    opacities: NDArray[np.float32]
    antialiased: bool

    def gaussians(self) -> Gaussians:
        """In the scene frame, without view-dependent colour (spherical harmonics of degree 0)."""
        import torch

        from ...engine.splatting.gaussians import Gaussians, harmonics_of

        return Gaussians(
            means=torch.from_numpy(self.positions),
            log_scales=torch.from_numpy(self.scales).clamp(min=1e-12).log(),
            quats=torch.from_numpy(self.quaternions),
            opacity_logits=torch.logit(torch.from_numpy(self.opacities).clamp(LEAST, 1.0 - LEAST)),
            sh=harmonics_of(self.colors.astype(np.float64)),
            antialiased=self.antialiased,
        )


@dataclass(frozen=True)
class Edits:
    """What the user changed in Edit Mode since the Gaussians were written."""

    deleted: int
    moved: int

    def __bool__(self) -> bool:
        return bool(self.deleted or self.moved)

    @property
    def text(self) -> str:
        """'12 deleted, 3 moved', or one of both."""
        counts = ((self.deleted, "deleted"), (self.moved, "moved"))
        return ", ".join(f"{count:,} {verb}" for count, verb in counts if count)


def count_deleted_gaussians(bpy_scene: bpy.types.Scene) -> int:
    """Count the Gaussians that were written and that the user has deleted; 0 in a file of an earlier version."""
    item = find_owned_object(bpy_scene, "gaussians")
    mesh = None if item is None or item.mode == "EDIT" else item.data
    if mesh is None or NUMBER not in mesh or INDEX not in mesh.attributes or mesh[NUMBER] == len(mesh.vertices):
        return 0
    return int(mesh[NUMBER]) - len(np.unique(gaussian_indices(mesh)))


def gaussian_indices(mesh: bpy.types.Mesh) -> NDArray[np.int32]:
    """(M,) the number of each shown Gaussian in the reconstruction."""
    return get_attribute(mesh, INDEX) if INDEX in mesh.attributes else np.arange(len(mesh.vertices), dtype=np.int32)


def edits_of(bpy_scene: bpy.types.Scene, means: NDArray[np.float32]) -> Edits:
    """The user's edits of Gaussians that are written again at means (N, 3)."""
    stays = find_unmoved(bpy_scene, means)
    return Edits(count_deleted_gaussians(bpy_scene), 0 if stays is None else int((~stays).sum()))


def find_unmoved(bpy_scene: bpy.types.Scene, means: NDArray[np.float32]) -> NDArray[np.bool_] | None:
    """Find (M,) whether each shown Gaussian is where means (N, 3) has it; None if they are other Gaussians."""
    item = find_owned_object(bpy_scene, "gaussians")
    mesh = None if item is None or item.mode == "EDIT" else item.data
    if mesh is None or mesh.get(NUMBER, len(mesh.vertices)) != len(means) or not len(mesh.vertices):
        return None
    same: NDArray[np.bool_] = (get_attribute(mesh, "position") == means[gaussian_indices(mesh)]).all(axis=1)
    return same if 2 * same.sum() > len(same) else None


def read_gaussians(bpy_scene: bpy.types.Scene) -> StoredGaussians | None:
    """This Blender scene's Gaussians; None if it has none.

    Raises:
        FormatError: the object is being edited, or an attribute was removed.
        SceneError: the Gaussians were moved within the mesh.
    """
    item = find_owned_object(bpy_scene, "gaussians")
    if item is None:
        return None
    if item.mode == "EDIT":
        raise FormatError(f"{item.name} is in Edit Mode. Leave it (Tab) and try again")
    mesh = item.data
    missing = [name for name in NEEDED if name not in mesh.attributes]
    if missing:
        raise FormatError(f"{item.name} has lost its attribute '{missing[0]}'. Import the result or count again")
    return StoredGaussians(
        positions=point_positions(item),
        scales=get_attribute(mesh, "scale"),
        quaternions=get_attribute(mesh, "quaternion"),
        colors=srgb_from_linear(get_attribute(mesh, "radiance:base")[:, :3]),
        opacities=get_attribute(mesh, "opacity"),
        antialiased=bool(mesh.get(ANTIALIASED, False)),
    )
