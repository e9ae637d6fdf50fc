"""Training of the encoder's second output: where on its fruit each pixel lies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from ...benchmarks.orchards import TRUTH, read_origin
from ...engine.config import SceneConfig
from ...engine.evaluation.renders import read_instances
from ...engine.evaluation.truth import Truth, read_truth, true_labels
from ...engine.language.encoders.network import Network, normalise
from ...engine.language.encoders.offsets import OffsetNetwork
from ...engine.scene.camera import Camera
from ...engine.scene.read import read_scene
from .batches import USUAL, change_light, choose_window_around
from .learning import make_ahead, rate_share
from .lifted import find_finished_scenes
from .pictures import POSITIVE_SHARE, Picture, find_inside

FloatArray = NDArray[np.float32]

CROP, BATCH = 192, 12
"""Side of a crop in pixels, and crops of a step."""
USUAL_ZOOMS, ALL_ZOOMS, PHOTO_ZOOMS = (1.3, 2.8), (0.8, 4.0), (0.5, 2.0)
"""Range of enlargement of crops of renders, usual and all, and of photos."""
FOCUS = 0.8
"""Share of crops that contain a pixel of fruit for certain."""
PHOTOS = 0.2
"""Share of crops from photos."""
SQUARE = 1.25
"""Most that a side of a box may be longer than the other: longer boxes are of fruit that is cut off or covered."""
RATE, DECAY = 2e-3, 1e-3
"""Highest learning rate from scratch, and weight decay."""
REPORT_EVERY = 100


@dataclass(frozen=True, eq=False)
class OffsetPicture:
    """pixels: (H, W, 3) sRGB; fruit: (H, W) whether the offset of the pixel is known; centers: (H, W, 2) the centre of
    its fruit, right and down in pixels; radii: (H, W, 2) of its fruit, across and down, in pixels."""

    pixels: NDArray[np.uint8]
    fruit: NDArray[np.bool_]
    centers: FloatArray
    radii: FloatArray


def read_offset_renders(renders: Path) -> Iterator[OffsetPicture]:
    """Yield every view of the rendered scenes below a folder.

    Raises:
        FormatError: a mask or a truth cannot be read.
    """
    for folder in find_finished_scenes(renders):
        scene = read_scene(folder, SceneConfig())
        truth = read_truth(folder / TRUTH, true_labels([read_origin(folder).species]))
        for photo, camera, ids in zip(scene.images, scene.cameras, read_instances(folder, scene), strict=True):
            yield _make_offset_picture(photo.pixels(), camera, ids, truth)


def _make_offset_picture(
    pixels: NDArray[np.uint8], camera: Camera, ids: NDArray[np.uint16], truth: Truth
) -> OffsetPicture:
    assert truth.ids is not None
    centers, depths = camera.project(truth.centers)
    radii = truth.diameters[:, None] / 2.0 / depths[:, None] * np.diag(camera.K)[:2]
    rows = np.full(int(max(ids.max(), truth.ids.max())) + 1, -1)
    rows[truth.ids] = np.arange(len(truth.ids))
    rows[0] = -1
    row = rows[ids]
    return OffsetPicture(pixels, row >= 0, centers[row].astype(np.float32), radii[row].astype(np.float32))


def select_offset_photos(photos: Sequence[Picture]) -> list[OffsetPicture]:
    """Select the photos with boxes: the middle of each box that is about square, as if its fruit were whole."""
    pictures = []
    for photo in photos:
        shape = photo.labels.shape
        fruit, centers, radii = np.zeros(shape, bool), np.zeros((*shape, 2)), np.ones((*shape, 2))
        for box in photo.boxes:
            width, height = box.right - box.left, box.bottom - box.top
            if min(width, height) <= 0.0 or max(width, height) > SQUARE * min(width, height):
                continue
            own = find_inside(box, POSITIVE_SHARE, shape)
            fruit |= own
            centers[own] = (box.left + box.right) / 2.0, (box.top + box.bottom) / 2.0
            radii[own] = width / 2.0, height / 2.0
        if fruit.any():
            pictures.append(OffsetPicture(photo.pixels, fruit, centers.astype(np.float32), radii.astype(np.float32)))
    return pictures


def learn_offsets(
    encoder: Network,
    renders: Sequence[OffsetPicture],
    photos: Sequence[OffsetPicture],
    *,
    steps: int,
    seed: int,
    start: OffsetNetwork | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> OffsetNetwork:
    """Train a network, from scratch or on from `start` with half of the rate, on features of the encoder's, which stays
    as it is. Returned unfused."""
    torch.manual_seed(seed)
    network, highest = (OffsetNetwork(), RATE) if start is None else (start, RATE / 2.0)
    torch.nn.Module.to(network, memory_format=torch.channels_last)  # type: ignore[call-overload]
    network.train()
    optimiser = torch.optim.AdamW(network.parameters(), lr=highest, weight_decay=DECAY)
    rng, losses = np.random.default_rng([seed, 1]), []
    drawn = np.random.default_rng([seed, 0])
    for step, (images, fruit, wanted) in zip(
        range(steps), make_ahead(lambda: _make_batch(renders, photos, drawn)), strict=False
    ):
        optimiser.param_groups[0]["lr"] = highest * rate_share(step / steps)
        with torch.autocast("cpu", torch.bfloat16):
            with torch.no_grad():
                levels = encoder.levels(normalise(images).contiguous(memory_format=torch.channels_last))
            said = network(levels).float()
        down, right = rng.integers(0, 2, size=2)  # one output for 2×2 pixels is compared with each of them in turn
        shown, there = fruit[:, down::2, right::2], wanted[:, :, down::2, right::2]
        off, error = (said[:, :2] - there).abs().sum(1)[shown], said[:, 2][shown]
        loss = (off * torch.exp(-error) + 2.0 * error).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        losses.append((float(loss.detach()), float(off.detach().mean())))
        if (step + 1) % REPORT_EVERY == 0:
            mean = np.mean(losses[-REPORT_EVERY:], axis=0)
            report(f"step {step + 1} of {steps}: loss {mean[0]:.3f}, off by {mean[1]:.3f} radii (right + down)")
    return network.eval()


def _make_batch(
    renders: Sequence[OffsetPicture], photos: Sequence[OffsetPicture], rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Make images (B, 3, CROP, CROP), where fruit is known (B, CROP, CROP) and offsets (B, 2, CROP, CROP)."""
    crops = []
    for _ in range(BATCH):
        real = len(photos) > 0 and rng.random() < PHOTOS
        zooms = PHOTO_ZOOMS if real else USUAL_ZOOMS if rng.random() < USUAL else ALL_ZOOMS
        pictures = photos if real else renders
        crops.append(_crop(pictures[rng.integers(len(pictures))], zooms, rng))
    images, fruit, wanted = (torch.stack(each) for each in zip(*crops, strict=True))
    return images, fruit, wanted


