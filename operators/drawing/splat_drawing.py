"""Draws splats in every 3D viewport.

A mesh is read when Blender reports a change. Data on the graphics card belong to this session, not to the .blend, and
are found by the session's ids of meshes and scenes. Nothing here runs in background mode.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import bpy
from bpy.app.handlers import persistent
from mathutils import Matrix

from ..blender_data import OWNER, find_owned_objects
from ..photos.photo_backgrounds import photo_cover
from ..viewport.appearance import appearance_of, apply_changed_appearance
from ..viewport.gaussian_nodes import find_modifiers, get_input
from ..viewport.splats import Splats, splats_of_mesh, splats_of_points
from ..viewport.viewport import Drawing, redraw_viewports

if TYPE_CHECKING:
    from .splat_textures import Picture, SplatTextures

KEPT_VIEWS = 12
"""Number of viewports whose picture and orders are kept."""
EVERYWHERE = ((0.0, 0.0, 0.0), 1e9)
"""Centre and reach that hide nothing."""


@dataclass(frozen=True, eq=False)
class Interim:
    """The current state of training. matrix: from its frame to the world; centre, reach: in its frame, as in the
    modifier."""

    splats: Splats
    matrix: Matrix
    centre: tuple[float, ...]
    reach: float


@dataclass(eq=False)
class Drawn:
    """This session's data on the graphics card.

    meshes: splats by the mesh's session id; stale: ids of meshes that changed since they were read; pictures: by
    viewport; previews: the state of training, by the Blender scene's session id.
    """

    meshes: dict[int, SplatTextures] = field(default_factory=dict)
    stale: set[int] = field(default_factory=set)
    pictures: dict[int, Picture] = field(default_factory=dict)
    previews: dict[int, Interim] = field(default_factory=dict)
    preview_textures: dict[int, SplatTextures] = field(default_factory=dict)
    problem: str = ""


_drawn = Drawn()


def show_preview(scene: int, preview: Interim | None) -> None:
    """Draw these splats instead of the Gaussians of the Blender scene with that session id; None: draw those of the
    .blend again."""
    if bpy.app.background:
        return
    if preview is None:
        _drawn.previews.pop(scene, None)
        _drawn.preview_textures.pop(scene, None)
    else:
        _drawn.previews[scene] = preview
    redraw_viewports()


def has_preview(bpy_scene: bpy.types.Scene) -> bool:
    """Whether the state of a training is drawn instead of this Blender scene's Gaussians."""
    return bpy_scene.session_uid in _drawn.previews


def explain_problem() -> str:
    """Say why splats cannot be drawn in this session; empty if they can."""
    return _drawn.problem


def draw_viewport() -> None:
    """Draw the splats of the scene in the viewport of the context; Blender calls it after drawing its own objects."""
    context = bpy.context
    region, space, bpy_scene = context.region, context.space_data, context.scene
    if region is None or context.region_data is None or _drawn.problem:
        return
    try:
        layers = _collect_layers(bpy_scene, context.view_layer, space)
        if layers:
            # Splats are drawn after the camera's background and would hide the photo.
            strength = 1.0 - photo_cover(space, context.region_data, bpy_scene)
            _draw(layers, bpy_scene, region, context.region_data, strength)
    except Exception as error:  # printed once; every redraw would repeat it thousands of times
        _drawn.problem = f"{type(error).__name__}: {error}"
        print(f"FruitLangs cannot draw splats here, set Show to Ellipsoids: {_drawn.problem}", file=sys.stderr)
        # The panels show it too; a redraw cannot be requested during drawing.
        bpy.app.timers.register(_redraw, first_interval=0.0)


def _redraw() -> None:
    """A timer that runs once."""
    redraw_viewports()


def edit_appearance_soon(settings: Any, context: Any = None) -> None:
    """Called when the appearance was edited: splats that could not be drawn are tried again."""
    global _drawn
    if _drawn.problem:
        _drawn = Drawn(previews=_drawn.previews)
    apply_changed_appearance(settings, context)


_drawing = Drawing(draw_viewport, "POST_VIEW")


def _draw(
    layers: list[tuple[SplatTextures, Matrix]], bpy_scene: Any, region: Any, view_data: Any, strength: float
) -> None:
    from .splat_textures import Highlight, Picture, View, read_depths

    size = (region.width, region.height)
    key = region.as_pointer()
    picture = _drawn.pictures.pop(key, None)
    if picture is None or picture.size != size:
        picture = Picture(size)
    _drawn.pictures[key] = picture
    look = appearance_of(bpy_scene)
    view = View(view_data.view_matrix.copy(), view_data.window_matrix.copy(), size)
    highlight = Highlight(look.highlight, look.threshold, look.dimming)
    picture.draw(layers, view, highlight, read_depths(size), key)
    picture.show(strength)
    while len(_drawn.pictures) > KEPT_VIEWS:
        oldest = next(iter(_drawn.pictures))
        del _drawn.pictures[oldest]
        for textures in (*_drawn.meshes.values(), *_drawn.preview_textures.values()):
            textures.orders.pop(oldest, None)


