"""The photo that sees a fruit best, and photos behind their cameras; how they look is seen in a window."""

from __future__ import annotations

import json
import shutil
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import ball_scene
import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from PIL import Image
from pillow_heif import register_heif_opener

from fruitlangs.engine.scene.camera import Camera, look_along
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects
from fruitlangs.operators.data import photo_files
from fruitlangs.operators.data.photo_files import FILE, photo_path
from fruitlangs.operators.data.read_cameras import read_camera
from fruitlangs.operators.photos import photo_backgrounds
from fruitlangs.operators.photos.best_photo import find_fruit_views
from fruitlangs.operators.photos.photo_backgrounds import PROBLEM, background_of, is_awaited, photo_cover, show_photo
from fruitlangs.operators.photos.photo_choice import MOST, Surface, _compute_outline, find_best_views
from fruitlangs.operators.scene_frame import scene_frame
from fruitlangs.operators.steps.show_result import show_result, show_scene

RADIUS = 0.1
BALL = RADIUS * np.eye(3)
"""The half axes of a round fruit."""
BEND = 2.0
"""Of a lens: enough that the balls, near the photo's middle, move by pixels."""


def camera_at(place, target=(0.0, 0.0, 0.0)) -> Camera:
    place = np.array(place, np.float64)
    pose = look_along(place, np.array(target) - place, np.array([0.0, 0.0, 1.0]))
    return Camera(np.array([[200.0, 0, 100], [0, 200.0, 75], [0, 0, 1]]), pose, 200, 150)


