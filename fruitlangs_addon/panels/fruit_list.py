"""The list of fruit: one row per object of the Fruits collection, sorted and filtered by the settings of the review."""

from __future__ import annotations

from typing import Any

import bpy

from ...engine.counting.fruit import KIND_TEXTS
from ...operators.blender_data import OWNER
from ...operators.data.fruit_objects import REJECTED, REVIEW, diameter_head, diameter_number, metres_per_unit
from .panel_parts import sidebar_width

VERDICT_ICONS = {"confirmed": "CHECKMARK", "rejected": "X", "added": "ADD"}
KIND_ICONS = {"single": "MESH_UVSPHERE", "small": "DOT", "compound-part": "META_BALL"}
WIDTHS = (0.3, 0.37, 0.47)
"""Widths of name, diameter and probability, each as a share of the remaining width; the visible share gets the rest."""
WIDE, WIDE_WIDTHS = 340, (0.26, 0.32, 0.36, 0.42)  # of these the kind gets the rest
"""Width of the sidebar in pixels above which the name of the kind fits, at an interface scale of 1."""


class FRUITLANGS_UL_fruits(bpy.types.UIList):
    bl_idname = "FRUITLANGS_UL_fruits"

    def draw_item(
        self,
        context: bpy.types.Context,
        layout: Any,
        data: Any,
        item: Any,
        icon: int,
        active_data: Any,
        active_property: str,
        index: int = 0,
        flt_flag: int = 0,
    ) -> None:
        row = layout.row(align=True)
        row.active = item.get(REVIEW) != REJECTED
        texts = cells(item, metres_per_unit(context.scene) is not None)
        _draw_row(row, context, sign_of(item, _has_room(context)), texts)

    def filter_items(self, context: bpy.types.Context, data: Any, property: str) -> tuple[list[int], list[int]]:
        review, items = context.scene.fruitlangs.review, list(getattr(data, property))
        shown = [is_shown(item, review.show, review.doubt, self.filter_name) for item in items]
        flags = [self.bitflag_filter_item if visible else 0 for visible in shown]
        return flags, rank_items(items, review.sort)


def draw_head(layout: Any, context: bpy.types.Context) -> None:
    """The headings of the columns, with units."""
    _draw_row(layout.row(align=True), context, "BLANK1", head(metres_per_unit(context.scene) is not None))


def _draw_row(row: Any, context: bpy.types.Context, sign: str, texts: list[str]) -> None:
    """One text per column; without the last one, the kind, if there is no room for it."""
    wide = _has_room(context)
    row.label(text="", icon=sign)
    for text, share in zip(texts, (*WIDE_WIDTHS, None) if wide else (*WIDTHS, None, None), strict=True):
        if share is None:
            row.label(text=text)
            return
        row = row.split(factor=share, align=True)
        row.label(text=text)


def _has_room(context: bpy.types.Context) -> bool:
    """Whether the sidebar is wide enough for the name of the kind."""
    return sidebar_width(context) >= WIDE


def sign_of(item: Any, wide: bool) -> str:
    """The icon of a fruit object: the user's decision, else its kind unless there is room for its text (wide)."""
    verdict = item.get(REVIEW)
    if verdict is not None:
        return VERDICT_ICONS.get(verdict, "BLANK1")
    return "BLANK1" if wide else KIND_ICONS.get(item.get("kind"), "BLANK1")


def head(metric: bool) -> list[str]:
    """The headings of `cells`. metric: lengths are metres."""
    return ["Fruit", diameter_head(metric), "Prob.", "Visible", "Kind"]


def cells(item: Any, metric: bool) -> list[str]:
    """Id and label, diameter (its unit is in the `head`), probability, visible share and kind of a fruit object.
    metric: lengths are metres."""
    visible = item.get("visible_fraction")
    return [
        f"{item.get('id', 0)} {item.get('label', '')}",
        diameter_number(item, metric),
        f"{float(item.get('probability', 1.0)):.2f}",
        "" if visible is None else f"{float(visible):.0%}",
        KIND_TEXTS.get(str(item.get("kind", "")), ""),
    ]


def is_shown(item: Any, show: str, doubt: float, name: str) -> bool:
    """Whether the list shows an object: a fruit that passes the filters of the review."""
    if item.get(OWNER) != "fruit":
        return False
    verdict = item.get(REVIEW)
    if name and name.casefold() not in item.name.casefold():
        return False
    if show == "OPEN":
        return verdict is None
    if show == "DOUBTFUL":
        return verdict is None and item.get("probability", 1.0) < doubt
    return verdict == REJECTED if show == "REJECTED" else True


def rank_items(items: list[Any], key: str) -> list[int]:
    """Return the position of each item when sorted by a custom property, then by id."""
    default: Any = "" if key in {"kind", "label"} else 1.0
    order = sorted(range(len(items)), key=lambda index: (items[index].get(key, default), items[index].get("id", 0)))
    places = [0] * len(items)
    for place, index in enumerate(order):
        places[index] = place
    return places


CLASSES = (FRUITLANGS_UL_fruits,)
