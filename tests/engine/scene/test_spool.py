"""Photos that are decoded once in a run."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fruitlangs.engine.config import Config, TrainConfig
from fruitlangs.engine.pipeline import count_scene
from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene
from fruitlangs.engine.scene.photos.photo import FilePhoto
from fruitlangs.engine.scene.photos.spool import spool_photos
from fruitlangs.engine.splatting.training import photos as training_photos

CAMERA = Camera(K=np.eye(3), world_to_camera=np.eye(4), width=6, height=4)


class Counting(ArrayPhoto):
    """A photo that counts how often it is decoded."""

    decoded = 0

    def pixels(self) -> NDArray[np.uint8]:
        type(self).decoded += 1
        return super().pixels()


def scene_of(*photos: ArrayPhoto) -> Scene:
    nothing = np.zeros((0, 3))
    return Scene([CAMERA] * len(photos), photos, nothing, nothing.astype(np.uint8), up=np.array([0.0, 0.0, 1.0]))


def test_pixels_and_masks_are_those_of_the_photo_and_decoded_once(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (4, 6, 3), np.uint8)
    half = np.arange(24).reshape(4, 6) > 11
    Counting.decoded = 0
    with spool_photos(
        scene_of(Counting("a.jpg", pixels, half), Counting("b.jpg", pixels)), tmp_path / "spool"
    ) as scene:
        for _ in range(3):
            masked, plain = scene.images
            np.testing.assert_array_equal(masked.pixels(), pixels)
            np.testing.assert_array_equal(masked.mask(), half)
            assert plain.mask() is None
        assert Counting.decoded == 1
        assert (masked.name, plain.name) == ("a.jpg", "b.jpg")
    assert not (tmp_path / "spool").exists()


def test_a_full_disk_costs_time_and_no_photo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = np.full((4, 6, 3), 7, np.uint8)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with spool_photos(scene_of(ArrayPhoto("a.jpg", pixels)), tmp_path / "spool") as scene:
        monkeypatch.setattr(np, "save", full)
        np.testing.assert_array_equal(scene.images[0].pixels(), pixels)
        assert scene.images[0].mask() is None


def test_a_run_decodes_every_photo_once_before_it_draws_its_pictures(
    few_photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded, decode = Counter[str](), FilePhoto.pixels

    def count(photo: FilePhoto) -> NDArray[np.uint8]:
        decoded[photo.name] += 1
        return decode(photo)

    monkeypatch.setattr(FilePhoto, "pixels", count)
    monkeypatch.setattr(training_photos, "KEPT", 0)  # as with many large photos
    config = Config(train=TrainConfig(steps=40, max_gaussians=3000, holdout_every=0))
    without = count_scene(few_photos, ["fruit"], tmp_path, config=config)
    drawn = len(list((without.out / "pictures").iterdir()))
    assert len(decoded) == len(without.scene.cameras)
    assert sum(decoded.values()) <= len(decoded) + drawn
    assert not (tmp_path / "cache" / "spool").exists()
