"""Classical masks: what they cover, how their levels nest, that they find a fruit."""

from __future__ import annotations

import numpy as np
import pytest

from fruitlangs.engine.config import EmbedConfig
from fruitlangs.engine.language.masks.classical import LEVEL_COUNTS, ClassicalSegmenter
from fruitlangs.engine.language.masks.regions import RegionGraph
from fruitlangs.engine.language.masks.segmenter import open_segmenter
from fruitlangs.engine.language.masks.segments import Segments, number_masks

RADIUS = 17


def orchard(height: int = 180, width: int = 240) -> tuple[np.ndarray, np.ndarray]:
    """Green mottle with shaded red discs, and the number of the disc each pixel shows (0: none)."""
    generator = np.random.default_rng(0)
    v, u = np.mgrid[:height, :width]
    mottle = generator.integers(-25, 26, (height // 6 + 1, width // 6 + 1)).repeat(6, 0).repeat(6, 1)[:height, :width]
    image = np.stack([60 + mottle, 110 + mottle, 40 + mottle], -1).astype(float)
    which = np.zeros((height, width), int)
    for number, (x, y) in enumerate([(50, 50), (120, 110), (190, 60)], start=1):
        inside = (u - x) ** 2 + (v - y) ** 2 < RADIUS**2
        which[inside] = number
        image[inside] = (np.array([190, 40, 30]) * (0.8 + (x - u + y - v)[inside, None] / (6 * RADIUS))).clip(0, 255)
    return image.astype(np.uint8), which


@pytest.fixture(scope="module")
def segments() -> Segments:
    return ClassicalSegmenter().segment(orchard()[0])


def test_masks_cover_the_photo_and_are_numbered_without_gaps(segments):
    assert segments.labels.shape == (3, 180, 240)
    assert segments.labels.dtype == np.int32
    assert (np.unique(segments.labels) == np.arange(segments.count)).all()


def test_each_mask_lies_in_one_of_the_next_level_and_levels_keep_their_counts(segments):
    for level, most in enumerate(LEVEL_COUNTS):
        assert len(np.unique(segments.labels[level])) <= most
    for smaller, larger in zip(segments.labels, segments.labels[1:], strict=False):
        pairs = np.unique(np.stack([smaller.ravel(), larger.ravel()]), axis=1)
        assert len(pairs[0]) == len(np.unique(smaller)) > len(np.unique(larger))


def test_every_fruit_is_a_mask_of_some_level(segments):
    which = orchard()[1]
    for number in (1, 2, 3):
        fruit = which == number
        common = np.bincount(segments.labels[:, fruit].ravel(), minlength=segments.count)
        sizes = np.bincount(segments.labels.ravel(), minlength=segments.count)
        assert (common / (sizes + fruit.sum() - common)).max() > 0.8


def test_the_same_photo_gives_the_same_masks(segments):
    again = ClassicalSegmenter().segment(orchard()[0])
    assert again.count == segments.count
    assert (again.labels == segments.labels).all()


def test_masks_of_a_large_photo_are_those_of_its_small_copy_at_its_own_size(monkeypatch):
    image = orchard()[0]
    large = image.repeat(4, axis=0).repeat(4, axis=1)
    monkeypatch.setattr("fruitlangs.engine.language.masks.classical.SEEN_SIDE", 240)
    small, enlarged = ClassicalSegmenter().segment(image), ClassicalSegmenter().segment(large)
    assert enlarged.labels.shape == (3, 720, 960)
    assert (enlarged.labels[:, 2::4, 2::4] == small.labels).all()


@pytest.mark.parametrize("shape", [(1, 1), (8, 8), (3, 200), (48, 64)])
def test_a_photo_of_one_colour_or_of_few_pixels_has_masks(shape):
    segments = ClassicalSegmenter().segment(np.full((*shape, 3), 90, np.uint8))
    assert segments.labels.shape == (3, *shape)
    assert segments.count >= 3
    assert (segments.labels >= 0).all()


def test_a_shaded_side_joins_its_fruit_and_not_the_leaf_of_the_same_shade():
    # Fruit fades from 60 to 40 without a step; the leaf next to it is 40, behind a dark rim.
    row = np.concatenate([np.linspace(60, 40, 20), [5], np.full(20, 40.0)])
    regions = np.repeat([0, 1, 2, 3], [10, 10, 1, 20])
    colours = np.repeat(np.tile(row, (10, 1))[..., None], 3, axis=-1)
    graph = RegionGraph(np.tile(regions, (10, 1)), colours)
    merged = graph.merge_until(3)
    assert merged[0] == merged[1]
    assert merged[1] != merged[3]


def test_numbers_with_gaps_and_used_twice_become_numbers_of_their_own():
    labels = np.array([[[5, 5, -1]], [[-1, 0, 5]], [[-1, -1, -1]]], np.int32)
    segments = number_masks(labels)
    assert segments.labels.tolist() == [[[0, 0, -1]], [[-1, 1, 2]], [[-1, -1, -1]]]
    assert segments.count == 3


def test_the_settings_open_them():
    assert isinstance(open_segmenter(EmbedConfig()), ClassicalSegmenter)
