"""The legend of the highlight in a viewport: the colours of probabilities, and the prompt."""

from __future__ import annotations

from dataclasses import dataclass

import blf
import bpy

from ..blender_data import find_owned_object
from ..data.write_gaussians import ASKED
from ..viewport.appearance import appearance_of
from ..viewport.gaussian_nodes import PROBABILITY_RAMP, RAMP_START
from ..viewport.viewport import Drawing
from .splat_drawing import has_preview

FONT, POINTS = 0, 11.0
WIDTH, HEIGHT, MARGIN, PAD = 200.0, 10.0, 24.0, 6.0
"""Width and height of the bar, its distance from the lower edge and that of the text from the bar, in pixels at an
interface scale of 1."""
INK, PAPER = (1.0, 1.0, 1.0, 1.0), (0.05, 0.05, 0.05, 0.6)


@dataclass(frozen=True)
class Legend:
    """The content of a legend. words: the prompt; threshold: probability at the left end of the bar, its right end is
    1."""

    words: str
    threshold: float

    @property
    def title(self) -> str:
        return f"probability of {self.words}"


def legend_of(bpy_scene: bpy.types.Scene) -> Legend | None:
    """The legend of this Blender scene's viewports; None if no Gaussian is highlighted."""
    item, look = find_owned_object(bpy_scene, "gaussians"), appearance_of(bpy_scene)
    if item is None or not look.highlight or look.style == "NONE" or has_preview(bpy_scene):
        return None
    words = str(item.data.get(ASKED, "")).partition(" | ")[0]
    return Legend(words, look.threshold) if words else None


def bar_colors() -> list[tuple[float, tuple[float, float, float, float]]]:
    """(position 0 to 1 on the bar, sRGB and coverage) of the stops of the ramp above the threshold."""
    return [
        ((place - RAMP_START) / (1.0 - RAMP_START), (*color, cover))
        for place, color, cover in PROBABILITY_RAMP
        if place >= RAMP_START
    ]


def _draw() -> None:
    context = bpy.context
    if context.scene is None or context.space_data is None or not context.space_data.overlay.show_overlays:
        return
    legend = legend_of(context.scene)
    if legend is not None:
        _write(context, legend)


def _write(context: bpy.types.Context, legend: Legend) -> None:
    """Draw title, bar and numbers at the lower edge, centred between toolbar and sidebar."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    scale = context.preferences.system.ui_scale
    width, height, pad = WIDTH * scale, HEIGHT * scale, PAD * scale
    left, right = _find_free_span(context)
    if right - left < width + 2 * pad:
        return
    blf.size(FONT, POINTS * scale)
    line = blf.dimensions(FONT, "0")[1]
    x, y = 0.5 * (left + right - width), MARGIN * scale + line + pad

    def rectangle(low: tuple[float, float], high: tuple[float, float], color: tuple[float, ...]) -> None:
        shader = gpu.shader.from_builtin("UNIFORM_COLOR")
        corners = [low, (high[0], low[1]), (low[0], high[1]), high]
        shader.uniform_float("color", color)
        batch_for_shader(shader, "TRI_STRIP", {"pos": [(*corner, 0.0) for corner in corners]}).draw(shader)

    gpu.state.blend_set("ALPHA")
    rectangle((x - pad, y - line - 2 * pad), (x + width + pad, y + height + line + 2 * pad), PAPER)
    shader = gpu.shader.from_builtin("SMOOTH_COLOR")
    places, colors = [], []
    for place, color in bar_colors():
        places += [(x + place * width, y, 0.0), (x + place * width, y + height, 0.0)]
        colors += [color, color]
    batch_for_shader(shader, "TRI_STRIP", {"pos": places, "color": colors}).draw(shader)
    gpu.state.blend_set("NONE")

    above, below = y + height + pad, y - line - pad
    blf.color(FONT, *INK)
    for text, place, foot in (
        (_truncate(legend.title, width), 0.5, above),
        (f"{legend.threshold:.2f}", 0.0, below),
        ("1", 1.0, below),
    ):
        blf.position(FONT, x + place * (width - blf.dimensions(FONT, text)[0]), foot, 0.0)
        blf.draw(FONT, text)


def _find_free_span(context: bpy.types.Context) -> tuple[float, float]:
    """Find the left and right end of the width between toolbar and sidebar, pixels of the region."""
    left, right = 0.0, float(context.region.width)
    for region in context.area.regions:
        if region.type == "TOOLS" and region.width > 1:
            left = max(left, region.x + region.width - context.region.x)
        if region.type == "UI" and region.width > 1:
            right = min(right, region.x - context.region.x)
    return left, right


def _truncate(text: str, width: float) -> str:
    """Truncate the text to that width."""
    if blf.dimensions(FONT, text)[0] <= width:
        return text
    while text and blf.dimensions(FONT, text + "…")[0] > width:
        text = text[:-1]
    return text + "…"


drawing = Drawing(_draw, "POST_PIXEL")
