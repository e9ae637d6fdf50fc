"""Renders the stage from each viewpoint with Cycles on the CPU: picture, fruit ids, classes and depth of one render."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..cameras.shake import apply_shake
from ..cameras.viewpoint import Viewpoint
from ..classes import CLASSES
from ..config import OrchardConfig
from ..shapes.ground import Ground

JPEG_QUALITY = 90
WITHOUT_DENOISER = 6
"""Factor of the samples if Blender cannot denoise."""


@dataclass(frozen=True, kw_only=True)
class Passes:
    """The passes of one view, unfiltered, rows from the top."""

    fruit: NDArray[np.uint16]
    """(H, W) fruit id, 0 for none."""
    classes: NDArray[np.uint8]
    """(H, W) index into CLASSES."""
    depth: NDArray[np.float32]
    """(H, W) metres along the optical axis; 0 for the sky."""


@contextmanager
def silence() -> Iterator[None]:
    """Discard what Blender's C code prints to stdout, including its buffer."""
    libc = ctypes.CDLL("ucrtbase" if os.name == "nt" else None)
    sys.stdout.flush()
    libc.fflush(None)
    kept = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        libc.fflush(None)
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def prepare(config: OrchardConfig, scratch: Path, report: Callable[[str], None]) -> None:
    """Configure Cycles and the compositor node that writes ids and depth, unchanged, into one float picture."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.use_persistent_data = True
    scene.render.resolution_x, scene.render.resolution_y = config.width, config.height
    scene.render.resolution_percentage = 100
    scene.render.image_settings.quality = JPEG_QUALITY
    scene.render.image_settings.color_mode = "RGB"
    scene.render.use_file_extension = False
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples = config.samples
    cycles.use_adaptive_sampling = False
    _denoise(cycles, config, report)
    # A box of one pixel keeps the first sample, which fills the id and depth passes, inside its own pixel.
    cycles.pixel_filter_type = "BOX"
    cycles.max_bounces = config.bounces
    cycles.diffuse_bounces = min(2, config.bounces)
    cycles.glossy_bounces = 1
    cycles.transmission_bounces = config.bounces
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.blur_glossy = 1.0
    cycles.sample_clamp_indirect = 3.0
    cycles.use_light_tree = False
    layer = scene.view_layers[0]
    layer.use_pass_z = layer.use_pass_object_index = layer.use_pass_material_index = True
    _set_compositor(scene, scratch)


def _denoise(cycles: Any, config: OrchardConfig, report: Callable[[str], None]) -> None:
    cycles.use_denoising = config.samples > 2
    try:
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_prefilter = "FAST"
    except TypeError:  # some distributions build Blender without it
        cycles.use_denoising = False
        cycles.samples = WITHOUT_DENOISER * config.samples
        report(f"this Blender has no denoiser: {cycles.samples} samples a pixel instead of {config.samples}")


def _set_compositor(scene: Any, scratch: Path) -> None:
    scene.use_nodes = True
    tree = scene.node_tree
    tree.nodes.clear()
    layers = tree.nodes.new("CompositorNodeRLayers")
    picture = tree.nodes.new("CompositorNodeComposite")
    tree.links.new(layers.outputs["Image"], picture.inputs["Image"])
    merge = tree.nodes.new("CompositorNodeCombineColor")
    for i, name in enumerate(("IndexOB", "IndexMA", "Depth")):
        tree.links.new(layers.outputs[name], merge.inputs[i])
    out = tree.nodes.new("CompositorNodeOutputFile")
    out.base_path = str(scratch)
    out.format.file_format = "OPEN_EXR"
    out.format.color_depth = "32"
    out.format.exr_codec = "ZIP"
    out.file_slots[0].path = "passes_"
    tree.links.new(merge.outputs[0], out.inputs[0])
    scene.render.compositor_precision = "FULL"


def place_camera(view: Viewpoint) -> None:
    """Set Blender's camera to the viewpoint."""
    scene = bpy.context.scene
    if scene.camera is None:
        scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        scene.collection.objects.link(scene.camera)
    lens = scene.camera.data
    lens.sensor_fit = "HORIZONTAL"
    lens.sensor_width = 36.0
    lens.lens = view.focal * 36.0 / view.width
    lens.clip_start, lens.clip_end = view.nearest, 500.0
    matrix = np.eye(4)
    matrix[:3, :3] = view.world_to_camera[:, :3].T * [1, -1, -1]
    matrix[:3, 3] = view.position
    scene.camera.matrix_world = matrix.T.tolist()