def _crop(
    picture: OffsetPicture, zooms: tuple[float, float], rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """A square window of the picture at CROP × CROP, in changed light and sometimes mirrored."""
    height, width = picture.fruit.shape
    side = min(height, width, round(CROP / float(np.exp(rng.uniform(*np.log(zooms))))))
    top, left = int(rng.integers(0, height - side + 1)), int(rng.integers(0, width - side + 1))
    places = np.flatnonzero(picture.fruit)
    if len(places) and rng.random() < FOCUS:
        top, left = choose_window_around(places, picture.fruit.shape, (side, side), rng)
    resampling = Image.Resampling.BILINEAR if rng.random() < 0.5 else Image.Resampling.BICUBIC
    window = Image.fromarray(picture.pixels[top : top + side, left : left + side])
    pixels = np.asarray(window.resize((CROP, CROP), resampling))
    along = (np.arange(CROP) + 0.5) * side / CROP
    rows, columns = (top + along).astype(int)[:, None], (left + along).astype(int)
    here = np.stack(np.broadcast_arrays(left + along, (top + along)[:, None]), axis=-1)
    wanted = (here - picture.centers[rows, columns]) / picture.radii[rows, columns]
    fruit = picture.fruit[rows, columns]
    if rng.random() < 0.5:
        pixels, fruit, wanted = pixels[:, ::-1], fruit[:, ::-1], wanted[:, ::-1] * np.array([-1.0, 1.0])
    image = change_light(torch.from_numpy(pixels.copy()).permute(2, 0, 1).float() / 255.0, rng)
    return image, torch.from_numpy(fruit.copy()), torch.from_numpy(wanted.astype(np.float32)).permute(2, 0, 1)