def _collect_layers(bpy_scene: Any, view_layer: Any, space: Any) -> list[tuple[SplatTextures, Matrix]]:
    """Collect textures and matrices of what is drawn."""
    preview = _drawn.previews.get(bpy_scene.session_uid)
    if preview is not None:
        return [(_preview_textures(bpy_scene.session_uid, preview), preview.matrix)]
    if appearance_of(bpy_scene).style != "SPLATS":
        return []
    items = [*find_owned_objects(bpy_scene, "points"), *find_owned_objects(bpy_scene, "gaussians")]
    visible = [item for item in items if item.visible_get(view_layer=view_layer, viewport=space)]
    found = [(_mesh_textures(item), item.matrix_world.copy()) for item in visible]
    return [(textures, matrix) for textures, matrix in found if textures is not None]


def _preview_textures(scene: int, preview: Interim) -> SplatTextures:
    from .splat_textures import SplatTextures

    textures = _drawn.preview_textures.get(scene)
    if textures is None:
        textures = _drawn.preview_textures[scene] = SplatTextures(preview.splats, preview.centre, preview.reach)
    elif textures.splats is not preview.splats:
        textures.replace(preview.splats, preview.centre, preview.reach)
    return textures


def _mesh_textures(item: bpy.types.Object) -> SplatTextures | None:
    """An object's splats on the card, read again if its mesh changed; unchanged while it is edited."""
    from .splat_textures import SplatTextures

    uid, (centre, reach) = item.data.session_uid, _read_extent(item)
    textures = _drawn.meshes.get(uid)
    if textures is None or uid in _drawn.stale:
        splats = _read(item)
        if splats is None:
            return textures
        _drawn.stale.discard(uid)
        if textures is None:
            textures = _drawn.meshes[uid] = SplatTextures(splats, centre, reach)
        else:
            textures.replace(splats, centre, reach)
    elif (centre, reach) != (textures.centre, textures.reach):
        textures.replace(textures.splats, centre, reach)
    return textures


def _read_extent(item: bpy.types.Object) -> tuple[tuple[float, ...], float]:
    """Read centre and reach of what is shown of an object."""
    modifiers = [] if item[OWNER] == "points" else find_modifiers(item)
    return (get_input(modifiers[0], "Centre"), get_input(modifiers[0], "Reach")) if modifiers else EVERYWHERE


def _read(item: bpy.types.Object) -> Splats | None:
    if item[OWNER] != "points":
        return splats_of_mesh(item.data)
    modifiers = find_modifiers(item)
    return splats_of_points(item.data, get_input(modifiers[0], "Radius")) if modifiers else None


@persistent
def note_changes(_scene: Any, depsgraph: bpy.types.Depsgraph) -> None:
    """After an update: meshes whose geometry changed are read again when they are drawn next.

    So are sparse points whose modifier changed, because it has their radius.
    """
    for update in depsgraph.updates:
        if not update.is_updated_geometry:
            continue
        changed = update.id.original
        if isinstance(changed, bpy.types.Object) and changed.get(OWNER) == "points":
            changed = changed.data
        if isinstance(changed, bpy.types.Mesh):
            _drawn.stale.add(changed.session_uid)


@persistent
def note_all(_file: Any = None, _unused: Any = None) -> None:
    """After undo and redo: any mesh may have changed, and some are gone."""
    alive = {mesh.session_uid for mesh in bpy.data.meshes}
    for uid in set(_drawn.meshes) - alive:
        del _drawn.meshes[uid]
    _drawn.stale = set(_drawn.meshes)


@persistent
def forget_all(_file: Any = None, _unused: Any = None) -> None:
    """Before another file is loaded, and when the extension is disabled."""
    global _drawn
    _drawn = Drawn()


HANDLERS = {
    "depsgraph_update_post": note_changes,
    "undo_post": note_all,
    "redo_post": note_all,
    "load_pre": forget_all,
}


def register_handlers() -> None:
    """Draw in every 3D viewport from now on; nothing in background mode."""
    if bpy.app.background:
        return
    for name, function in HANDLERS.items():
        getattr(bpy.app.handlers, name).append(function)
    _drawing.start()


def unregister_handlers() -> None:
    """Remove what `register_handlers` added."""
    for name, function in HANDLERS.items():
        handlers = getattr(bpy.app.handlers, name)
        if function in handlers:
            handlers.remove(function)
    if bpy.app.background:
        return
    _drawing.stop()
    forget_all()
    from .splat_textures import free

    free()