def wall(center, half: float) -> Surface:
    """Solid Gaussians on a square of a plane x = constant."""
    y, z = (grid.ravel() for grid in np.meshgrid(*[np.arange(-half, half + 1e-9, 0.01)] * 2))
    means = np.stack([np.zeros_like(y), y, z], 1) + center
    count = len(means)
    return Surface(
        means.astype(np.float32),
        np.full((count, 3), 0.008, np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full(count, 0.95, np.float32),
    )


def chosen(cameras, surface=None, center=(0.0, 0.0, 0.0)) -> list[int]:
    return [sight.index for sight in find_best_views(cameras, np.array(center), BALL, surface)]


def test_the_nearest_photo_is_the_best_and_those_that_look_elsewhere_see_nothing():
    cameras = [camera_at((3, 0, 0)), camera_at((2, 0, 0)), camera_at((1, 0, 0), (2, 0, 0)), camera_at((0, 4, 0))]
    assert chosen(cameras) == [1, 0, 3]


def test_a_nearer_photo_behind_leaves_comes_last_or_not_at_all():
    cameras = [camera_at((2, 0, 0)), camera_at((0, 3, 0))]
    assert chosen(cameras, wall((1.0, 0.0, 0.0), 0.2)) == [1]
    # A wall that covers a half leaves half of the disc.
    half = find_best_views(cameras, np.zeros(3), BALL, wall((1.0, 0.22, 0.0), 0.2))
    shares = {sight.index: sight.share for sight in half}
    assert shares[1] == 1.0
    assert 0.2 < shares[0] < 0.8


def test_what_is_behind_the_fruit_and_its_own_surface_hide_nothing():
    cameras = [camera_at((2, 0, 0)), camera_at((0, 3, 0))]
    assert chosen(cameras, wall((-0.3, 0.0, 0.0), 0.5)) == [0, 1]
    assert chosen(cameras, wall((RADIUS, 0.0, 0.0), 0.08)) == [0, 1]


def test_a_fruit_that_the_frame_cuts_is_worth_its_part():
    place = camera_at((2, 0, 0)).unproject(np.full((150, 200), 2.0))[75, 199]  # a pixel at the frame's edge
    sights = find_best_views([camera_at((2, 0, 0))], place, BALL, None)
    assert 0.3 < sights[0].share < 0.8


def test_a_nearer_photo_that_cuts_the_fruit_comes_after_all_that_show_it_whole():
    # The near photo has the fruit four times as large, with its outline just over the left edge, the far one whole.
    near, far = camera_at((1, 0, 0), (0, -0.42, 0)), camera_at((4, 0, 0))
    sights = find_best_views([near, far], np.zeros(3), BALL, None)
    assert [sight.index for sight in sights] == [1, 0]
    assert [sight.whole for sight in sights] == [True, False]
    assert sights[1].share == 1.0  # every tested point of the disc is inside: only the outline tells
    assert chosen([near]) == [0]


def test_the_end_of_a_long_fruit_that_the_frame_cuts_is_noticed():
    camera = camera_at((2, 0, 0), (0, 0, -0.6))
    long = np.diag([RADIUS, RADIUS, 2.0 * RADIUS])
    assert find_best_views([camera], np.zeros(3), BALL, None)[0].whole
    assert not find_best_views([camera], np.zeros(3), long, None)[0].whole


def test_the_outline_is_where_rays_touch_the_ellipsoid():
    camera, axes = camera_at((2, 1, 0.5)), np.array([[0.0, 0.3, 0.1], [0.2, 0.0, 0.0], [0.0, -0.05, 0.15]])
    for point in _compute_outline(camera, np.zeros(3), axes):
        unit = np.linalg.solve(axes.T, point)
        assert np.linalg.norm(unit) == pytest.approx(1.0)
        assert unit @ np.linalg.solve(axes.T, point - camera.center) == pytest.approx(0.0, abs=1e-9)


def test_of_equal_views_the_central_one_is_better_and_of_two_distances_the_near_one():
    side, middle, far = camera_at((2, 0, 0), (0, 0.6, 0)), camera_at((2, 0, 0)), camera_at((2.6, 0, 0))
    assert chosen([far, side, middle]) == [2, 1, 0]


def test_an_open_view_is_better_than_one_twice_as_large_that_is_mostly_hidden():
    near, far = camera_at((2, 0, 0)), camera_at((0, 4, 0))
    sights = find_best_views([near, far], np.zeros(3), BALL, wall((1.0, 0.19, 0.0), 0.2))
    assert [sight.index for sight in sights] == [1, 0]
    assert sights[1].share * sights[1].pixels ** 2 > sights[0].share * sights[0].pixels ** 2


def test_a_fruit_is_searched_in_every_photo_until_one_shows_it():
    hidden = [camera_at((2 + 0.01 * index, 0, 0)) for index in range(MOST)]
    assert chosen([*hidden, camera_at((0, 6, 0))], wall((1.0, 0.0, 0.0), 0.2)) == [MOST]


def test_how_wide_a_fruit_is_in_a_photo_is_reported_in_its_pixels():
    assert find_best_views([camera_at((2, 0, 0))], np.zeros(3), BALL, None)[0].pixels == pytest.approx(20.0)


@pytest.fixture
def shown(extension, counted_balls):
    """The balls' count shown in an empty file; the first fruit is active."""
    show_result(bpy.context, bpy.context.scene, counted_balls)
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = find_owned_objects(bpy.context.scene, "fruit")[0]
    return bpy.context.scene


def test_cameras_read_back_are_those_that_were_written(shown, counted_balls):
    frame = scene_frame(shown)
    for item, camera in zip(find_owned_objects(shown, "camera"), counted_balls.scene.cameras, strict=True):
        found = read_camera(item, frame)
        np.testing.assert_allclose(found.K, camera.K, atol=1e-3)
        np.testing.assert_allclose(found.world_to_camera, camera.world_to_camera, atol=1e-5)


def test_uneven_pixels_and_shifts_are_read_back(extension, counted, result_of, tmp_path):
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    item = find_owned_objects(bpy.context.scene, "camera")[3]
    found = read_camera(item, scene_frame(bpy.context.scene))
    np.testing.assert_allclose(found.K, counted.scene.cameras[3].K, atol=1e-3)


def test_the_chosen_photos_show_the_fruit_unhidden_in_the_truth(shown, counted_balls):
    for item in find_owned_objects(shown, "fruit"):
        camera, sight = find_fruit_views(shown, item)[0]
        _, ids, _ = ball_scene.look(counted_balls.scene.cameras[int(camera.name)].world_to_camera)
        center = np.array(item.location)
        number = 1 + int(np.argmin(np.linalg.norm(ball_scene.BALLS - center, axis=1)))
        found = counted_balls.fruit_count
        own = found.diameters[np.argmin(np.linalg.norm(found.centers - ball_scene.BALLS[number - 1], axis=1))]
        expected = np.pi / 4 * (sight.pixels * ball_scene.DIAMETERS[number - 1] / own) ** 2
        assert (ids == number).sum() > 0.75 * expected


def test_an_import_loads_no_photo_and_looking_loads_only_one(shown):
    assert not len(bpy.data.images)
    assert bpy.ops.fruitlangs.best_photo() == {"FINISHED"}
    first = shown.camera
    assert len(bpy.data.images) == 1
    assert bpy.ops.fruitlangs.next_photo() == {"FINISHED"}
    assert shown.camera != first
    backed = [item for item in find_owned_objects(shown, "camera") if background_of(item) is not None]
    assert backed == [shown.camera]
    assert shown.camera.data.show_background_images
    assert len(bpy.data.images) == 1


def test_a_photo_that_cuts_the_fruit_says_so(shown, capfd):
    bpy.ops.fruitlangs.best_photo()
    assert "cut by the edge of the photo" not in capfd.readouterr().out
    bpy.context.view_layer.objects.active.scale *= 20.0
    bpy.ops.fruitlangs.best_photo()
    assert "cut by the edge of the photo" in capfd.readouterr().out


def test_previous_goes_back_and_the_round_closes(shown):
    bpy.ops.fruitlangs.best_photo()
    first, count = shown.camera, len(find_fruit_views(shown, bpy.context.view_layer.objects.active))
    assert count > 2
    bpy.ops.fruitlangs.next_photo()
    bpy.ops.fruitlangs.next_photo(step=-1)
    assert shown.camera == first
    for _ in range(count):
        bpy.ops.fruitlangs.next_photo()
    assert shown.camera == first


def test_the_free_view_has_the_users_camera_and_size_again(shown):
    own = bpy.data.objects.new("Mine", bpy.data.cameras.new("Mine"))
    shown.collection.objects.link(own)
    shown.camera, shown.render.resolution_x = own, 777
    bpy.ops.fruitlangs.best_photo()
    assert (shown.render.resolution_x, shown.render.resolution_y) == (ball_scene.WIDTH, ball_scene.HEIGHT)
    bpy.ops.fruitlangs.next_photo()
    assert bpy.ops.fruitlangs.free_view() == {"FINISHED"}
    assert (shown.camera, shown.render.resolution_x) == (own, 777)
    assert not len(bpy.data.images)
    assert not bpy.ops.fruitlangs.free_view.poll()


def test_the_free_view_keeps_the_scenes_camera_where_the_one_before_was_deleted(shown, counted_balls):
    bpy.ops.fruitlangs.best_photo()
    bpy.ops.fruitlangs.next_photo()
    if shown.fruitlangs.photos.camera == shown.camera:
        bpy.ops.fruitlangs.next_photo()
    bpy.data.objects.remove(shown.fruitlangs.photos.camera)
    assert shown.fruitlangs.photos.camera is None
    assert bpy.ops.fruitlangs.free_view() == {"FINISHED"}
    assert shown.camera in find_owned_objects(shown, "camera")


def test_buttons_wait_for_a_fruit(shown):
    bpy.context.view_layer.objects.active = find_owned_object(shown, "root")
    assert not bpy.ops.fruitlangs.best_photo.poll()


def test_photos_are_as_strong_as_the_slider_says(shown):
    bpy.ops.fruitlangs.best_photo()
    shown.fruitlangs.photos.opacity = 0.25
    slot = background_of(shown.camera)
    assert slot.alpha == pytest.approx(0.25)
    shown.fruitlangs.photos.show = False
    assert not slot.show_background_image


def test_splats_give_way_to_the_photo_where_it_is_looked_at(shown):
    space, inside = SimpleNamespace(use_local_camera=False), SimpleNamespace(view_perspective="CAMERA")
    assert photo_cover(space, inside, shown) == 0.0
    bpy.ops.fruitlangs.best_photo()
    shown.fruitlangs.photos.opacity = 0.25
    assert photo_cover(space, inside, shown) == pytest.approx(0.25)
    assert photo_cover(space, SimpleNamespace(view_perspective="PERSP"), shown) == 0.0
    shown.fruitlangs.photos.show = False
    assert photo_cover(space, inside, shown) == 0.0


@pytest.fixture
def own_balls(balls, tmp_path) -> Path:
    """A copy of the balls that may be moved and spoilt."""
    return Path(shutil.copytree(balls, tmp_path / "orchard" / "balls"))


def test_a_missing_photo_is_reported(extension, own_balls):
    scene = bpy.context.scene
    show_scene(bpy.context, scene, read_scene(own_balls))
    item = find_owned_objects(scene, "camera")[0]
    Path(item[FILE]).unlink()
    with pytest.raises(Exception, match=r"The photo 000.png is no longer in"):
        show_photo(item)


def test_looking_goes_on_without_the_photo_and_the_panel_says_why(shown):
    for item in find_owned_objects(shown, "camera"):
        item[FILE] = "/nowhere/at/all/1.jpg"
    assert bpy.ops.fruitlangs.best_photo() == {"FINISHED"}
    assert "/nowhere/at/all" in shown.camera[PROBLEM]
    assert not len(bpy.data.images)


def test_a_camera_that_never_had_a_photo_says_so_and_what_to_do(shown):
    for item in find_owned_objects(shown, "camera"):
        del item[FILE]
    assert bpy.ops.fruitlangs.best_photo() == {"FINISHED"}
    assert "no photo for the camera" in shown.camera[PROBLEM]
    assert "Import the scene again" in shown.camera[PROBLEM]


def test_a_photo_put_back_is_shown_after_loading_whatever_was_reported_when_saving(shown, tmp_path):
    item = find_owned_objects(shown, "camera")[0]
    item[PROBLEM] = "The photo is gone"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    cameras = find_owned_objects(bpy.context.scene, "camera")
    assert cameras
    assert not [camera for camera in cameras if PROBLEM in camera]


def test_loading_is_noticed_once_however_often_the_extension_is_enabled(extension):
    extension.register()
    assert bpy.app.handlers.load_post.count(photo_backgrounds._forget_problems) == 1
    extension.unregister()
    assert photo_backgrounds._forget_problems not in bpy.app.handlers.load_post


def test_photos_that_moved_with_the_blend_are_found(extension, own_balls, tmp_path):
    show_scene(bpy.context, bpy.context.scene, read_scene(own_balls))
    bpy.ops.wm.save_as_mainfile(filepath=str(own_balls.parent / "a.blend"))
    moved = Path(shutil.move(own_balls.parent, tmp_path / "elsewhere"))
    bpy.ops.wm.open_mainfile(filepath=str(moved / "a.blend"))
    item = find_owned_objects(bpy.context.scene, "camera")[0]
    assert photo_path(item) == moved / "balls" / "images" / "000.png"
    show_photo(item)
    assert background_of(item).image.filepath == "//balls/images/000.png"


def bent(photo: np.ndarray, k1: float) -> np.ndarray:
    """A pinhole's photo as a lens with radial distortion k1 would have taken it, by the nearest pixel."""
    v, u = np.mgrid[: photo.shape[0], : photo.shape[1]] + 0.5
    seen = np.stack([u - ball_scene.WIDTH / 2, v - ball_scene.HEIGHT / 2]) / ball_scene.FOCAL
    straight = seen.copy()
    for _ in range(30):
        straight = seen / (1.0 + k1 * (straight**2).sum(0))
    x, y = straight * ball_scene.FOCAL + np.array([ball_scene.WIDTH / 2, ball_scene.HEIGHT / 2])[:, None, None]
    return photo[np.clip(y.astype(int), 0, len(photo) - 1), np.clip(x.astype(int), 0, photo.shape[1] - 1)]


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    return (first & second).sum() / (first | second).sum()


def red(image: bpy.types.Image) -> np.ndarray:
    """(H, W) where a picture shows a ball, top row first."""
    pixels = np.array(image.pixels[:]).reshape(image.size[1], image.size[0], 4)[::-1]
    return (pixels[..., 0] > 0.35) & (pixels[..., 1] < 0.2)


@pytest.fixture
def bent_balls(extension, own_balls):
    """The folder of five balls whose photos a bending lens took, and shown."""
    lens = json.loads((own_balls / "transforms.json").read_text())
    (own_balls / "transforms.json").write_text(json.dumps({**lens, "camera_model": "OPENCV", "k1": BEND}))
    for path in (own_balls / "images").iterdir():
        Image.fromarray(bent(np.array(Image.open(path)), BEND)).save(path)
    show_scene(bpy.context, bpy.context.scene, read_scene(own_balls))
    return own_balls


def test_the_photo_of_a_lens_that_bends_lies_on_the_fruit(bent_balls):
    for item, pose in list(zip(find_owned_objects(bpy.context.scene, "camera"), ball_scene.poses(16), strict=True))[
        ::5
    ]:
        truth = ball_scene.look(pose)[1] > 0
        show_photo(item)
        image = background_of(item).image
        assert tuple(image.size) == (ball_scene.WIDTH, ball_scene.HEIGHT)
        as_taken = bpy.data.images.load(item[FILE])
        assert overlap(red(image), truth) > 0.88
        assert overlap(red(image), truth) > overlap(red(as_taken), truth) + 0.04


def test_a_heic_photo_that_blender_does_not_read_is_shown_as_a_copy(extension, own_balls):
    register_heif_opener()
    for path in (own_balls / "images").iterdir():
        Image.open(path).save(path.with_suffix(".heic"), quality=95)
        path.unlink()
    transforms = own_balls / "transforms.json"
    transforms.write_text(transforms.read_text().replace(".png", ".heic"))
    show_scene(bpy.context, bpy.context.scene, read_scene(own_balls))
    item = find_owned_objects(bpy.context.scene, "camera")[0]
    show_photo(item)
    assert item[FILE].endswith(".heic")
    assert overlap(red(background_of(item).image), ball_scene.look(ball_scene.poses(16)[0])[1] > 0) > 0.88


@pytest.fixture
def window(monkeypatch):
    """As if viewports looked through `window.items`; `window.wait()` lives on until no photo is awaited any more."""
    window = SimpleNamespace(items=[], drawn=0)

    def wait(seconds: float = 20.0) -> None:
        end = time.monotonic() + seconds
        while photo_backgrounds._show_viewed() is not None:
            assert time.monotonic() < end
            time.sleep(0.01)

    def draw() -> None:
        window.drawn += 1

    window.wait = wait
    monkeypatch.setattr(photo_backgrounds, "has_window", lambda: True)
    monkeypatch.setattr(photo_backgrounds, "find_viewed_cameras", lambda: window.items)
    monkeypatch.setattr(photo_backgrounds, "redraw_viewports", draw)
    yield window
    photo_backgrounds.unregister_watch()
    assert photo_backgrounds._worker is None


def test_a_window_lives_on_while_a_photo_is_undistorted(bent_balls, window, monkeypatch):
    hold = threading.Event()
    write = photo_files._write_undistorted
    monkeypatch.setattr(photo_files, "_write_undistorted", lambda *given: hold.wait(20.0) and write(*given))
    first, second = window.items = find_owned_objects(bpy.context.scene, "camera")[:2]
    show_photo(first)
    assert is_awaited(first)
    assert background_of(first) is None
    for _ in range(5):
        photo_backgrounds._show_viewed()
    assert window.drawn == 1  # when the second began to be awaited
    window.items = [first]
    photo_backgrounds._show_viewed()
    assert not is_awaited(second)
    hold.set()
    window.wait()
    assert not is_awaited(first)
    assert background_of(first) is not None
    assert background_of(second) is None


def test_a_photo_that_cannot_be_undistorted_in_a_window_is_reported(bent_balls, window):
    item = find_owned_objects(bpy.context.scene, "camera")[0]
    data = Path(item[FILE]).read_bytes()
    Path(item[FILE]).write_bytes(data[: len(data) // 2])
    window.items = [item]
    window.wait()
    assert background_of(item) is None
    assert Path(item[FILE]).name in item[PROBLEM]


def test_fruit_are_where_the_photo_shows_them(shown, counted_balls):
    """Blender's camera and the engine's put every fruit's middle on the same pixel."""
    root = find_owned_object(shown, "root")
    for item, camera in zip(find_owned_objects(shown, "camera"), counted_balls.scene.cameras, strict=True):
        for fruit in counted_balls.fruit_count.fruits:
            x, y, _ = world_to_camera_view(shown, item, root.matrix_world @ Vector(fruit.center.tolist()))
            pixel, _ = camera.project(fruit.center)
            found = np.array([x * camera.width, (1.0 - y) * camera.height])
            np.testing.assert_allclose(found, pixel, atol=0.01)
