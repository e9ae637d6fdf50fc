"""Puts the plain arrays of an orchard into a Blender scene."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from . import materials
from .ground import TUFT_PROTOTYPES, Ground
from .meshes import Mesh, joined, leaf_prototype, stalk_mesh, tube, tuft_prototype
from .planting import Orchard
from .species import linear_rgb
from .tree import unit

FloatArray = NDArray[np.float64]


def _mesh_data(name: str, mesh: Mesh, material: Any, *, smooth: bool = True) -> Any:
    data = bpy.data.meshes.new(name)
    faces = [q[:3] if q[2] == q[3] else q for q in mesh.quads.tolist()]
    data.from_pydata(mesh.vertices.tolist(), [], faces)
    data.polygons.foreach_set("use_smooth", np.full(len(faces), smooth))
    if len(mesh.colors):
        layer = data.attributes.new("tint", "FLOAT_COLOR", "POINT")
        rgba = np.ones((len(mesh.vertices), 4), dtype=np.float32)
        rgba[:, :3] = mesh.colors
        layer.data.foreach_set("color", rgba.ravel())
    data.materials.append(material)
    return data


def _object(name: str, data: Any) -> Any:
    thing = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def _matrix(frame: FloatArray, place: FloatArray, scale: float) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3] = frame * scale
    matrix[:3, 3] = place
    return matrix.T.tolist()  # foreach-style column order: Blender's matrix_world setter takes columns


def set_stage(orchard: Orchard) -> None:
    """Replace Blender's current file by this orchard."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = np.random.default_rng([orchard.config.seed, 10])
    _wood(orchard, rng)
    _leaves(orchard, rng)
    _fruits(orchard)
    _ground(orchard, rng)
    _light(orchard, rng)


def _wood(orchard: Orchard, rng: np.random.Generator) -> None:
    shade = rng.uniform(0.75, 1.25) * np.array([1.0, rng.uniform(0.9, 1.0), rng.uniform(0.8, 1.0)])

    def tone(hex_color: str) -> tuple[float, ...]:
        return (*np.clip(linear_rgb(hex_color) * shade, 0, 1).tolist(), 1.0)

    bark = materials.wood_material("trunk", (tone("#3f342b"), tone("#8d7f6f")), scale=60.0, bump=0.6)
    twig = materials.wood_material("branch", (tone("#4a3a2c"), tone("#85725c")), scale=90.0, bump=0.3)
    post = materials.wood_material("post", (tone("#6b6459"), tone("#a89f90")), scale=40.0, bump=0.2)
    trunk = orchard.branches[0]
    _object("trunk", _mesh_data("trunk", tube(trunk.points, trunk.radii, segments=14, cap=True), bark))
    sides = {1: 9, 2: 6, 3: 5}
    parts = [tube(b.points, b.radii, segments=sides[b.generation], cap=True) for b in orchard.branches[1:]]
    parts += [stalk_mesh(f.body, f.anchor, f.diameter) for f in orchard.fruits if f.anchor is not None]
    _object("branches", _mesh_data("branches", joined(parts), twig))
    for i, mesh in enumerate(orchard.ground.posts):
        _object(f"post.{i}", _mesh_data("post", mesh, post))


def _leaves(orchard: Orchard, rng: np.random.Generator) -> None:
    """Instances of a few leaf meshes, each with its own colour."""
    material = materials.leaf_material()
    prototypes = [_mesh_data("leaf", leaf_prototype(rng, orchard.species), material) for _ in range(8)]
    dark, light = (linear_rgb(c) for c in orchard.species.leaf_colors)
    leaves = orchard.leaves
    yellow = rng.uniform(size=len(leaves.bases)) < rng.uniform(0.0, 0.04)
    tints = 1 + rng.normal(0.0, 0.05, (len(leaves.bases), 3))
    whole = rng.uniform(0.85, 1.15) * (1 + rng.normal(0, 0.05, 3))
    for i, (base, frame, length, shade) in enumerate(
        zip(leaves.bases, leaves.frames, leaves.lengths, leaves.shades, strict=True)
    ):
        thing = _object("leaf", prototypes[i % len(prototypes)])
        thing.matrix_world = _matrix(frame, base, float(length))
        color = linear_rgb("#b5a23c") if yellow[i] else dark + (light - dark) * shade
        thing.color = (*np.clip(color * tints[i] * whole, 0, 1).tolist(), 1.0)


def _fruits(orchard: Orchard) -> None:
    material = materials.fruit_material(orchard.species)
    for fruit, mesh in zip(orchard.fruits, orchard.fruit_meshes, strict=True):
        thing = _object(f"fruit.{fruit.id:03d}", _mesh_data("fruit", mesh, material))
        thing.pass_index = fruit.id


def _ground(orchard: Orchard, rng: np.random.Generator) -> None:
    ground = orchard.ground
    size = orchard.species.tree_height / 2.3
    _object("ground", _mesh_data("ground", _ground_mesh(ground, size), materials.ground_material()))
    if rng.uniform() < 0.65:
        _object("backdrop", _mesh_data("backdrop", _backdrop_mesh(rng, size), materials.backdrop_material()))
    material = materials.grass_material()
    prototypes = [_mesh_data("tuft", tuft_prototype(rng), material) for _ in range(TUFT_PROTOTYPES)]
    dark, light = ground.grass
    for tuft in ground.tufts:
        thing = _object("tuft", prototypes[tuft.prototype])
        c, s = np.cos(tuft.turn), np.sin(tuft.turn)
        thing.matrix_world = _matrix(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), tuft.position, tuft.scale)
        thing.color = (*np.clip(dark + (light - dark) * tuft.shade, 0, 1).tolist(), 1.0)


