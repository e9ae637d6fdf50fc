"""What is said about photos that were read too small."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fruitlangs.engine.config import Config, SceneConfig
from fruitlangs.engine.photo_size import reduction, width_notices
from fruitlangs.engine.scene.camera import Scene
from fruitlangs.engine.scene.photos.lens import Lens
from fruitlangs.engine.scene.photos.photo import make_scene, posed_photos


def scene_of(folder: Path, config: SceneConfig) -> Scene:
    """A scene of one photo of 800×600 pixels."""
    Image.new("RGB", (800, 600)).save(folder / "photo.png")
    lens = Lens("PINHOLE", (700.0, 700.0, 400.0, 300.0), 800, 600)
    read = {"downscale": config.downscale, "max_side": config.max_side}
    views = posed_photos(folder / "photo.png", name="photo.png", lens=lens, world_to_camera=np.eye(4), **read)
    return make_scene(views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def said(folder: Path, width: float | None, **read: float) -> list[str]:
    config = Config(scene=SceneConfig(**read))  # type: ignore[arg-type]
    scene = scene_of(folder, config.scene)
    return width_notices(width, scene.images, scene.cameras, config)


@pytest.mark.parametrize(("read", "factor"), [({}, 1.0), ({"downscale": 2.0}, 2.0), ({"max_side": 200}, 4.0)])
def test_the_reduction_is_how_much_wider_the_files_are(tmp_path: Path, read: dict, factor: float) -> None:
    assert reduction(scene_of(tmp_path, SceneConfig(**read)).images) == factor


def test_narrow_fruit_in_reduced_photos_are_reported_with_the_size_to_read(tmp_path: Path) -> None:
    (notice,) = said(tmp_path, 7.0, max_side=200)
    assert notice.startswith(
        "the fruit are 7 pixels wide in the photos as read, and 14 are needed. --scene.max-side 400"
    )
    assert "makes them 14 pixels wide" in notice
    assert "GB of memory and up to 4.0 times the time" in notice


def test_the_advice_goes_no_further_than_the_files_and_names_a_downscale(tmp_path: Path) -> None:
    (notice,) = said(tmp_path, 4.0, downscale=2.0)
    assert "--scene.max-side 800 --scene.downscale 1 makes them 8 pixels wide" in notice


@pytest.mark.parametrize(("width", "read"), [(14.0, {"max_side": 200}), (7.0, {}), (None, {"max_side": 200})])
def test_wide_fruit_and_photos_of_full_size_need_no_advice(tmp_path: Path, width: float | None, read: dict) -> None:
    assert said(tmp_path, width, **read) == []
