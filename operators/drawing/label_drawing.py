"""Text next to every fruit in the viewport: its id, with its name or its diameter."""

from __future__ import annotations

from collections.abc import Sequence

import blf
import bpy
import numpy as np
from numpy.typing import NDArray

from ..data.fruit_objects import diameter_text, list_counted_fruit, metres_per_unit
from ..viewport.viewport import Drawing

FONT, POINTS, BLUR = 0, 12.0, 5
"""Blender's default font, its size at an interface scale of 1, and the size of its shadow."""
GAP = 4.0
"""Pixels between the edge of a fruit and its text."""
COLOR, ACTIVE_COLOR, SHADOW = (1.0, 1.0, 1.0, 1.0), (1.0, 0.75, 0.2, 1.0), (0.0, 0.0, 0.0, 1.0)


def label_text(item: bpy.types.Object, kind: str, metric: bool) -> str:
    """The text next to a fruit: '12', 'apple 12' or '12: 81.2 mm'. metric: diameters are metres."""
    number = str(item.get("id", ""))
    if kind == "NAME":
        return f"{item.get('label', 'fruit')} {number}"
    if kind == "SIZE" and "diameter" in item:
        return f"{number}: {diameter_text(item, metric)}"
    return number


def project(
    places: NDArray[np.float64], matrix: NDArray[np.float64], width: float, height: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, 2) pixels of a region and (N,) depths of places (N, 3) in the world.

    matrix: (4, 4) the view's perspective matrix. Pixels are NaN behind the viewer and outside the region; depths grow
    with the distance, in the matrix's own measure.
    """
    seen = np.concatenate([places, np.ones((len(places), 1))], axis=1) @ matrix.T
    w = seen[:, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = seen[:, :2] / w
    hidden = (w[:, 0] <= 0.0) | (np.abs(flat) > 1.0).any(axis=1)
    flat[hidden] = np.nan
    # An orthographic view has the same w everywhere; its z is the distance.
    return (0.5 * flat + 0.5) * [width, height], w[:, 0] + seen[:, 2]


def select_uncovered(boxes: NDArray[np.float64]) -> list[int]:
    """Select which of boxes (N, 4) of x, y, width, height cover none of the earlier ones that stay, in order."""
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    covers, kept = np.zeros(len(boxes), bool), []
    for index in range(len(boxes)):
        if not covers[index]:
            kept.append(index)
            apart = (low >= high[index]) | (high <= low[index])
            covers |= ~(apart[:, 0] | apart[:, 1])
    return kept


def list_labelled(context: bpy.types.Context, kind: str) -> list[bpy.types.Object]:
    """List the labelled fruit: those that count and that this viewport shows; only the active one for 'NONE'."""
    shown = [item for item in list_counted_fruit(context.scene) if item.visible_get(viewport=context.space_data)]
    if kind != "NONE":
        return shown
    return [item for item in shown if item == context.view_layer.objects.active]


def find_label_places(
    context: bpy.types.Context, items: Sequence[bpy.types.Object], texts: Sequence[str]
) -> list[tuple[int, NDArray[np.float64]]]:
    """Find index and position (2,) in the region, left and middle, of the labels.

    The active fruit comes first, then the nearest; a label that would cover an earlier one is left out.
    """
    region, view, active = context.region, context.region_data, context.view_layer.objects.active
    matrix = np.array(view.perspective_matrix, np.float64)
    places = np.array([item.matrix_world.translation for item in items], np.float64)
    radii = np.array([0.5 * max(item.dimensions) for item in items])
    right = np.array(view.view_matrix.inverted().col[0][:3], np.float64)
    pixels, depths = project(places, matrix, region.width, region.height)
    edges, _ = project(places + radii[:, None] * right, matrix, region.width, region.height)
    pixels[:, 0] = GAP + np.where(np.isnan(edges[:, 0]), pixels[:, 0], edges[:, 0])
    order = np.lexsort((depths, np.array([item != active for item in items])))
    order = order[np.isfinite(pixels[order, 1])]
    sizes = np.array([blf.dimensions(FONT, texts[index]) for index in order]).reshape(-1, 2)
    kept = select_uncovered(np.concatenate([pixels[order], sizes], axis=1))
    return [(int(index), pixels[index]) for index in order[kept]]


def _draw() -> None:
    """Called when a viewport is drawn."""
    context = bpy.context
    if context.scene is None or context.space_data is None or context.region_data is None:
        return
    kind = context.scene.fruitlangs.review.labels
    if kind == "NONE" and context.region_data.view_perspective != "CAMERA":
        return
    items = list_labelled(context, kind) if context.space_data.overlay.show_overlays else []
    if items:
        _write(context, items, "NUMBER" if kind == "NONE" else kind)


def _write(context: bpy.types.Context, items: Sequence[bpy.types.Object], kind: str) -> None:
    active, metric = context.view_layer.objects.active, metres_per_unit(context.scene) is not None
    texts = [label_text(item, kind, metric) for item in items]
    blf.size(FONT, POINTS * context.preferences.system.ui_scale)
    middle = 0.5 * blf.dimensions(FONT, "0")[1]
    blf.enable(FONT, blf.SHADOW)
    blf.shadow(FONT, BLUR, *SHADOW)
    blf.shadow_offset(FONT, 1, -1)
    for index, (x, y) in find_label_places(context, items, texts):
        blf.color(FONT, *(ACTIVE_COLOR if items[index] == active else COLOR))
        blf.position(FONT, float(x), float(y) - middle, 0.0)
        blf.draw(FONT, texts[index])
    blf.disable(FONT, blf.SHADOW)


drawing = Drawing(_draw, "POST_PIXEL")
