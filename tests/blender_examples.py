"""Objects in the Blender scene at hand, for tests."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import bpy


def written(counted, probability=True):
    """The Gaussians of `counted`, as a count writes them."""
    from fruitlangs.operators.data.write_gaussians import write_gaussians
    from fruitlangs.operators.data.write_root import write_root

    scene, gaussians, values, fruit_count = counted.parts()
    root = write_root(bpy.context.scene, scene)
    return write_gaussians(
        bpy.context.scene, scene, gaussians, values if probability else None, fruit_count.fruits, root
    )


def imported(counted):
    """The sparse points of a scene, as an import writes them."""
    from fruitlangs.operators.data.write_points import write_points
    from fruitlangs.operators.data.write_root import write_root

    scene = counted.parts()[0]
    return write_points(bpy.context.scene, scene, write_root(bpy.context.scene, scene))


class Layout:
    """In place of Blender's layouts, which exist in a window only: notes the texts, settings and buttons that a panel
    draws."""

    def __init__(self):
        self.texts, self.settings, self.buttons = [], [], []

    def label(self, text="", icon="NONE"):
        self.texts.append(text)

    def prop(self, group, name, **options):
        self.settings.append(name)

    def prop_enum(self, group, name, value):
        self.buttons.append((name, value))

    def operator(self, name, **options):
        self.buttons.append(name.partition(".")[2])
        return SimpleNamespace()

    def progress(self, factor, text):
        self.texts.append(text)

    def template_list(self, name, *given, **options):
        self.settings.append(name)

    def _part(self, **options):
        return self

    row = column = box = split = grid_flow = _part

    @property
    def text(self):
        return " ".join(self.texts)


def drawn(panel) -> Any:
    """What a panel draws of the Blender scene at hand, in a wide sidebar."""
    from fruitlangs.fruitlangs_addon.panels.panel_parts import StepPanel

    layout = Layout()
    context = SimpleNamespace(
        scene=bpy.context.scene,
        region=SimpleNamespace(width=4000),
        preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0)),
        view_layer=bpy.context.view_layer,
        mode="OBJECT",
    )
    made = SimpleNamespace(layout=layout, step=getattr(panel, "step", None))
    made.make_body = lambda given: StepPanel.make_body(made, given)
    panel.draw(made, context)
    return layout
