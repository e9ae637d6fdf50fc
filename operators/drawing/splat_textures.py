"""Splats on the graphics card: their data in textures, and their rendered picture. Never used in background mode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import gpu
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..viewport.splats import Splats
from .splat_order import find_near_distance, has_turned, select_shown, sort_back_to_front
from .splat_shader import over_shader, pack_values, splat_shader

ROW = 4096
"""Width of data textures, filled row by row; every card supports 16,384 rows of it, enough for 67 million splats."""
_FORMATS = {"places": "RGBA32F", "upper_shapes": "RGBA32F", "lower_shapes": "RG32F", "colors": "RGBA16F"}


@dataclass(frozen=True, eq=False)
class View:
    """The viewpoint: view_matrix from the world, projection as Blender's window matrix, size in px."""

    view_matrix: Matrix
    projection: Matrix
    size: tuple[int, int]

    @property
    def is_perspective(self) -> bool:
        return self.projection[3][3] == 0.0


@dataclass(frozen=True)
class Highlight:
    """The display of the prompt's probability; `on` only if a prompt was answered."""

    on: bool
    threshold: float
    dimming: float


@dataclass(eq=False)
class Order:
    """The order of the splats of a view, as a texture of indices."""

    texture: gpu.types.GPUTexture
    count: int
    towards: tuple[float, ...]
    shown: NDArray[np.int64]


@dataclass(eq=False)
class SplatTextures:
    """One object's splats on the card; `orders`: one per view."""

    splats: Splats
    centre: tuple[float, ...]
    reach: float
    orders: dict[Any, Order] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._select()
        self._upload_shapes()
        self._upload_probability()

    def replace(self, splats: Splats, centre: tuple[float, ...], reach: float) -> None:
        """Replace the values, uploading only those that differ."""
        old, self.splats = self.splats, splats
        placed = _is_same(old.means, splats.means) and _is_same(old.opacities, splats.opacities)
        if not (placed and _is_same(old.covariances, splats.covariances) and _is_same(old.colors, splats.colors)):
            self._upload_shapes()
        if len(old) != len(splats) or not _is_same(old.probability, splats.probability):
            self._upload_probability()
        if not placed or (centre, reach) != (self.centre, self.reach):
            self.centre, self.reach = centre, reach
            self._select()

    def order(self, view: Any, towards: tuple[float, ...]) -> Order:
        """The order for a view from which `towards` (object frame) points to the viewer, sorted again if it was
        rotated."""
        kept = self.orders.get(view)
        if kept is None or kept.shown is not self._shown or has_turned(kept.towards, towards):
            sorted_places = sort_back_to_front(self._shown_means, towards)
            kept = Order(make_order_texture(self._shown[sorted_places]), len(self._shown), towards, self._shown)
            self.orders[view] = kept
        return kept

    def _select(self) -> None:
        self._shown = select_shown(self.splats.means, self.splats.opacities, self.centre, self.reach)
        self._shown_means = np.ascontiguousarray(self.splats.means[self._shown])

    def _upload_shapes(self) -> None:
        splats = self.splats
        rows = {
            "places": np.concatenate([splats.means, splats.opacities[:, None]], axis=1),
            "upper_shapes": splats.covariances[:, :4],
            "lower_shapes": splats.covariances[:, 4:],
            "colors": np.concatenate([splats.colors, np.ones((len(splats), 1), np.float32)], axis=1),
        }
        self.shapes = {name: _make_texture(values, _FORMATS[name]) for name, values in rows.items()}

    def _upload_probability(self) -> None:
        given = self.splats.probability
        self.likely = _make_texture(np.zeros(1, np.float32) if given is None else given, "R32F")


class Picture:
    """The target of a viewport's splats: sRGB times alpha and alpha, half floats, of the viewport's size."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.texture = gpu.types.GPUTexture(size, format="RGBA16F")
        self._framebuffer = gpu.types.GPUFrameBuffer(color_slots=self.texture)

    def draw(
        self,
        layers: Sequence[tuple[SplatTextures, Matrix]],
        view: View,
        highlight: Highlight,
        depths: gpu.types.GPUTexture,
        name: Any = None,
    ) -> None:
        """Draw splats with their objects' matrices, object by object. depths: (H, W) of what hides them; name: of the
        view, whose order of splats is cached."""
        with self._framebuffer.bind():
            self._framebuffer.clear(color=(0.0, 0.0, 0.0, 0.0))
            gpu.state.depth_test_set("NONE")
            gpu.state.depth_mask_set(False)
            gpu.state.blend_set("ALPHA_PREMULT")
            for textures, matrix in layers:
                _draw_layer(textures, matrix, view, highlight, depths, name)
            gpu.state.blend_set("NONE")

    def show(self, strength: float = 1.0) -> None:
        """Draw the picture with this opacity over the bound framebuffer, a viewport's overlay."""
        shader = _over_shader()
        gpu.state.depth_test_set("NONE")
        gpu.state.blend_set("ALPHA_PREMULT")
        shader.bind()
        shader.uniform_float("strength", strength)
        shader.uniform_sampler("picture", self.texture)
        _make_square().draw(shader)
        gpu.state.blend_set("NONE")

    def pixels(self) -> NDArray[np.float32]:
        """(H, W, 4) from the top; for tests and measurements."""
        values = np.array(self.texture.read().to_list(), np.float32)
        return values.reshape(self.size[1], self.size[0], 4)[::-1]