def _ground_mesh(ground: Ground, size: float) -> Mesh:
    """A disc whose rings grow outward, coloured by its patches."""
    radii = np.concatenate([np.linspace(0.0, 4.0, 110)[1:], np.geomspace(4.15, 80.0, 36)]) * size
    turns = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    x, y = (np.outer(radii, f(turns)).ravel() for f in (np.cos, np.sin))
    x, y = np.append(x, 0.0), np.append(y, 0.0)
    fade = np.clip(1.5 - np.hypot(x, y) / (8 * size), 0, 1)
    soil = ground.soil_share(x, y)[:, None]
    tone = np.clip(0.5 + 0.5 * ground.patches(1.7 * x + 5, 1.7 * y - 3), 0, 1)[:, None]
    grass = ground.grass[0] + (ground.grass[1] - ground.grass[0]) * tone
    earth = ground.soil[0] + (ground.soil[1] - ground.soil[0]) * tone
    rings, columns = len(radii), len(turns)
    r = np.arange(rings - 1)[:, None] * columns
    c = np.arange(columns)[None, :]
    n = (c + 1) % columns
    quads = np.stack([r + c, r + columns + c, r + columns + n, r + n], axis=2).reshape(-1, 4)
    middle = np.full(columns, rings * columns)
    fan = np.stack([c[0], n[0], middle, middle], axis=1)
    return Mesh(
        vertices=np.stack([x, y, ground.relief(x, y) * fade], axis=1),
        quads=np.vstack([quads, fan]),
        colors=grass * (1 - soil) + earth * soil,
    )


def _backdrop_mesh(rng: np.random.Generator, size: float) -> Mesh:
    """A far hedge around the place, uneven in height and colour, hazy."""
    turns = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    away = rng.uniform(18, 40) * size
    shape = sum(np.sin(m * turns + rng.uniform(0, 6.28)) / m**0.6 for m in (2, 3, 5, 9, 14, 23, 37))
    high = away * rng.uniform(0.11, 0.22) * np.clip(1.0 + 0.25 * shape, 0.5, 2.2)
    levels = np.array([-0.05, 0.0, 0.4, 0.75, 1.0])
    z = levels[:, None] * high
    r = away * (1 + 0.03 * levels[:, None] + 0.015 * shape)
    vertices = np.stack([r * np.cos(turns), r * np.sin(turns), z], axis=2).reshape(-1, 3)
    dark, light = linear_rgb("#46592f"), linear_rgb("#8a9a6a")
    tone = np.clip(0.25 + 0.5 * levels[:, None] + 0.2 * rng.normal(size=(5, 240)), 0, 1).reshape(-1, 1)
    rows, columns = z.shape
    a = np.arange(rows - 1)[:, None] * columns
    c = np.arange(columns)[None, :]
    n = (c + 1) % columns
    quads = np.stack([a + c, a + columns + c, a + columns + n, a + n], axis=2).reshape(-1, 4)
    return Mesh(vertices=vertices, quads=quads, colors=dark + (light - dark) * tone)


def _light(orchard: Orchard, rng: np.random.Generator) -> None:
    scene = bpy.context.scene
    v = orchard.config.light_variety

    def around(value: float, spread: float) -> float:
        return float(value * np.exp(v * rng.uniform(-spread, spread)))

    overcast = bool(rng.uniform() < 0.6 * v)
    turn, rise = rng.uniform(0, 2 * np.pi), np.radians(50 + v * rng.uniform(-30, 25))
    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.energy = around(0.6 if overcast else 2.6, 0.8)
    lamp.angle = float(np.radians(around(40.0 if overcast else 14.0, 1.0)))
    warm = v * rng.uniform(-0.5, 1.0)
    lamp.color = (1.0, 0.95 - 0.08 * warm, 0.87 - 0.22 * warm)
    sun = bpy.data.objects.new("sun", lamp)
    scene.collection.objects.link(sun)
    to_sun = np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
    side = unit(np.cross([0.0, 0.0, 1.0], to_sun))
    sun.matrix_world = _matrix(np.stack([side, np.cross(to_sun, side), to_sun], axis=1), np.zeros(3), 1.0)
    haze = rng.uniform(0.6, 1.0)
    grey = 0.8 if overcast else 0.0
    zenith = np.array([0.22, 0.42, 0.85]) * (1 - grey) + np.array([0.75, 0.8, 0.88]) * grey
    materials.sky(
        scene,
        horizon=(0.72 * haze, 0.82 * haze, 0.95),
        zenith=tuple(zenith.tolist()),
        clouds=float(rng.uniform(0.3, 0.9)),
        strength=around(0.95, 0.4),
    )
    scene.view_settings.view_transform = "AgX"
    scene.view_settings.look = "AgX - Medium High Contrast"
    scene.view_settings.exposure = float((1.2 if overcast else 0.55) + v * rng.uniform(-0.8, 0.7))
