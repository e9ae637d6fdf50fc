"""What is said about photos that were read too small."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from fruitlangs.engine.config import Config, EmbedConfig, SceneConfig
from fruitlangs.engine.language.encoders.seen import BEST_WIDTH
from fruitlangs.engine.language.features.embedder import Embedder
from fruitlangs.engine.photo_size import (
    find_scaled_down,
    fruit_angle,
    fruit_width,
    growth,
    needed_bytes,
    scales_for,
    side_to_read,
    width_notices,
)
from fruitlangs.engine.reconstruction import read_larger
from fruitlangs.engine.scene.camera import Camera, Photo, Scene
from fruitlangs.engine.scene.photos.lens import Lens
from fruitlangs.engine.scene.photos.photo import make_scene, read_posed_photos
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.engine.scene.source import Source
from fruitlangs.engine.training import Run

SAMPLE = Path(__file__).resolve().parents[3] / "examples" / "orchard_tree"


def scene_of(folder: Path, config: SceneConfig) -> Scene:
    """A scene of one photo of 800×600 pixels."""
    Image.new("RGB", (800, 600)).save(folder / "photo.png")
    lens = Lens("PINHOLE", (700.0, 700.0, 400.0, 300.0), 800, 600)
    read = {"downscale": config.downscale, "max_side": config.max_side}
    views = read_posed_photos(folder / "photo.png", name="photo.png", lens=lens, world_to_camera=np.eye(4), **read)
    return make_scene(views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def said(folder: Path, width: float | None, **read: float) -> list[str]:
    config = Config(scene=SceneConfig(**read))  # type: ignore[arg-type]
    scene = scene_of(folder, config.scene)
    return width_notices(width, scene.images, scene.cameras, config)


@pytest.mark.parametrize(("read", "factor"), [({}, 1.0), ({"downscale": 2.0}, 2.0), ({"max_side": 200}, 4.0)])
def test_photos_grow_by_how_much_wider_their_files_are(tmp_path: Path, read: dict, factor: float) -> None:
    photos = scene_of(tmp_path, SceneConfig(**read)).images
    assert growth(photos).tolist() == [factor]
    assert find_scaled_down(photos) == (photos if factor > 1.0 else [])


def mixed_scene(folder: Path, *widths: int, max_side: int = 200) -> Scene:
    """Photos of these widths, three quarters as high, in one frame."""
    views = []
    for number, width in enumerate(widths):
        path, height = folder / f"{number}.png", width * 3 // 4
        Image.new("RGB", (width, height)).save(path)
        lens = Lens("PINHOLE", (0.9 * width, 0.9 * width, width / 2, height / 2), width, height)
        views += read_posed_photos(path, name=path.name, lens=lens, world_to_camera=np.eye(4), max_side=max_side)
    return make_scene(views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def test_each_photo_grows_to_its_own_file_at_most(tmp_path: Path) -> None:
    photos = mixed_scene(tmp_path, 800, 240, 160).images
    assert growth(photos).tolist() == [4.0, 1.2, 1.0]
    assert growth(photos, 400).tolist() == [2.0, 1.2, 1.0]
    assert [photo.name for photo in find_scaled_down(photos)] == ["0.png", "1.png"]


def test_one_small_photo_does_not_keep_the_large_ones_small(tmp_path: Path) -> None:
    config, scene = Config(scene=SceneConfig(max_side=200)), mixed_scene(tmp_path, 160, 800, 800, 800)
    assert side_to_read(7.0, scene.images, scene.cameras, config, free=1 << 40) == 400


def test_one_small_photo_does_not_silence_the_advice(tmp_path: Path) -> None:
    config, scene = Config(scene=SceneConfig(max_side=200)), mixed_scene(tmp_path, 160, 800, 800, 800)
    (notice,) = width_notices(7.0, scene.images, scene.cameras, config)
    assert "--scene.max-side 400 makes them 14 pixels wide" in notice


def test_photos_that_are_mostly_small_get_no_advice_that_helps_one_of_them(tmp_path: Path) -> None:
    config, scene = Config(scene=SceneConfig(max_side=200)), mixed_scene(tmp_path, 160, 160, 160, 800)
    (notice,) = width_notices(7.0, scene.images, scene.cameras, config)
    assert "--scene.max-side" not in notice


def test_the_advised_size_is_no_larger_than_the_largest_file(tmp_path: Path) -> None:
    config, scene = Config(scene=SceneConfig(max_side=200)), mixed_scene(tmp_path, 160, 240, 240, 250)
    (notice,) = width_notices(7.0, scene.images, scene.cameras, config)
    assert "--scene.max-side 250 makes them 8 pixels wide" in notice


def test_a_result_without_photos_gets_no_advice_to_read_them_larger() -> None:
    (notice,) = width_notices(7.0, [], [], Config())
    assert "--scene.max-side" not in notice


def test_photos_that_stay_as_they_are_need_no_more_memory(tmp_path: Path) -> None:
    (tmp_path / "mixed").mkdir()
    (tmp_path / "large").mkdir()
    config = Config(scene=SceneConfig(max_side=200))
    mixed = mixed_scene(tmp_path / "mixed", 800, *[160] * 30)
    large = mixed_scene(tmp_path / "large", 800, *[800] * 30)
    more = [
        needed_bytes(400, scene.images, scene.cameras, config) - needed_bytes(200, scene.images, scene.cameras, config)
        for scene in (mixed, large)
    ]
    assert 0 < more[0] < more[1]


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


@pytest.mark.parametrize("width", [12.0, None])
def test_wide_fruit_need_no_advice(tmp_path: Path, width: float | None) -> None:
    assert said(tmp_path, width, max_side=200) == []


def test_narrow_fruit_in_photos_of_full_size_are_reported_with_how_to_photograph(tmp_path: Path) -> None:
    (notice,) = said(tmp_path, 7.0)
    assert notice == (
        "the fruit are 7 pixels wide in the photos as read, and 14 are needed: fruit may be missing. Take photos from "
        "nearer, of a part of the tree each, or with more pixels"
    )


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
    scene = read_scene(SAMPLE, SceneConfig(max_side=side))
    angle = fruit_angle(scene.images, scene.cameras, embedder.encoder)
    assert angle is not None
    assert angle * scene.cameras[0].K[0, 0] == pytest.approx(counted, rel=0.2)


def test_photos_without_fruit_tell_no_width_and_are_seen_as_photos_of_unknown_fruit(embedder: Embedder) -> None:
    scene = read_scene(SAMPLE, SceneConfig())
    blank = [np.full((240, 320, 3), 128, np.uint8)] * 2
    assert fruit_width(blank, [320.0, 320.0], embedder.encoder) is None
    assert scales_for(scene.cameras[:1], None, embedder.encoder) == [(2.0,)]


def test_photos_of_one_capture_show_fruit_by_their_focal_lengths(embedder: Embedder) -> None:
    """A photo of twice the pixels shows fruit twice as wide, and is seen at half the scale."""
    camera = read_scene(SAMPLE, SceneConfig()).cameras[0].scale(3.0)
    (one,), (half,) = scales_for([camera, camera.scale(2.0)], 14.0 / camera.K[0, 0] * 1.4, embedder.encoder)
    assert one == pytest.approx(BEST_WIDTH / 19.6, rel=0.01)
    assert half == pytest.approx(one / 2.0, rel=0.01)


def test_photos_with_narrow_fruit_are_read_larger_the_same_way_for_every_prompt(
    tmp_path: Path, embedder: Embedder
) -> None:
    source, config = Source(path=SAMPLE), Config(scene=SceneConfig(max_side=240))
    first = Run(tmp_path, embedder, config, given=())
    larger = read_larger(source, first)
    assert 320 <= larger.config.scene.max_side <= 480
    (notice,) = first.log.notices
    assert re.match("fruit would be about (9|10) pixels wide, so the photos were read larger than usual", notice)
    (record,) = tmp_path.glob("size-*.json")
    record.write_text('{"width": 8.0, "max_side": 340}')
    again = read_larger(source, Run(tmp_path, embedder, config, given=()))
    assert again.config.scene.max_side == 340


def test_the_width_of_fruit_is_measured_in_the_photos_that_were_scaled_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, embedder: Embedder
) -> None:
    """In small photos the fruit are narrower, and reading larger does not change them."""
    scene, asked = mixed_scene(tmp_path, 160, 800, 160, 800), []

    def measured(photos: Sequence[Photo], cameras: Sequence[Camera], encoder: object, progress: object) -> float:
        asked.extend(photo.name for photo in photos)
        return 7.0 / cameras[0].K[0, 0]

    monkeypatch.setattr("fruitlangs.engine.reconstruction.fruit_angle", measured)
    source = SimpleNamespace(read=lambda _: scene, hash=lambda: "")
    run = Run(tmp_path, embedder, Config(scene=SceneConfig(max_side=200)), given=())
    assert read_larger(source, run).config.scene.max_side == 400  # type: ignore[arg-type]
    assert asked == ["1.png", "3.png"]
    (notice,) = run.log.notices
    assert notice.startswith("fruit would be about 7 pixels wide, so 2 of 4 photos were read larger than usual")


@pytest.mark.parametrize("given", [None, {"scene.max_side"}])
def test_a_size_that_the_user_gave_is_kept(tmp_path: Path, embedder: Embedder, given: set[str] | None) -> None:
    run = Run(tmp_path, embedder, Config(scene=SceneConfig(max_side=240)), given=given)
    assert read_larger(Source(path=SAMPLE), run) is run
    assert not list(tmp_path.iterdir())
