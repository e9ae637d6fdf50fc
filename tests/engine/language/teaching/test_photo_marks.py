"""Examples that are marked in photos: which Gaussians they show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from taught_words import feature_of, features_with

from fruitlangs.engine.errors import FormatError, SceneError, VocabularyError
from fruitlangs.engine.language.teaching.lesson import Mark
from fruitlangs.engine.language.teaching.photo_marks import (
    Click,
    find_photo,
    locate_pixel,
    marks_of_boxes,
    marks_of_clicks,
    marks_of_masks,
    ray_through,
)
from fruitlangs.engine.language.teaching.region import Ground
from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene
from fruitlangs.engine.scene.photos.lens import Lens
from fruitlangs.engine.scene.photos.photo import FilePhoto, Header
from fruitlangs.engine.splatting.gaussians import Gaussians

SIDE = 64
LEFT, RIGHT = slice(0, 40), slice(40, 80)
"""Rows of the Gaussians of two balls at pixels (16, 32) and (48, 32), of 8 pixels radius; the sky is empty."""


@dataclass(frozen=True)
class Balls:
    scene: Scene
    gaussians: Gaussians
    ground: Ground

    def shown(self, marks: list[Mark]) -> list[set[str]]:
        """Of each mark the balls that it shows."""
        rows = [self.ground.rows[mark.rows] for mark in marks]
        return [{"left" if row < LEFT.stop else "right" for row in own} for own in rows]


def camera_of() -> Camera:
    K = np.array([[SIDE, 0.0, SIDE / 2], [0.0, SIDE, SIDE / 2], [0.0, 0.0, 1.0]])
    return Camera(K, np.eye(4), SIDE, SIDE)


def scene_of(*names: str, size: tuple[int, int] = (SIDE, SIDE)) -> Scene:
    """Views from one place; each photo (width, height) is red on the left and green on the right."""
    picture = np.zeros((size[1], size[0], 3), np.uint8)
    picture[:, : size[0] // 2, 0] = 200
    picture[:, size[0] // 2 :, 1] = 200
    photos = [ArrayPhoto(name, picture) for name in names]
    none = np.zeros((0, 3))
    return Scene([camera_of()] * len(names), photos, none, none.astype(np.uint8), np.array([0.0, -1.0, 0.0]))


@pytest.fixture(scope="module")
def balls() -> Balls:
    rng = np.random.default_rng(0)
    inside = rng.normal(size=(40, 3))
    inside *= 0.1 * rng.uniform(0.3, 1.0, (40, 1)) / np.linalg.norm(inside, axis=1, keepdims=True)
    means = torch.from_numpy(np.concatenate([inside + [x, 0.0, 1.0] for x in (-0.25, 0.25)])).float()
    gaussians = Gaussians(
        means=means,
        log_scales=torch.full((80, 3), 0.02).log(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(80, 1),
        opacity_logits=torch.full((80,), 3.0),
        sh=torch.zeros(80, 1, 3),
    )
    evidence = torch.tensor([[1.0, 0.0]] * 40 + [[0.0, 1.0]] * 40)
    ground = Ground.of(means, features_with(torch.stack([feature_of("red", apple=0.9)] * 80), evidence))
    return Balls(scene_of("a/IMG_1.jpg", "a/IMG_2.jpg"), gaussians, ground)


@pytest.mark.parametrize(
    ("text", "click"),
    [("IMG_12.jpg:1034,887", ("IMG_12.jpg", 1034.0, 887.0)), (" a b/c:d.JPG: 3.5 , 0 ", ("a b/c:d.JPG", 3.5, 0.0)),
     ("IMG_12:-1,2", ("IMG_12", -1.0, 2.0))],
)  # fmt: skip
def test_a_place_is_read_as_it_is_spelled(text: str, click: tuple[str, float, float]) -> None:
    read = Click.read(text, positive=False)
    assert (read.photo, read.x, read.y) == click
    assert not read.positive
    assert Click.read(read.place, positive=False) == read


@pytest.mark.parametrize(
    "text",
    ["", "IMG_12.jpg", "IMG_12.jpg:1034", "IMG_12.jpg:1034;887", ":1,2", "a:1,2,", "a:x,2", "a:1e3,2", "a:nan,1"],
)
def test_what_is_spelled_otherwise_is_refused(text: str) -> None:
    with pytest.raises(VocabularyError, match=r"Write PHOTO:X,Y"):
        Click.read(text, positive=True)


@pytest.mark.parametrize(
    ("name", "view"),
    [("a/IMG_1.jpg", 0), ("b/IMG_1.jpg", 1), ("IMG_2.png", 2), ("IMG_2", 2), ("IMG_3", 3), ("IMG_3.jpg", 4)],
)
def test_a_photo_is_found_by_its_name_its_file_or_its_file_without_suffix(name: str, view: int) -> None:
    scene = scene_of("a/IMG_1.jpg", "b/IMG_1.jpg", "a/IMG_2.png", "IMG_3", "c/IMG_3.jpg")
    assert find_photo(scene, name) == view


@pytest.mark.parametrize(
    ("name", "said"),
    [("IMG_1.jpg", "2 photos are named 'IMG_1.jpg'"), ("IMG_1", "2 photos are named 'IMG_1'"),
     ("img_2", "No photo is named 'img_2'.*a/IMG_1.jpg to a/IMG_2.png"), ("", "No photo"), ("1", "No photo")],
)  # fmt: skip
def test_a_photo_that_is_missing_or_not_the_only_one_is_refused(name: str, said: str) -> None:
    with pytest.raises(SceneError, match=said):
        find_photo(scene_of("a/IMG_1.jpg", "b/IMG_1.jpg", "a/IMG_2.png"), name)


def test_a_result_without_its_photos_says_where_they_belong() -> None:
    with pytest.raises(SceneError, match="Put them back"):
        find_photo(replace(scene_of("a.jpg"), images=[]), "a.jpg")


def clicked(balls: Balls, *places: str, scene: Scene | None = None) -> list[Mark]:
    clicks = [Click.read(place, positive=True) for place in places]
    return marks_of_clicks(clicks, scene or balls.scene, balls.gaussians, balls.ground)


def test_a_click_shows_the_ball_at_its_pixel(balls: Balls) -> None:
    marks = clicked(balls, "IMG_1.jpg:16,32", "IMG_2:48,32")
    assert balls.shown(marks) == [{"left"}, {"right"}]
    assert [mark.place for mark in marks] == ["IMG_1.jpg:16,32", "IMG_2:48,32"]
    assert all(mark.positive and len(mark.rows) > 20 for mark in marks)


def test_the_thumbnail_of_a_click_shows_its_surroundings(balls: Balls) -> None:
    left, right = (mark.thumbnail for mark in clicked(balls, "IMG_1.jpg:16,32", "IMG_1.jpg:48,32"))
    assert left is not None
    assert right is not None
    assert (left.shape, left.dtype) == ((64, 64, 3), torch.uint8)
    assert left.float().mean((0, 1)).tolist() == [200.0, 0.0, 0.0]
    assert right.float().mean((0, 1)).tolist() == [0.0, 200.0, 0.0]


def test_the_thumbnail_of_a_click_in_a_corner_is_whole(balls: Balls) -> None:
    corner = replace(
        balls, gaussians=replace(balls.gaussians, means=balls.gaussians.means * 0 + torch.tensor([-0.5, -0.5, 1.0]))
    )
    (mark,) = clicked(corner, "IMG_1.jpg:0,0")
    assert mark.thumbnail is not None
    assert mark.thumbnail.float().mean((0, 1)).tolist() == [200.0, 0.0, 0.0]


def test_pixels_are_those_of_the_photo_and_not_of_its_camera(balls: Balls) -> None:
    scene = scene_of("large.jpg", size=(2 * SIDE, 4 * SIDE))
    marks = clicked(balls, "large:32,128", "large:96,128", scene=scene)
    assert balls.shown(marks) == [{"left"}, {"right"}]
    assert locate_pixel(scene.images[0], scene.cameras[0], 32.0, 128.0) == (16.0, 32.0)


@pytest.mark.parametrize("place", ["65,32", "32,65", "-1,32", "32,-0.5"])
def test_a_click_outside_its_photo_is_refused(balls: Balls, place: str) -> None:
    with pytest.raises(SceneError, match=r"IMG_1\.jpg has 64x64 pixels.*lies outside"):
        clicked(balls, f"IMG_1.jpg:{place}")


def test_a_click_on_nothing_is_refused(balls: Balls) -> None:
    with pytest.raises(SceneError, match=r"IMG_1\.jpg:32,2 shows nothing"):
        clicked(balls, "IMG_1.jpg:16,32", "IMG_1.jpg:32,2")


def test_a_ray_goes_through_its_pixel() -> None:
    pose = np.eye(4)
    pose[:3, :3] = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    pose[:3, 3] = [0.3, -0.2, 2.0]
    camera = replace(camera_of(), world_to_camera=pose)
    origin, direction = ray_through(camera, 10.0, 50.0)
    assert np.linalg.norm(direction) == pytest.approx(1.0)
    for distance in (0.5, 7.0):
        pixel, depth = camera.project(origin + distance * direction)
        assert pixel == pytest.approx([10.0, 50.0])
        assert depth > 0.0


def file_scene(folder: Path, lens: Lens, width: int, height: int, turn: Image.Transpose | None = None) -> Scene:
    """A scene whose one photo is a file of the lens's size, counted at width × height pixels."""
    stored = (lens.height, lens.width) if turn is not None else (lens.width, lens.height)
    Image.new("RGB", stored, (200, 0, 0)).save(folder / "a.png")
    photo = FilePhoto("a.png", folder / "a.png", Header(*stored, False, 1), lens, width, height, turn=turn)
    camera = replace(camera_of(), width=width, height=height)
    return replace(scene_of("a.png"), images=[photo], cameras=[camera])


