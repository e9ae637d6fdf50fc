"""COLMAP models: layouts, formats, damage."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from colmap_models import ring_of_poses, write_model, write_photo
from PIL import Image

from fruitlangs.engine.config import SceneConfig
from fruitlangs.engine.errors import SceneError
from fruitlangs.engine.scene.formats.colmap import open_colmap, read_colmap

MODEL_FILES = ("cameras", "images", "points3D")


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("rigs", [True, False], ids=["rigs", "no rigs"])
def test_a_model_is_read_whole(tmp_path: Path, suffix: str, rigs: bool) -> None:
    write_model(tmp_path, suffix=suffix, rigs=rigs)
    scene = read_colmap(tmp_path)
    assert [photo.name for photo in scene.images] == [f"photo_{index}.png" for index in range(4)]
    for camera, pose in zip(scene.cameras, ring_of_poses(4), strict=True):
        np.testing.assert_allclose(camera.world_to_camera, pose, atol=1e-12)
        np.testing.assert_array_equal(camera.K, [[20, 0, 16], [0, 20, 12], [0, 0, 1]])
    np.testing.assert_array_equal(scene.points, [[index, 0.5, -1.0] for index in range(5)])
    np.testing.assert_array_equal(scene.colors, [[10 * index, 100, 200] for index in range(5)])
    np.testing.assert_allclose(scene.up, [0, 0, 1], atol=1e-9)
    np.testing.assert_array_equal(scene.images[2].pixels(), np.asarray(Image.open(tmp_path / "images/photo_2.png")))
    assert scene.metres_per_unit is None


@pytest.mark.parametrize("layout", ["sparse/0", "sparse", ".", "colmap/sparse/0", "colmap/sparse"])
def test_every_layout_is_found(tmp_path: Path, layout: str) -> None:
    write_model(tmp_path, layout=layout)
    assert len(read_colmap(tmp_path).cameras) == 4


def test_the_folder_of_the_model_itself_is_read(tmp_path: Path) -> None:
    folder = write_model(tmp_path, layout="colmap/sparse/0")
    assert len(read_colmap(folder).cameras) == 4


def test_binary_goes_before_text(tmp_path: Path) -> None:
    write_model(tmp_path, suffix=".txt", images=3)
    write_model(tmp_path, suffix=".bin", images=5)
    assert len(read_colmap(tmp_path).cameras) == 5


def test_the_largest_sub_model_is_taken_and_named(tmp_path: Path) -> None:
    write_model(tmp_path, layout="sparse/0", images=3)
    write_model(tmp_path, layout="sparse/1", images=5)
    write_model(tmp_path, layout="sparse/2", images=4)
    messages: list[str] = []
    assert len(read_colmap(tmp_path, progress=lambda _, message: messages.append(message)).cameras) == 5
    assert f"{tmp_path / 'sparse' / '1'} is the largest of 3 models (5 images)" in messages


def test_photos_are_in_name_order_and_may_lie_in_folders(tmp_path: Path) -> None:
    write_model(tmp_path, names=("row b/2.png", "row a/1.png", "row b/1.png"))
    assert [photo.name for photo in read_colmap(tmp_path).images] == ["row a/1.png", "row b/1.png", "row b/2.png"]


def test_cameras_follow_their_photos_into_name_order(tmp_path: Path) -> None:
    write_model(tmp_path, names=("c.png", "a.png", "b.png"))
    poses = ring_of_poses(3)
    for camera, pose in zip(read_colmap(tmp_path).cameras, (poses[1], poses[2], poses[0]), strict=True):
        np.testing.assert_allclose(camera.world_to_camera, pose, atol=1e-12)


def test_downscale_shrinks_photos_and_cameras(tmp_path: Path) -> None:
    write_model(tmp_path)
    scene = read_colmap(tmp_path, SceneConfig(downscale=2))
    assert scene.images[0].pixels().shape == (12, 16, 3)
    np.testing.assert_allclose(scene.cameras[0].K, [[10, 0, 8], [0, 10, 6], [0, 0, 1]])


def test_photos_in_another_folder_are_read_from_there(tmp_path: Path) -> None:
    write_model(tmp_path / "model")
    shutil.move(tmp_path / "model" / "images", tmp_path / "elsewhere")
    assert read_colmap(tmp_path / "model", images=tmp_path / "elsewhere").images[0].pixels().shape == (24, 32, 3)


@pytest.mark.parametrize("name", ["photo_1.png", "photo_1.png.png"])
def test_masks_next_to_the_photos_are_used(tmp_path: Path, name: str) -> None:
    write_model(tmp_path)
    (tmp_path / "masks").mkdir()
    Image.fromarray(np.repeat([[0, 255]], 24, axis=0).repeat(16, axis=1).astype(np.uint8)).save(
        tmp_path / "masks" / name
    )
    scene = read_colmap(tmp_path)
    mask = scene.images[1].mask()
    assert mask is not None
    assert mask[:, 16:].all()
    assert not mask[:, :16].any()
    assert scene.images[0].mask() is None


def test_a_masks_folder_without_masks_is_named(tmp_path: Path) -> None:
    write_model(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(SceneError, match="has no mask for any photo"):
        read_colmap(tmp_path, masks=tmp_path / "empty")


def test_a_missing_photo_is_left_out_with_its_image_and_mask(tmp_path: Path) -> None:
    write_model(tmp_path)
    whole = read_colmap(tmp_path)
    (tmp_path / "masks").mkdir()
    Image.new("L", (32, 24), 0).save(tmp_path / "masks" / "photo_3.png")
    (tmp_path / "images" / "photo_2.png").unlink()
    opened = open_colmap(tmp_path)
    scene = opened.scene(SceneConfig())
    assert [photo.name for photo in scene.images] == ["photo_0.png", "photo_1.png", "photo_3.png"]
    np.testing.assert_array_equal(scene.cameras[2].world_to_camera, whole.cameras[3].world_to_camera)
    assert opened.masks == [None, None, tmp_path / "masks" / "photo_3.png"]
    assert opened.notices == ["1 of the 4 photos that images.bin lists are missing and were left out: photo_2.png"]


@pytest.mark.parametrize(("listed", "gone"), [(4, 2), (8, 5)])
def test_too_few_photos_of_a_model_are_an_error_that_names_the_first_missing(
    tmp_path: Path, listed: int, gone: int
) -> None:
    write_model(tmp_path, images=listed)
    for index in range(gone):
        (tmp_path / "images" / f"photo_{index}.png").unlink()
    said = rf"{gone} of the {listed} photos that .*images\.bin lists are missing, first {tmp_path}/images/photo_0\.png"
    with pytest.raises(SceneError, match=said):
        read_colmap(tmp_path)


def test_missing_photos_are_all_reported_missing(tmp_path: Path) -> None:
    write_model(tmp_path)
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(SceneError, match="No folder images next to"):
        read_colmap(tmp_path)
    write_photo(tmp_path / "images" / "other.png", 32, 24)
    with pytest.raises(SceneError, match=r"None of the 4 photos that .* lists was found"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("stem", [*MODEL_FILES, "rigs", "frames"])
@pytest.mark.parametrize("kept", [0, 4, 8, -20, -9, -1])
def test_a_file_cut_short_is_named_with_its_bytes(tmp_path: Path, stem: str, kept: int) -> None:
    path = write_model(tmp_path) / f"{stem}.bin"
    content = path.read_bytes()
    path.write_bytes(content[:kept])
    with pytest.raises(
        SceneError, match=rf"{stem}\.bin is cut short: it has {len(content[:kept])} bytes .*at least \d"
    ):
        read_colmap(tmp_path)


@pytest.mark.parametrize("stem", [*MODEL_FILES, "rigs", "frames"])
def test_bytes_after_the_last_record_are_named(tmp_path: Path, stem: str) -> None:
    path = write_model(tmp_path) / f"{stem}.bin"
    size = path.stat().st_size
    path.write_bytes(path.read_bytes() + b"\0" * 3)
    with pytest.raises(SceneError, match=rf"{stem}\.bin has {size + 3} bytes but its \d records end at byte {size}\."):
        read_colmap(tmp_path)


def test_an_unknown_camera_model_is_named(tmp_path: Path) -> None:
    path = write_model(tmp_path) / "cameras.bin"
    content = bytearray(path.read_bytes())
    content[12:16] = struct.pack("<i", 99)
    path.write_bytes(bytes(content))
    with pytest.raises(SceneError, match=r"camera 1 has the camera model 99. Known are SIMPLE_PINHOLE"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("stem", "line", "said"),
    [
        ("cameras", "1 PINHOLE 32 24 20 20 16", "line 4: PINHOLE takes 4 parameters, found 3"),
        ("cameras", "1 PINHOLE 32 24 20 20 16 twelve", "line 4: 'twelve' is not a number"),
        ("cameras", "1 TELESCOPE 32 24 20", "line 4 has the camera model 'TELESCOPE'"),
        ("images", "1 1 0 0 0 0 0 3", "line 5: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"),
        ("images", "1 1 0 0 0 0 0 1,5 1 photo_0.png", "line 5: '1,5' is not a number"),
        ("points3D", "1 0 0 0 255 255", "line 4: expected POINT3D_ID"),
        ("points3D", "1 0 0 0 255 255 25.5 1.0", "line 4: '25.5' is not a whole number"),
    ],
)
def test_a_malformed_text_line_is_named(tmp_path: Path, stem: str, line: str, said: str) -> None:
    path = write_model(tmp_path, suffix=".txt") / f"{stem}.txt"
    lines = path.read_text().splitlines()
    first = next(index for index, text in enumerate(lines) if not text.startswith("#"))
    lines[first] = line
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(SceneError, match=said.replace("'", ".")):
        read_colmap(tmp_path)


def test_a_text_file_cut_inside_a_line_is_named(tmp_path: Path) -> None:
    path = write_model(tmp_path, suffix=".txt") / "images.txt"
    text = path.read_text().rstrip("\n")
    path.write_text(text[: text.rindex("\n") + 1])
    with pytest.raises(SceneError, match=r"images\.txt, line 11: the line of its 2D points is missing"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("stem", ["cameras", "images"])
def test_an_empty_model_is_named(tmp_path: Path, suffix: str, stem: str) -> None:
    path = write_model(tmp_path, suffix=suffix) / f"{stem}{suffix}"
    path.write_bytes(bytes(8) if suffix == ".bin" else b"# nothing\n")
    with pytest.raises(SceneError, match=rf"{stem}\{suffix} is empty \(0 {stem}\)"):
        read_colmap(tmp_path)


def test_a_model_without_points_is_a_scene_without_points(tmp_path: Path) -> None:
    write_model(tmp_path, points=0)
    scene = read_colmap(tmp_path)
    assert scene.points.shape == (0, 3)
    assert scene.colors.shape == (0, 3)


@pytest.mark.parametrize("stem", MODEL_FILES)
def test_a_model_that_lacks_a_file_is_named(tmp_path: Path, stem: str) -> None:
    path = write_model(tmp_path) / f"{stem}.bin"
    path.unlink()
    with pytest.raises(SceneError, match=rf"{stem}\.bin is missing"):
        read_colmap(tmp_path)


def overwrite(path: Path, at: int, values: list[float]) -> None:
    content = bytearray(path.read_bytes())
    content[at : at + 8 * len(values)] = struct.pack(f"<{len(values)}d", *values)
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("rotation", [[np.nan] * 4, [0.0] * 4, [np.inf, 0.0, 0.0, 0.0]])
@pytest.mark.parametrize(("stem", "at"), [("images", 12), ("frames", 16)])
def test_a_pose_without_rotation_is_named(tmp_path: Path, stem: str, at: int, rotation: list[float]) -> None:
    overwrite(write_model(tmp_path) / f"{stem}.bin", at, rotation)
    with pytest.raises(SceneError, match=rf"{stem}\.bin: .* has the quaternion"):
        read_colmap(tmp_path)


def test_a_text_pose_without_rotation_is_named(tmp_path: Path) -> None:
    path = write_model(tmp_path, suffix=".txt") / "images.txt"
    path.write_text(path.read_text().replace("\n1 ", "\n1 0 0 0 0 0 0 1 1 photo_0.png\n\n9 ", 1))
    with pytest.raises(SceneError, match=r"images\.txt: line 5, the image has the quaternion"):
        read_colmap(tmp_path)


def test_a_position_that_is_not_finite_is_named(tmp_path: Path) -> None:
    overwrite(write_model(tmp_path, rigs=False) / "images.bin", 44, [np.nan])
    with pytest.raises(SceneError, match=r"pose of photo_0\.png"):
        read_colmap(tmp_path)


def test_a_lens_without_focal_length_is_named(tmp_path: Path) -> None:
    overwrite(write_model(tmp_path) / "cameras.bin", 32, [0.0])
    with pytest.raises(SceneError, match=r"Camera 1 in .*cameras\.bin: .*focal length"):
        read_colmap(tmp_path)


def test_points_that_are_not_finite_are_left_out_and_reported(tmp_path: Path) -> None:
    overwrite(write_model(tmp_path) / "points3D.bin", 16, [np.nan])
    messages: list[str] = []
    scene = read_colmap(tmp_path, progress=lambda _, message: messages.append(message))
    assert len(scene.points) == len(scene.colors) == 4
    assert np.isfinite(scene.points).all()
    assert messages[-1] == "left out 1 of 5 points that are not finite"


def test_a_distorted_model_is_undistorted_and_masked(tmp_path: Path) -> None:
    write_model(tmp_path, model="OPENCV", params=(20.0, 20.0, 16.0, 12.0, 0.2, 0.1, 0.0, 0.0))
    scene = read_colmap(tmp_path)
    mask = scene.images[0].mask()
    assert scene.cameras[0].distortion is None
    assert mask is not None
    assert not mask[0, 0]
    assert mask[12, 16]


def test_a_million_points_are_checked_in_one_pass(tmp_path: Path) -> None:
    # the walk is linear: were it not, this would not end
    folder = write_model(tmp_path, points=0)
    record = np.zeros(1_000_000, dtype=[("id", "<u8"), ("rest", "u1", 35), ("track", "<u8")])
    record["id"] = np.arange(1, 1_000_001)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 1_000_000) + record.tobytes()[:-1])
    with pytest.raises(SceneError, match="cut short"):
        read_colmap(tmp_path)


def test_reading_a_model_leaves_sigterm_to_the_program() -> None:
    script = f"""
import os, signal, sys
sys.path.insert(0, {str(Path(__file__).resolve().parents[3] / "scripts")!r})
import _checkout
from fruitlangs.engine.scene.pycolmap_import import colmap_library
signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))
colmap_library()
os.kill(os.getpid(), signal.SIGTERM)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 130
    assert done.stderr == ""
