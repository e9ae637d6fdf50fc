"""The one door: what is read, what is refused, what a scene's hash depends on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from colmap_models import ring_of_poses, write_model, write_photo

from fruitlangs.engine.config import SceneConfig
from fruitlangs.engine.errors import SceneError
from fruitlangs.engine.scene.formats.transforms import find_named_files, read_transforms
from fruitlangs.engine.scene.read import open_scene, read_scene
from fruitlangs.engine.scene.source import Source
from fruitlangs.engine.storage.files import files_hash


def write_transforms(folder: Path, photos: int = 3, **values: object) -> Path:
    """A transforms.json of 32x24 photos of the ring, with OpenGL axes; `values` go to its top level."""
    frames = []
    for index, pose in enumerate(ring_of_poses(photos)):
        write_photo(folder / "images" / f"{index}.png", 32, 24, seed=index)
        camera_to_world = np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"./images/{index}.png", "transform_matrix": camera_to_world.tolist()})
    intrinsics = {"fl_x": 20.0, "fl_y": 21.0, "cx": 16.0, "cy": 12.0, "w": 32, "h": 24}
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames, **values}))
    return folder / "transforms.json"


def edit(file: Path, **values: object) -> None:
    """Set top-level values; None takes one out."""
    content = {**json.loads(file.read_text()), **values}
    file.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))


def edit_frame(file: Path, index: int, **values: object) -> None:
    frames = json.loads(file.read_text())["frames"]
    frames[index] = {key: value for key, value in {**frames[index], **values}.items() if value is not None}
    edit(file, frames=frames)


@pytest.mark.parametrize("by", ["folder", "file"])
def test_transforms_are_turned_to_our_axes(tmp_path: Path, by: str) -> None:
    file = write_transforms(tmp_path)
    scene = read_scene(tmp_path if by == "folder" else file)
    assert [photo.name for photo in scene.images] == ["images/0.png", "images/1.png", "images/2.png"]
    for camera, pose in zip(scene.cameras, ring_of_poses(3), strict=True):
        np.testing.assert_allclose(camera.world_to_camera, pose, atol=1e-12)
        np.testing.assert_array_equal(camera.K, [[20, 0, 16], [0, 21, 12], [0, 0, 1]])
    np.testing.assert_allclose(scene.up, [0, 0, 1], atol=1e-9)
    assert scene.points.shape == (0, 3)


def test_a_frame_has_its_own_intrinsics_before_the_files(tmp_path: Path) -> None:
    edit_frame(write_transforms(tmp_path), 1, fl_x=40.0)
    assert [camera.K[0, 0] for camera in read_scene(tmp_path).cameras] == [20, 40, 20]


def test_intrinsics_may_be_one_angle(tmp_path: Path) -> None:
    file = write_transforms(tmp_path, camera_angle_x=np.pi / 2)
    edit(file, fl_x=None, fl_y=None, cx=None, cy=None, w=None, h=None)
    np.testing.assert_allclose(read_scene(tmp_path).cameras[0].K, [[16, 0, 16], [0, 16, 12], [0, 0, 1]])


def test_intrinsics_may_be_an_angle_for_each_axis(tmp_path: Path) -> None:
    file = write_transforms(tmp_path, camera_angle_x=np.pi / 2, camera_angle_y=2.0 * np.arctan(0.5))
    edit(file, fl_x=None, fl_y=None, cx=None, cy=None, w=None, h=None)
    np.testing.assert_allclose(read_scene(tmp_path).cameras[0].K, [[16, 0, 16], [0, 24, 12], [0, 0, 1]])


def test_photos_may_lack_their_extension(tmp_path: Path) -> None:
    file = write_transforms(tmp_path)
    edit_frame(file, 0, file_path="images/0")
    assert read_scene(tmp_path).images[0].pixels().shape == (24, 32, 3)


def test_transforms_with_distortion_are_undistorted(tmp_path: Path) -> None:
    write_transforms(tmp_path, k1=0.2, k2=0.1, p1=0.0, p2=0.0)
    mask = read_scene(tmp_path).images[0].mask()
    assert mask is not None
    assert not mask[0, 0]


def test_points_of_transforms_come_from_their_ply(tmp_path: Path) -> None:
    write_transforms(tmp_path, ply_file_path="points.ply")
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    colors = "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    (tmp_path / "points.ply").write_text(header + colors + "1 2 3 10 20 30\n4 5 6 40 50 60\n")
    scene = read_scene(tmp_path)
    np.testing.assert_array_equal(scene.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(scene.colors, [[10, 20, 30], [40, 50, 60]])


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"frames": []}, "has no frames"),
        ({"fl_x": "wide"}, "fl_x is 'wide', not a number"),
        ({"fl_x": None}, "neither fl_x nor camera_angle_x"),
        ({"camera_model": "TELESCOPE"}, "camera_model 'TELESCOPE'"),
        ({"ply_file_path": "gone.ply"}, r"gone\.ply cannot be found"),
        ({"w": 40}, "another shape"),
    ],
)
def test_bad_transforms_are_named(tmp_path: Path, values: dict[str, object], said: str) -> None:
    edit(write_transforms(tmp_path), **values)
    with pytest.raises(SceneError, match=said):
        read_transforms(tmp_path)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"file_path": None}, "frame 1 has no file_path"),
        ({"file_path": "images/gone.png"}, r"1 of the 3 photos .* are missing, first .*gone\.png\. At least 3 photos"),
        ({"transform_matrix": None}, "no transform_matrix"),
        ({"transform_matrix": [[1, 0], [0, 1]]}, "no transform_matrix"),
        ({"transform_matrix": (np.eye(4) * 2).tolist()}, "not a rigid motion"),
        ({"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}, "not a rigid motion"),
    ],
)
def test_a_bad_frame_is_named(tmp_path: Path, values: dict[str, object], said: str) -> None:
    edit_frame(write_transforms(tmp_path), 1, **values)
    with pytest.raises(SceneError, match=said):
        read_transforms(tmp_path)


def test_photos_that_a_transforms_json_lists_but_that_are_missing_are_left_out_with_one_note(tmp_path: Path) -> None:
    file = write_transforms(tmp_path, photos=8)
    for index in range(8):
        (tmp_path / "images" / f"{index}.png").rename(tmp_path / "images" / f"{7 - index}.jpg")
        edit_frame(file, index, file_path=f"images/{index}", fruit=f"images/{index}.jpg")
    (tmp_path / "images" / "0.jpg").unlink()
    (tmp_path / "images" / "5.jpg").unlink()
    source = Source(path=tmp_path)
    scene = source.read(SceneConfig())
    assert [photo.name for photo in scene.images] == [f"images/{index}" for index in (1, 2, 3, 4, 6, 7)]
    np.testing.assert_allclose(scene.cameras[4].world_to_camera, ring_of_poses(8)[6], atol=1e-12)
    assert find_named_files(file, "fruit") == [tmp_path / "images" / f"{index}.jpg" for index in (1, 2, 3, 4, 6, 7)]
    assert source.open().notices == ["2 of the 8 photos that transforms.json lists are missing and were left out: 0, 5"]
    assert len(source.hash()) == 64


def test_a_long_list_of_missing_photos_is_cut(tmp_path: Path) -> None:
    write_transforms(tmp_path, photos=24)
    for index in range(12):
        (tmp_path / "images" / f"{index}.png").unlink()
    (notice,) = open_scene(tmp_path).notices
    assert notice.startswith("12 of the 24 photos")
    assert notice.endswith("7.png and 2 more")


@pytest.mark.parametrize(("listed", "gone"), [(3, 1), (9, 5)])
def test_a_transforms_json_with_too_few_of_its_photos_is_an_error(tmp_path: Path, listed: int, gone: int) -> None:
    write_transforms(tmp_path, photos=listed)
    for index in range(gone):
        (tmp_path / "images" / f"{index}.png").unlink()
    with pytest.raises(SceneError, match=rf"{gone} of the {listed} photos that .*transforms\.json lists are missing"):
        read_transforms(tmp_path)


def test_the_hash_of_a_scene_covers_the_photos_that_are_there(tmp_path: Path) -> None:
    write_transforms(tmp_path, photos=8)
    photo = tmp_path / "images" / "3.png"
    content = photo.read_bytes()
    whole = Source(path=tmp_path).hash()
    photo.unlink()
    assert Source(path=tmp_path).hash() != whole
    photo.write_bytes(content)
    assert Source(path=tmp_path).hash() == whole


def test_broken_json_is_named(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text('{"frames": [')
    with pytest.raises(SceneError, match=r"transforms\.json is not JSON"):
        read_scene(tmp_path)


def test_a_model_goes_before_transforms(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    write_model(tmp_path, images=4)
    assert len(read_scene(tmp_path).cameras) == 4


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("gone", "does not exist"),
        ("walk.MP4", "is a video"),
        ("tree.ply", "is a point cloud or splat"),
        ("one.jpg", "is a single photo"),
        ("notes.txt", "is a file, not a folder"),
        ("photos", "has 2 photos but no model"),
        ("empty", "holds no model in sparse/0"),
    ],
)
def test_what_is_no_scene_is_named_with_what_is_read(tmp_path: Path, name: str, said: str) -> None:
    for index in range(2):
        write_photo(tmp_path / "photos" / f"{index}.png", 32, 24)
    (tmp_path / "empty").mkdir()
    for file in ("walk.MP4", "tree.ply", "one.jpg", "notes.txt"):
        (tmp_path / file).touch()
    with pytest.raises(SceneError, match=rf"{said}.*a COLMAP model's folder.*an earlier result's folder"):
        read_scene(tmp_path / name)


def test_the_hash_stays_when_the_folder_moves(tmp_path: Path) -> None:
    write_model(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    assert Source(path=tmp_path / "a").hash() == Source(path=tmp_path / "b").hash()


@pytest.mark.parametrize("write", [write_model, write_transforms])
def test_the_hash_is_the_same_however_the_scene_is_spelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path], object]
) -> None:
    write(tmp_path / "scene")
    (tmp_path / "link").symlink_to(tmp_path / "scene")
    monkeypatch.chdir(tmp_path)
    spelled = (tmp_path / "scene", Path("scene"), Path("scene/../scene"), Path("link"))
    assert len({Source(path=path).hash() for path in spelled}) == 1


def test_a_transforms_file_hashes_as_its_folder(tmp_path: Path) -> None:
    assert Source(path=write_transforms(tmp_path)).hash() == Source(path=tmp_path).hash()


def test_photos_outside_the_scenes_folder_are_hashed_with_their_subfolder(tmp_path: Path) -> None:
    file = write_transforms(tmp_path / "photos")
    hashes = []
    for name in ("east", "west"):
        shutil.copytree(tmp_path / "photos" / "images", tmp_path / name)
        for index in range(3):
            edit_frame(file, index, file_path=f"../{name}/{index}.png")
        photos = open_scene(tmp_path / "photos").files()[1:]
        hashes.append(files_hash(photos, tmp_path / "photos"))
    assert hashes[0] != hashes[1]


@pytest.mark.parametrize("file", ["images/photo_3.png", "sparse/0/points3D.bin", "masks/photo_0.png"])
def test_the_hash_follows_every_file_that_is_read(tmp_path: Path, file: str) -> None:
    write_model(tmp_path)
    before = Source(path=tmp_path).hash()
    if file.endswith(".bin"):
        content = bytearray((tmp_path / file).read_bytes())
        content[16] ^= 1
        (tmp_path / file).write_bytes(bytes(content))
    else:
        write_photo(tmp_path / file, 32, 24, seed=99)
    assert Source(path=tmp_path).hash() != before


def test_the_hash_ignores_files_that_are_not_read(tmp_path: Path) -> None:
    write_model(tmp_path)
    before = Source(path=tmp_path).hash()
    write_photo(tmp_path / "images" / "unposed.png", 32, 24)
    (tmp_path / "truth.json").touch()
    assert Source(path=tmp_path).hash() == before


def test_transforms_are_hashed_with_their_photos(tmp_path: Path) -> None:
    file = write_transforms(tmp_path)
    assert open_scene(tmp_path).files() == [file, *(tmp_path / "images" / f"{index}.png" for index in range(3))]
