"""Picture strips: photo, probability, language colours and fruit ids of one view, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from ..counting.fruit import Fruit, FruitCount
from ..language.features.features import Features
from ..scene.camera import Camera, Scene
from ..splatting.gaussians import Gaussians
from ..splatting.rendering.rasterize import render
from .ellipses import outline_points, project_ellipsoid
from .meshes import id_color
from .words import format_three_digits, length_unit

_CIVIDIS = np.array(
    [[0, 34, 78], [18, 53, 112], [59, 73, 108], [87, 93, 109], [112, 113, 115]]
    + [[138, 134, 120], [165, 156, 116], [195, 179, 105], [225, 204, 85], [254, 232, 56]]
)
"""Ten colours of the cividis ramp, which looks the same with and without colour blindness."""

_TITLE_HEIGHT = 22


def language_colors(features: Features) -> Tensor:
    """(N, 3) in [0, 1]: the three principal directions of the features, scaled between their 2 % and 98 % quantiles.

    Of several levels the middle one is shown. A Gaussian that no photo shows is grey.
    """
    level = features.levels // 2
    vectors = features.vectors[:, level].numpy()
    seen = features.weights[:, level].numpy() > 0
    colors = np.full((len(vectors), 3), 0.5)
    if seen.sum() < 4:
        return torch.from_numpy(colors.astype(np.float32))
    centered = vectors[seen].astype(np.float64)
    centered -= centered.mean(axis=0)
    _, directions = np.linalg.eigh(centered.T @ centered)
    directions = directions[:, ::-1][:, :3]
    # The sign of an eigenvector is arbitrary: fix it, so that equal runs give equal pictures.
    directions = directions * np.sign(directions[np.abs(directions).argmax(axis=0), np.arange(directions.shape[1])])
    projected = centered @ directions
    low, high = np.quantile(projected, [0.02, 0.98], axis=0)
    colors[seen, : projected.shape[1]] = np.clip((projected - low) / np.maximum(high - low, 1e-9), 0.0, 1.0)
    return torch.from_numpy(colors.astype(np.float32))


def view_strip(
    scene: Scene, view: int, gaussians: Gaussians, colors: Tensor, probability: Tensor, fruit_count: FruitCount
) -> Image.Image:
    """One view as four panels. colors: (N, 3) of `language_colors`; probability: (N,)."""
    camera = scene.cameras[view]
    drawn = render(gaussians, camera, features=torch.cat([probability[:, None], colors], dim=1))
    assert drawn.features is not None
    channels = drawn.features.detach().numpy()
    alpha = drawn.alpha.detach().numpy()[..., None]
    panels = {
        f"photo {scene.images[view].name}": scene.images[view].pixels(),
        "probability of the prompt": ramp(channels[..., 0]),
        "language": _bytes(channels[..., 1:] + (1.0 - alpha)),
        _fruit_title(fruit_count, scene.metres_per_unit): _draw_ids(
            _bytes(drawn.color.detach().numpy()), drawn.depth.detach().numpy(), camera, fruit_count.fruits
        ),
    }
    return join_side_by_side(panels)


def _fruit_title(fruit_count: FruitCount, metres_per_unit: float | None) -> str:
    if fruit_count.mean_diameter is None or metres_per_unit is None:
        return "fruit"
    unit, scale = length_unit(metres_per_unit)
    return f"fruit, mean diameter {format_three_digits(fruit_count.mean_diameter * scale)} {unit}"


def strip_views(scene: Scene, number: int = 4) -> list[int]:
    """Indices of `number` views spread evenly over the scene's photos."""
    count = len(scene.images)
    return sorted({round(index * count / number) for index in range(min(number, count))})


def write_strips(
    folder: Path,
    scene: Scene,
    gaussians: Gaussians,
    features: Features,
    probability: Tensor,
    fruit_count: FruitCount,
) -> list[Path]:
    """Write `view_<photo>.png` for four views; returns the paths."""
    colors = language_colors(features)
    paths = []
    for view in strip_views(scene):
        stem = Path(scene.images[view].name).with_suffix("").as_posix().replace("/", "_")
        path = folder / f"view_{stem}.png"
        view_strip(scene, view, gaussians, colors, probability, fruit_count).save(path)
        paths.append(path)
    return paths


def _bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.round(np.clip(values, 0.0, 1.0) * 255).astype(np.uint8)


def ramp(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Map [0, 1] to cividis."""
    position = np.clip(values, 0.0, 1.0) * (len(_CIVIDIS) - 1)
    channels = [np.interp(position, np.arange(len(_CIVIDIS)), _CIVIDIS[:, channel]) for channel in range(3)]
    return np.round(np.stack(channels, axis=-1)).astype(np.uint8)


def _draw_ids(
    picture: NDArray[np.uint8], depth: NDArray[np.float32], camera: Camera, fruits: Sequence[Fruit]
) -> NDArray[np.uint8]:
    """Outline and number every fruit that is visible in this view, on a darkened picture."""
    image = Image.fromarray((picture * 0.55).astype(np.uint8))
    canvas = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=10)
    for fruit in fruits:
        (u, v), z = camera.project(fruit.center)
        shape = project_ellipsoid(fruit.center, fruit.axes, camera)
        if z <= fruit.diameter or shape is None or depth[int(v), int(u)] < z - 1.5 * fruit.diameter:
            continue
        corners = outline_points(*shape, 32)
        canvas.line([*map(tuple, corners), tuple(corners[0])], fill=id_color(fruit.id), width=2, joint="curve")
        canvas.text((u, v), str(fruit.id), fill=(255, 255, 255), font=font, anchor="mm")
    return np.asarray(image)


def join_side_by_side(panels: Mapping[str, NDArray[np.uint8]]) -> Image.Image:
    """Join pictures (H, W, 3) of one size next to each other, by their titles."""
    height, width = next(iter(panels.values())).shape[:2]
    gap = 4
    strip = Image.new("RGB", (len(panels) * (width + gap) - gap, height + _TITLE_HEIGHT), (255, 255, 255))
    canvas = ImageDraw.Draw(strip)
    font = ImageFont.load_default(size=13)
    for index, (title, pixels) in enumerate(panels.items()):
        left = index * (width + gap)
        canvas.text((left + 4, 3), title, fill=(20, 20, 20), font=font)
        strip.paste(Image.fromarray(pixels), (left, _TITLE_HEIGHT))
    return strip