def render_view(
    view: Viewpoint,
    picture: Path,
    scratch: Path,
    ground: Ground,
    *,
    seed: int,
    shake: NDArray[np.float64] | None = None,
) -> Passes:
    """Render one view, blurred along `shake` (x, y in pixels); the picture is written atomically."""
    scene = bpy.context.scene
    place_camera(view)
    scene.cycles.seed = seed % 2**31
    half_made = picture.with_name(picture.name + ".part")
    sharp = half_made if shake is None else scratch / "sharp.png"
    scene.render.image_settings.file_format = "JPEG" if shake is None else "PNG"
    scene.render.filepath = str(sharp)
    scene.frame_set(1)
    with silence():
        bpy.ops.render.render(write_still=True)
    passes = _read_passes(next(scratch.glob("passes_*")), view, ground)
    if shake is not None:
        _write_jpeg(half_made, apply_shake(picture_pixels(sharp), shake))
    half_made.write_bytes(remove_comments(half_made.read_bytes()))
    os.replace(half_made, picture)
    return passes


def remove_comments(jpeg: bytes) -> bytes:
    """Return a JPEG file without its comment segments: Blender writes render times there, which make equal pictures
    differ."""
    kept, at = [jpeg[:2]], 2
    while jpeg[at : at + 2] != b"\xff\xda":  # until the start of the scan, every segment starts with its length
        end = at + 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
        if jpeg[at + 1] != 0xFE:
            kept.append(jpeg[at:end])
        at = end
    return b"".join([*kept, jpeg[at:]])


def _read_passes(path: Path, view: Viewpoint, ground: Ground) -> Passes:
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    values = np.empty(view.width * view.height * 4, dtype=np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    path.unlink()
    values = values.reshape(view.height, view.width, 4)[::-1]
    depth = np.where(values[..., 2] < 1e5, values[..., 2], 0.0).astype(np.float32)
    classes = np.rint(values[..., 1]).astype(np.uint8)
    _split_ground(classes, depth, view, ground)
    return Passes(fruit=np.rint(values[..., 0]).astype(np.uint16), classes=classes, depth=depth)


def _split_ground(classes: NDArray[np.uint8], depth: NDArray[np.float32], view: Viewpoint, ground: Ground) -> None:
    """Distinguish grass from soil where the ground is visible, by the formula of the patches."""
    rows, columns = np.nonzero((classes == CLASSES.index("soil")) & (depth > 0))
    pixels = np.stack([columns, rows], axis=1) + 0.5
    points = view.unproject(pixels, depth[rows, columns].astype(np.float64))
    grass = ground.soil_share(points[:, 0], points[:, 1]) < 0.5
    classes[rows[grass], columns[grass]] = CLASSES.index("grass")


def picture_pixels(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) bytes of a picture, rows from the top."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    values = np.empty(width * height * image.channels, dtype=np.float32)
    image.pixels.foreach_get(values)
    rgb = values.reshape(height, width, image.channels)[::-1, :, :3]
    bpy.data.images.remove(image)
    return np.rint(rgb * 255).astype(np.uint8)


def _write_jpeg(path: Path, pixels: NDArray[np.uint8]) -> None:
    height, width, _ = pixels.shape
    image = bpy.data.images.new("shaken", width, height)
    rgba = np.ones((height, width, 4), dtype=np.float32)
    rgba[..., :3] = pixels[::-1] / 255.0
    image.pixels.foreach_set(rgba.ravel())
    image.file_format = "JPEG"
    image.filepath_raw = str(path)
    image.save(quality=JPEG_QUALITY)
    bpy.data.images.remove(image)