def make_empty_depths(size: tuple[int, int]) -> gpu.types.GPUTexture:
    """Make depths that hide nothing."""
    return gpu.types.GPUTexture(size, format="R32F", data=_make_buffer(np.ones(size[0] * size[1], np.float32)))


def read_depths(size: tuple[int, int]) -> gpu.types.GPUTexture:
    """The depths drawn so far, 0 to 1, in the active framebuffer."""
    found = gpu.state.active_framebuffer_get().read_depth(0, 0, *size)
    found.dimensions = [size[0] * size[1]]
    return gpu.types.GPUTexture(size, format="R32F", data=found)


def _draw_layer(
    textures: SplatTextures,
    matrix: Matrix,
    view: View,
    highlight: Highlight,
    depths: gpu.types.GPUTexture,
    name: Any,
) -> None:
    model_view = view.view_matrix @ matrix
    order = textures.order(name, tuple(model_view[2][:3]))
    if order.count == 0:
        return
    nearest = -1e30
    if view.is_perspective:
        scale = abs(matrix.determinant()) ** (1 / 3)
        nearest = scale * find_near_distance(textures.splats.means, model_view.inverted_safe().translation)
    shader = _splat_shader()
    shader.bind()
    values = pack_values(
        model_view,
        view.projection,
        view.size,
        nearest=nearest,
        threshold=highlight.threshold,
        dimming=highlight.dimming,
        highlight=highlight.on and textures.splats.probability is not None,
        antialiased=textures.splats.antialiased,
        row=ROW,
    )
    block = gpu.types.GPUUniformBuf(_make_buffer(values))  # bound only while it exists
    shader.uniform_block("values", block)
    shader.uniform_sampler("order", order.texture)
    for sampler, texture in textures.shapes.items():
        shader.uniform_sampler(sampler, texture)
    shader.uniform_sampler("likely", textures.likely)
    shader.uniform_sampler("depths", depths)
    _make_square().draw_instanced(shader, instance_count=order.count)


@lru_cache(maxsize=1)
def _splat_shader() -> gpu.types.GPUShader:
    return splat_shader()


@lru_cache(maxsize=1)
def _over_shader() -> gpu.types.GPUShader:
    return over_shader()


@lru_cache(maxsize=1)
def _make_square() -> gpu.types.GPUBatch:
    layout = gpu.types.GPUVertFormat()
    layout.attr_add(id="corner", comp_type="F32", len=2, fetch_mode="FLOAT")
    corners = gpu.types.GPUVertBuf(layout, 4)
    corners.attr_fill("corner", [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)])
    return gpu.types.GPUBatch(type="TRI_STRIP", buf=corners)


def make_order_texture(indices: NDArray[np.int64]) -> gpu.types.GPUTexture:
    """Make a texture of the indices of splats in drawing order; floats represent them exactly up to 16 million."""
    return _make_texture(indices, "R32F")


def _make_texture(values: NDArray[Any], layout: str) -> gpu.types.GPUTexture:
    """Make a texture of values (N,) or (N, width), `ROW` per row."""
    width = 1 if values.ndim == 1 else values.shape[1]
    height = max(-(-len(values) // ROW), 1)
    padded = np.zeros((height * ROW, width), np.float32)
    padded[: len(values)] = values.reshape(len(values), width)
    return gpu.types.GPUTexture((ROW, height), format=layout, data=_make_buffer(padded.ravel()))


def _make_buffer(flat: NDArray[np.float32]) -> gpu.types.Buffer:
    return gpu.types.Buffer("FLOAT", flat.size, flat)


def _is_same(a: NDArray[Any] | None, b: NDArray[Any] | None) -> bool:
    return (a is None and b is None) or (a is not None and b is not None and np.array_equal(a, b))


def free() -> None:
    """Forget the shaders; called when the extension is disabled."""
    for kept in (_splat_shader, _over_shader, _make_square):
        kept.cache_clear()
