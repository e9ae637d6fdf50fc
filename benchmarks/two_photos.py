"""Counting as it is done without reconstruction: fruit seen in a photo from each side of the tree, times a factor.

The factor comes from trees whose fruit were counted by hand; `evidence.tables` applies it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..engine.errors import EncoderError
from ..engine.language.encoders.open_encoder import open_encoder
from ..engine.language.features.photo_features import load_photo_features
from ..engine.language.prompts.photo_probability import PhotoMap, photo_probabilities
from ..engine.open_result import open_result
from ..engine.reconstruction import PHOTOS
from ..engine.scene.camera import Camera

TWO_PHOTOS = "two-photos"
"""Name of the method."""
SHOWN, INNER, LEAST = 0.5, 0.4, 4
"""Probability of a pixel that shows fruit; radii from the centre of its fruit within which it is at the core; pixels of
a core. In 60 photos of apple 101 they give 51.5 fruit a photo, where 50.2 have 12 pixels or more."""
TOUCHING = np.ones((3, 3))


def count_in_two_photos(result: Path, prompts: Sequence[str]) -> int:
    """The fruit seen in the first photo of a result, and in the one from the other side.

    Raises:
        FruitLangsError: the result cannot be opened, or keeps no masks of photos.
    """
    opened = open_result(result)
    photos, encoder = load_photo_features(result / PHOTOS), open_encoder(opened.config.embed)
    maps = photo_probabilities(photos, opened.features, encoder, prompts)
    if maps is None:
        raise EncoderError("The photos keep no masks of these prompts. Ask for a kind of fruit that the encoder knows")
    return sum(count_fruit_seen(maps[view]) for view in (0, find_opposite(opened.scene.cameras)))


def find_opposite(cameras: Sequence[Camera]) -> int:
    """Find the camera whose direction of view is most unlike that of the first."""
    directions = np.stack([camera.world_to_camera[2, :3] for camera in cameras])
    return int(np.argmin(directions @ directions[0]))


def count_fruit_seen(shown: PhotoMap) -> int:
    """Count the fruit in a photo: of connected cores, and of areas of which no core is seen."""
    fruit = shown.probability > SHOWN
    cores, found = ndimage.label(fruit & (np.linalg.norm(shown.offsets, axis=2) < INNER), TOUCHING)
    areas, parts = ndimage.label(fruit, TOUCHING)
    hidden = np.setdiff1d(np.arange(1, parts + 1), areas[cores > 0])
    return int(
        (_measure_sizes(cores, found) >= LEAST).sum() + (_measure_sizes(areas, parts)[hidden - 1] >= 2 * LEAST).sum()
    )


def _measure_sizes(labels: NDArray[np.int32], count: int) -> NDArray[np.int64]:
    """Count the pixels (count,) of each label from 1."""
    return np.bincount(labels.ravel(), minlength=count + 1)[1:]
