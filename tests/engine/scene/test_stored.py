from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fruitlangs.engine.errors import FormatError, OutputError
from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene
from fruitlangs.engine.scene.formats.cameras_json import dump_cameras, read_cameras
from fruitlangs.engine.storage.files import write_text


def one_view() -> Scene:
    pose = np.eye(4)
    pose[:3, 3] = [0.1, 1 / 3, 2.0]
    return Scene(
        cameras=[
            Camera(K=np.array([[500.0, 0, 160], [0, 501, 120], [0, 0, 1]]), world_to_camera=pose, width=320, height=240)
        ],
        images=[ArrayPhoto("a.jpg", np.zeros((240, 320, 3), np.uint8))],
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        up=np.array([0.0, -1.0, 0.0]),
    )


def test_cameras_come_back_exactly(tmp_path: Path) -> None:
    write_text(tmp_path / "cameras.json", dump_cameras(one_view()))
    camera, original = read_cameras(tmp_path / "cameras.json").cameras[0], one_view().cameras[0]
    assert np.array_equal(camera.K, original.K)
    assert np.array_equal(camera.world_to_camera, original.world_to_camera)
    assert (camera.width, camera.height) == (320, 240)


def test_missing_cameras_say_what_to_give_instead(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="photos"):
        read_cameras(tmp_path / "cameras.json")


def test_damaged_cameras_are_an_error(tmp_path: Path) -> None:
    write_text(tmp_path / "cameras.json", dump_cameras(one_view()).replace('"K"', '"Q"'))
    with pytest.raises(FormatError):
        read_cameras(tmp_path / "cameras.json")
