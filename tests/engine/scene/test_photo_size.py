"""What is said about photos that were read too small."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fruitlangs.engine.config import Config, EmbedConfig, SceneConfig
from fruitlangs.engine.language.features.embedder import Embedder
from fruitlangs.engine.photo_size import reduction, seen_width, side_to_read, width_notices
from fruitlangs.engine.reconstruction import reading_larger
from fruitlangs.engine.scene.camera import Scene
from fruitlangs.engine.scene.photos.lens import Lens
from fruitlangs.engine.scene.photos.photo import make_scene, posed_photos
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.engine.scene.source import Source
from fruitlangs.engine.training import Run

SAMPLE = Path(__file__).resolve().parents[3] / "examples" / "orchard_tree"


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


@pytest.mark.parametrize(("width", "read"), [(12.0, {"max_side": 200}), (7.0, {}), (None, {"max_side": 200})])
def test_wide_fruit_and_photos_of_full_size_need_no_advice(tmp_path: Path, width: float | None, read: dict) -> None:
    assert said(tmp_path, width, **read) == []


@pytest.mark.parametrize(("width", "side"), [(7.0, 400), (4.0, 400), (10.0, 280), (12.0, 200), (None, 200)])
def test_photos_are_read_up_to_twice_as_large_for_narrow_fruit(tmp_path: Path, width: float, side: int) -> None:
    config = Config(scene=SceneConfig(max_side=200))
    scene = scene_of(tmp_path, config.scene)
    assert side_to_read(width, scene.images, scene.cameras, config, free=1 << 40) == side


def test_photos_are_read_no_larger_than_the_files_or_the_memory(tmp_path: Path) -> None:
    config = Config(scene=SceneConfig(max_side=700))
    scene = scene_of(tmp_path, config.scene)
    assert side_to_read(7.0, scene.images, scene.cameras, config, free=1 << 40) == 800
    assert side_to_read(7.0, scene.images, scene.cameras, config, free=1) == 700


@pytest.fixture(scope="module")
def embedder() -> Embedder:
    return Embedder.open(EmbedConfig())


@pytest.mark.parametrize(("side", "counted"), [(360, 14.6), (240, 9.7)])
def test_the_width_of_fruit_is_measured_in_a_few_photos(embedder: Embedder, side: int, counted: float) -> None:
    """counted: the median width of the fruit of the sample, as it is counted."""
    width = seen_width(read_scene(SAMPLE, SceneConfig(max_side=side)).images, embedder.encoder)
    assert width == pytest.approx(counted, rel=0.2)


def test_photos_with_narrow_fruit_are_read_larger_the_same_way_for_every_prompt(
    tmp_path: Path, embedder: Embedder
) -> None:
    source, config = Source(path=SAMPLE), Config(scene=SceneConfig(max_side=240))
    first = Run(tmp_path, embedder, config, given=())
    larger = reading_larger(source, first)
    assert 320 <= larger.config.scene.max_side <= 480
    (notice,) = first.log.notices
    assert notice.startswith("fruit would be about 10 pixels wide, so the photos were read larger than usual")
    (record,) = tmp_path.glob("size-*.json")
    record.write_text('{"width": 8.0, "max_side": 340}')
    again = reading_larger(source, Run(tmp_path, embedder, config, given=()))
    assert again.config.scene.max_side == 340


@pytest.mark.parametrize("given", [None, {"scene.max_side"}])
def test_a_size_that_the_user_gave_is_kept(tmp_path: Path, embedder: Embedder, given: set[str] | None) -> None:
    run = Run(tmp_path, embedder, Config(scene=SceneConfig(max_side=240)), given=given)
    assert reading_larger(Source(path=SAMPLE), run) is run
    assert not list(tmp_path.iterdir())