def test_a_click_in_a_file_is_in_pixels_of_the_file_as_it_was_calibrated(tmp_path: Path) -> None:
    lens = Lens("PINHOLE", (200.0, 200.0, 128.0, 64.0), 256, 128)
    for turn in (None, Image.Transpose.ROTATE_90):
        scene = file_scene(tmp_path, lens, SIDE, SIDE // 2, turn)
        assert locate_pixel(scene.images[0], scene.cameras[0], 200.0, 100.0) == (50.0, 25.0)
        with pytest.raises(SceneError, match="256x128 pixels"):
            locate_pixel(scene.images[0], scene.cameras[0], 100.0, 200.0)


def test_a_click_in_a_distorted_photo_lands_where_the_camera_sees_it(tmp_path: Path) -> None:
    lens = Lens("SIMPLE_RADIAL", (80.0, 64.0, 64.0, -0.3), 128, 128)
    scene = file_scene(tmp_path, lens, SIDE, SIDE)
    assert locate_pixel(scene.images[0], scene.cameras[0], 64.0, 64.0) == pytest.approx((32.0, 32.0), abs=0.6)
    ray = np.array([[0.4, 0.2, 1.0]])
    x, y = lens.project(ray)[0]
    u, v = locate_pixel(scene.images[0], scene.cameras[0], float(x), float(y))
    assert (u, v) == pytest.approx((32.0 + 40.0 * 0.4, 32.0 + 40.0 * 0.2), abs=1.0)
    assert abs(x / 2.0 - u) > 0.9  # it would be somewhere else without the distortion


def boxes(folder: Path, *lines: str, columns: str = "image,xmin,ymin,xmax,ymax,label") -> Path:
    (folder / "boxes.csv").write_text("\n".join([columns, *lines]) + "\n", encoding="utf-8")
    return folder / "boxes.csv"


def boxed(balls: Balls, file: Path, word: str = "fig") -> list[Mark]:
    return marks_of_boxes(file, word, balls.scene, balls.gaussians, balls.ground)


def test_boxes_of_other_labels_are_negative_examples(balls: Balls, tmp_path: Path) -> None:
    lines = ("IMG_1.jpg,6,22,26,42,Fig", "IMG_1.jpg,38,22,58,42,pear", "a/IMG_2.jpg,38,22,58,42,")
    marks = boxed(balls, boxes(tmp_path, *lines))
    assert [mark.positive for mark in marks] == [True, False, True]
    assert balls.shown(marks) == [{"left"}, {"right"}, {"right"}]
    assert [mark.place for mark in marks] == ["a/IMG_1.jpg:16,32", "a/IMG_1.jpg:48,32", "a/IMG_2.jpg:48,32"]


def test_a_label_is_read_as_the_name_of_a_word(balls: Balls, tmp_path: Path) -> None:
    file = boxes(tmp_path, "IMG_1.jpg,6,22,26,42,Pommes")
    assert [mark.positive for mark in boxed(balls, file, "apple")] == [True]


def test_boxes_without_labels_all_show_the_word(balls: Balls, tmp_path: Path) -> None:
    columns = "\ufeffymax,xmax,ymin,xmin,note,image"
    (mark,) = boxed(balls, boxes(tmp_path, "42,26,22,6,ripe,IMG_1", columns=columns))
    assert mark.positive
    assert balls.shown([mark]) == [{"left"}]


def test_of_a_box_its_corners_do_not_count(balls: Balls, tmp_path: Path) -> None:
    whole = boxed(balls, boxes(tmp_path, "IMG_1.jpg,6,22,26,42,fig"))
    assert len(whole[0].rows) > 10
    with pytest.raises(SceneError, match="covers anything that was reconstructed"):
        boxed(balls, boxes(tmp_path, "IMG_1.jpg,20,36,64,64,fig"))


@pytest.mark.parametrize(
    ("lines", "columns", "said"),
    [
        (["IMG_1.jpg,6,22,26"], "image,xmin,ymin,xmax", "line 2 has no ymax"),
        (["IMG_1.jpg,6,22,26,42", "IMG_1.jpg,6,22,26"], "image,xmin,ymin,xmax,ymax", "line 3 has no ymax"),
        ([",6,22,26,42"], "image,xmin,ymin,xmax,ymax", "line 2 has no image"),
        (["IMG_1.jpg,6,22,wide,42"], "image,xmin,ymin,xmax,ymax", "'wide'"),
        (["IMG_1.jpg,6,nan,26,42"], "image,xmin,ymin,xmax,ymax", "line 2 has a corner"),
        (["IMG_1.jpg,6,22,inf,42"], "image,xmin,ymin,xmax,ymax", "line 2 has a corner"),
        (["IMG_1.jpg,6,22,26,42,red"], "image,xmin,ymin,xmax,ymax,label", "'red' describes"),
    ],
)
def test_boxes_that_cannot_be_read_are_a_format_error(
    balls: Balls, tmp_path: Path, lines: list[str], columns: str, said: str
) -> None:
    with pytest.raises(FormatError, match=rf"boxes\.csv cannot be read .*{said}.*columns image, xmin"):
        boxed(balls, boxes(tmp_path, *lines, columns=columns))


def test_a_missing_table_or_one_that_is_no_text_is_a_format_error(balls: Balls, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="No such file"):
        boxed(balls, tmp_path / "none.csv")
    (tmp_path / "boxes.csv").write_bytes(b"image,xmin\n\xff\xfe\x00,1\n")
    with pytest.raises(FormatError, match="cannot be read"):
        boxed(balls, tmp_path / "boxes.csv")


def test_a_box_in_an_unknown_photo_is_refused(balls: Balls, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="No photo is named 'IMG_9"):
        boxed(balls, boxes(tmp_path, "IMG_9.jpg,6,22,26,42,fig"))


def disc(x: float, y: float, radius: float, size: int = SIDE) -> Image.Image:
    down, right = np.mgrid[:size, :size] + 0.5
    return Image.fromarray((255 * ((right - x) ** 2 + (down - y) ** 2 < radius**2)).astype(np.uint8))


def masked(balls: Balls, folder: Path) -> list[Mark]:
    return marks_of_masks(folder, balls.scene, balls.gaussians, balls.ground)


def test_each_white_area_of_a_mask_is_an_example(balls: Balls, tmp_path: Path) -> None:
    both = np.maximum(np.asarray(disc(16, 32, 10)), np.asarray(disc(48, 32, 10)))
    Image.fromarray(both).save(tmp_path / "IMG_1.png")
    disc(48, 32, 10).convert("RGB").save(tmp_path / "IMG_2.PNG")
    (tmp_path / "notes.txt").write_text("by hand")
    marks = masked(balls, tmp_path)
    assert balls.shown(marks) == [{"left"}, {"right"}, {"right"}]
    assert [mark.place for mark in marks] == ["IMG_1.png, area 1", "IMG_1.png, area 2", "IMG_2.PNG, area 1"]
    assert all(mark.positive and len(mark.rows) > 20 for mark in marks)


def test_gaussians_that_mostly_lie_outside_a_mask_are_not_in_its_example(balls: Balls, tmp_path: Path) -> None:
    disc(12, 32, 5).save(tmp_path / "IMG_1.png")
    (mark,) = masked(balls, tmp_path)
    pixels, _ = balls.scene.cameras[0].project(balls.ground.means[mark.rows])
    assert 0 < len(mark.rows) < 30
    assert np.hypot(pixels[:, 0] - 12, pixels[:, 1] - 32).max() < 6.0


def test_what_a_fruit_hides_is_not_in_its_example(balls: Balls, tmp_path: Path) -> None:
    means = balls.gaussians.means.clone()
    means[RIGHT] += torch.tensor([-0.75, 0.0, 1.0])  # behind the left ball
    features = features_with(torch.stack([feature_of("red", apple=0.9)] * 80), torch.zeros(80, 1))
    hiding = Balls(balls.scene, replace(balls.gaussians, means=means), Ground.of(means, features))
    disc(16, 32, 10).save(tmp_path / "IMG_1.png")
    assert hiding.shown(masked(hiding, tmp_path)) == [{"left"}]


def test_a_gaussian_that_reaches_far_beyond_an_area_is_not_in_its_example(balls: Balls, tmp_path: Path) -> None:
    large = balls.gaussians.log_scales.clone()
    large[LEFT] = np.log(0.3)
    reaching = replace(balls, gaussians=replace(balls.gaussians, log_scales=large))
    disc(16, 32, 10).save(tmp_path / "IMG_1.png")
    with pytest.raises(SceneError, match="covers anything that was reconstructed"):
        masked(reaching, tmp_path)


def test_a_black_mask_is_an_error(balls: Balls, tmp_path: Path) -> None:
    Image.new("L", (SIDE, SIDE)).save(tmp_path / "IMG_1.png")
    with pytest.raises(SceneError, match="covers anything that was reconstructed"):
        masked(balls, tmp_path)


def _empty(folder: Path) -> None:
    (folder / "IMG_1.txt").write_text("")


def _of_another_size(folder: Path) -> None:
    disc(16, 32, 10, 2 * SIDE).save(folder / "IMG_1.png")


def _damaged(folder: Path) -> None:
    disc(16, 32, 10).save(folder / "IMG_1.png")
    (folder / "IMG_1.png").write_bytes((folder / "IMG_1.png").read_bytes()[:70])


def _text(folder: Path) -> None:
    (folder / "IMG_1.png").write_text("white")


@pytest.mark.parametrize(
    ("fill", "said"),
    [(_empty, "has no mask pictures"), (_of_another_size, "another size than a/IMG_1.jpg"),
     (_damaged, "IMG_1.png cannot be read as a picture"), (_text, "IMG_1.png cannot be read as a picture")],
)  # fmt: skip
def test_masks_that_cannot_be_used_are_a_format_error(
    balls: Balls, tmp_path: Path, fill: Callable[[Path], None], said: str
) -> None:
    fill(tmp_path)
    with pytest.raises(FormatError, match=said):
        masked(balls, tmp_path)


def test_a_missing_folder_of_masks_is_a_format_error(balls: Balls, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="has no mask pictures"):
        masked(balls, tmp_path / "none")


def test_a_mask_of_an_unknown_photo_is_refused(balls: Balls, tmp_path: Path) -> None:
    disc(16, 32, 10).save(tmp_path / "IMG_9.png")
    with pytest.raises(SceneError, match="No photo is named 'IMG_9'"):
        masked(balls, tmp_path)
