"""Puts the plain arrays of an orchard into a Blender scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..planting import Orchard
from ..plants.crop import PlacedFruit
from ..plants.foliage import Leaves, rotate_in_wind
from ..shapes.branch import Branch, to_unit
from ..shapes.ground import TUFT_PROTOTYPES
from ..shapes.landscape import make_backdrop_mesh, make_ground_mesh
from ..shapes.meshes import join_meshes, make_leaf_prototype, make_stalk_mesh, make_tube, make_tuft_prototype
from ..species import linear_rgb
from ..surroundings.neighbours import Prototype
from . import materials
from .blender_objects import add_object, make_mesh_data, matrix_of
from .distractor_materials import distractor_material

FloatArray = NDArray[np.float64]
LEAF_TONES = 6
"""Colours of a neighbour's leaves."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """The settings that change from view to view."""

    leaves: tuple[Any, ...]
    """The leaf objects of the row's trees, in the order of `Orchard.leaves`."""
    exposure: float
    """Stops, before any drift."""


def set_stage(orchard: Orchard) -> Stage:
    """Replace Blender's current file by this orchard."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = np.random.default_rng([orchard.config.seed, 10])
    bark = _wood(orchard, rng)
    foliage = _Foliage(rng, orchard)
    things = foliage.hang(orchard.leaves, None)
    fruit = materials.fruit_material(orchard.species)
    for placed, mesh in zip(orchard.fruits, orchard.fruit_meshes, strict=False):  # those of the neighbours follow
        thing = add_object(f"fruit.{placed.id:03d}", make_mesh_data("fruit", mesh, fruit))
        thing.pass_index = placed.id
    _add_ground(orchard, rng)
    _set_light(orchard, rng)
    _add_neighbours(orchard, bark, foliage, fruit)
    _add_distractors(orchard)
    return Stage(leaves=tuple(things), exposure=float(bpy.context.scene.view_settings.exposure))


def dress(stage: Stage, orchard: Orchard, number: int) -> None:
    """Set exposure, white balance and wind of the view with this number; nothing else differs between views."""
    config = orchard.config
    rng = np.random.default_rng([config.seed, 21, number])
    view = bpy.context.scene.view_settings
    view.exposure = stage.exposure + config.exposure_drift * rng.normal()
    if config.white_balance_drift > 0:
        half = 0.5 * config.white_balance_drift * rng.normal()
        view.use_curve_mapping = True
        # This brightness becomes white: the picture is divided by it.
        view.curve_mapping.white_level = (float(np.exp(-half)), 1.0, float(np.exp(half)))
        view.curve_mapping.update()
    if config.leaf_motion > 0:
        frames = rotate_in_wind(rng, orchard.leaves, config.leaf_motion)
        leaves = orchard.leaves
        for thing, frame, base, length in zip(stage.leaves, frames, leaves.bases, leaves.lengths, strict=True):
            thing.matrix_world = matrix_of(frame, base, float(length))


@dataclass(frozen=True, kw_only=True)
class _Bark:
    """Materials of wood."""

    trunk: Any
    twig: Any


def _wood(orchard: Orchard, rng: np.random.Generator) -> _Bark:
    shade = rng.uniform(0.75, 1.25) * np.array([1.0, rng.uniform(0.9, 1.0), rng.uniform(0.8, 1.0)])

    def tone(hex_color: str) -> tuple[float, ...]:
        return (*np.clip(linear_rgb(hex_color) * shade, 0, 1).tolist(), 1.0)

    bark = _Bark(
        trunk=materials.wood_material("trunk", (tone("#3f342b"), tone("#8d7f6f")), scale=60.0, bump=0.6),
        twig=materials.wood_material("branch", (tone("#4a3a2c"), tone("#85725c")), scale=90.0, bump=0.3),
    )
    post = materials.wood_material("post", (tone("#6b6459"), tone("#a89f90")), scale=40.0, bump=0.2)
    _add_tree_wood(orchard.branches, orchard.fruits, bark, None)
    for i, mesh in enumerate(orchard.ground.posts):
        add_object(f"post.{i}", make_mesh_data("post", mesh, post))
    return bark


def _add_tree_wood(branches: Sequence[Branch], fruits: Sequence[PlacedFruit], bark: _Bark, collection: Any) -> None:
    """Add trunks, branches and the stalks of the fruit."""
    trunks = [make_tube(b.points, b.radii, segments=14, cap=True) for b in branches if b.generation == 0]
    add_object("trunk", make_mesh_data("trunk", join_meshes(trunks), bark.trunk), collection)
    sides = {1: 9, 2: 6, 3: 5}
    parts = [make_tube(b.points, b.radii, segments=sides[b.generation], cap=True) for b in branches if b.generation]
    parts += [make_stalk_mesh(f.body, f.anchor, f.diameter) for f in fruits if f.anchor is not None]
    add_object("branches", make_mesh_data("branches", join_meshes(parts), bark.twig), collection)


class _Foliage:
    """Hangs instances of a few leaf meshes, each leaf with its own colour."""

    def __init__(self, rng: np.random.Generator, orchard: Orchard) -> None:
        material = materials.leaf_material()
        self.rng = rng
        self.prototypes = [
            make_mesh_data("leaf", make_leaf_prototype(rng, orchard.species), material) for _ in range(8)
        ]
        self.dark, self.light = (linear_rgb(c) for c in orchard.species.leaf_colors)
        self.yellow = rng.uniform(0.0, 0.04)
        self.whole = rng.uniform(0.85, 1.15) * (1 + rng.normal(0, 0.05, 3))

    def hang(self, leaves: Leaves, collection: Any) -> list[Any]:
        """One object a leaf, in the scene or in a collection."""
        yellow = self.rng.uniform(size=len(leaves.bases)) < self.yellow
        tints = 1 + self.rng.normal(0.0, 0.05, (len(leaves.bases), 3))
        things = []
        for i, (base, frame, length, shade) in enumerate(
            zip(leaves.bases, leaves.frames, leaves.lengths, leaves.shades, strict=True)
        ):
            thing = add_object("leaf", self.prototypes[i % len(self.prototypes)], collection)
            thing.matrix_world = matrix_of(frame, base, float(length))
            color = linear_rgb("#b5a23c") if yellow[i] else self.dark + (self.light - self.dark) * shade
            thing.color = (*np.clip(color * tints[i] * self.whole, 0, 1).tolist(), 1.0)
            things.append(thing)
        return things


def _add_neighbours(orchard: Orchard, bark: _Bark, foliage: _Foliage, fruit: Any) -> None:
    """Add wood and leaves of each prototype once, as collections that its copies instance; fruit are objects for their
    ids."""
    shown = [_make_shown_parts(prototype, bark, foliage) for prototype in orchard.prototypes]
    meshes = [[make_mesh_data("fruit", mesh, fruit) for mesh in each.fruit_meshes] for each in orchard.prototypes]
    for neighbour in orchard.neighbours:
        where = matrix_of(neighbour.frame, neighbour.foot, 1.0)
        for part in shown[neighbour.prototype]:
            copy = add_object("neighbour", None)
            copy.instance_type = "COLLECTION"
            copy.instance_collection = part.collection
            copy.color = part.color
            copy.matrix_world = where
        for i, mesh in enumerate(meshes[neighbour.prototype]):
            thing = add_object("neighbour.fruit", mesh)
            thing.matrix_world = where
            thing.pass_index = neighbour.first_id + i


@dataclass(frozen=True, kw_only=True)
class _ShownPart:
    """A part of a prototype that its copies show in one colour: in Cycles instances have the colour of their
    instancer."""

    collection: Any
    color: tuple[float, ...]


def _make_shown_parts(prototype: Prototype, bark: _Bark, foliage: _Foliage) -> list[_ShownPart]:
    wood = bpy.data.collections.new("neighbour.wood")
    _add_tree_wood(prototype.branches, prototype.fruits, bark, wood)
    parts = [_ShownPart(collection=wood, color=(1.0, 1.0, 1.0, 1.0))]
    for rows in np.array_split(np.argsort(prototype.leaves.shades, kind="stable"), LEAF_TONES):
        if len(rows):
            collection = bpy.data.collections.new("neighbour.leaves")
            things = foliage.hang(prototype.leaves.select(rows), collection)
            parts.append(_ShownPart(collection=collection, color=tuple(things[len(things) // 2].color)))
    return parts


def _add_distractors(orchard: Orchard) -> None:
    for word, meshes, translucency in (("tag", orchard.tags, 0.1), ("flower", orchard.flowers, 0.35)):
        if meshes:
            material = distractor_material(word, translucency=translucency)
            add_object(word, make_mesh_data(word, join_meshes(meshes), material, smooth=False))
    for thing in orchard.things:
        smooth = thing.word in ("bucket", "stone", "object")
        material = distractor_material(thing.word, translucency=0.0, gloss=thing.gloss)
        add_object(thing.word, make_mesh_data(thing.word, thing.mesh, material, smooth=smooth))


def _add_ground(orchard: Orchard, rng: np.random.Generator) -> None:
    ground = orchard.ground
    add_object("ground", make_mesh_data("ground", make_ground_mesh(ground, orchard.size), materials.ground_material()))
    if rng.uniform() < 0.65:
        far = orchard.size + 0.05 * orchard.ground.half_row
        add_object("backdrop", make_mesh_data("backdrop", make_backdrop_mesh(rng, far), materials.backdrop_material()))
    material = materials.grass_material()
    prototypes = [make_mesh_data("tuft", make_tuft_prototype(rng), material) for _ in range(TUFT_PROTOTYPES)]
    dark, light = ground.grass
    for tuft in ground.tufts:
        thing = add_object("tuft", prototypes[tuft.prototype])
        c, s = np.cos(tuft.turn), np.sin(tuft.turn)
        thing.matrix_world = matrix_of(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), tuft.position, tuft.scale)
        thing.color = (*np.clip(dark + (light - dark) * tuft.shade, 0, 1).tolist(), 1.0)


def _set_light(orchard: Orchard, rng: np.random.Generator) -> None:
    """Add a sun with sharp shadows and a paler sky, or only a white sky, with the exposure that a camera would
    choose."""
    v = orchard.config.light_variety

    def around(value: float, spread: float) -> float:
        return float(value * np.exp(v * rng.uniform(-spread, spread)))

    overcast = bool(rng.uniform() < 0.5 * v)
    # The white point of the camera: warm or cold, slightly green or pink.
    cast = np.exp(v * rng.uniform(-1.0, 1.0, 3) * [0.08, 0.03, 0.1])
    _add_sun(rng, v, cast, energy=around(0.7 if overcast else 5.0, 0.5), angle=around(40.0 if overcast else 2.0, 1.2))
    zenith, haze = np.array([0.24, 0.45, 0.92]), rng.uniform(0.5, 1.0)
    cloud = np.array([1.0, 1.0, 1.02]) * (1.0 if overcast else 1.5)
    materials.make_sky(
        bpy.context.scene,
        horizon=tuple(((zenith + (np.array([0.9, 0.96, 1.0]) - zenith) * haze) * cast).tolist()),
        zenith=tuple((((0.2 * zenith + 0.75) if overcast else zenith) * cast).tolist()),
        cloud=tuple((cloud * cast).tolist()),
        clouds=float(rng.uniform(0.6, 1.0) if overcast else rng.uniform(0.0, 0.8)),
        strength=around(0.95 if overcast else 0.8, 0.35),
    )
    _set_camera_response(rng, v, stops=1.75 if overcast else 1.0)


def _add_sun(rng: np.random.Generator, variety: float, cast: FloatArray, *, energy: float, angle: float) -> None:
    """Add a sun lamp; `angle` is its width in degrees: the wider, the softer the shadows."""
    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.energy, lamp.angle = energy, float(np.radians(angle))
    warm = variety * rng.uniform(-0.5, 1.0)
    lamp.color = tuple((np.array([1.0, 0.95 - 0.08 * warm, 0.87 - 0.22 * warm]) * cast).tolist())
    turn, rise = rng.uniform(0, 2 * np.pi), np.radians(50 + variety * rng.uniform(-30, 25))
    to_sun = np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
    side = to_unit(np.cross([0.0, 0.0, 1.0], to_sun))
    frame = np.stack([side, np.cross(to_sun, side), to_sun], axis=1)
    add_object("sun", lamp).matrix_world = matrix_of(frame, np.zeros(3), 1.0)


def _set_camera_response(rng: np.random.Generator, variety: float, *, stops: float) -> None:
    """Use plain sRGB, as in small cameras: bright parts clip. Exposure and contrast vary."""
    view = bpy.context.scene.view_settings
    view.view_transform = "Standard"
    looks = ("None", "Medium High Contrast", "High Contrast")
    view.look = looks[int(rng.integers(3))] if variety > 0.5 else looks[1]
    view.exposure = float(stops + variety * rng.uniform(-1.0, 0.55))
