"""A mask's crop shows what lies in it and nothing else."""

from __future__ import annotations

import numpy as np

from fruitlangs.engine.language.masks.crops import LARGEST_SIDE, crop_masks
from fruitlangs.engine.language.masks.segments import Segments


def test_a_crop_is_the_mask_on_black_in_the_middle_of_a_square():
    image = np.arange(1, 6 * 8 * 3 + 1).reshape(6, 8, 3).astype(np.uint8)
    labels = np.full((2, 6, 8), -1, np.int32)
    labels[0, 1:3, 2:6] = 1
    labels[0, 1, 2] = -1
    labels[1, 5, 7] = 0
    dot, block = crop_masks(image, Segments(labels, 2))
    assert (dot == image[5:, 7:]).all()
    assert block.shape == (4, 4, 3)
    expected = image[1:3, 2:6].copy()
    expected[0, 0] = 0
    assert (block[1:3] == expected).all()
    assert not block[[0, 3]].any()


def test_a_large_crop_is_shrunk_and_keeps_its_shape_and_colours():
    image = np.full((900, 2000, 3), (200, 100, 50), np.uint8)
    labels = np.zeros((1, 900, 2000), np.int32)
    (crop,) = crop_masks(image, Segments(labels, 1))
    assert crop.shape == (LARGEST_SIDE, LARGEST_SIDE, 3)
    shown = crop.any(axis=(1, 2))
    assert shown.sum() == round(LARGEST_SIDE * 0.45)
    assert (crop[shown] == (200, 100, 50)).all()


def test_without_masks_there_are_no_crops():
    assert list(crop_masks(np.zeros((4, 4, 3), np.uint8), Segments(np.full((3, 4, 4), -1, np.int32), 0))) == []
