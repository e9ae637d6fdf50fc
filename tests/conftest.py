"""Tests run from a bare checkout: the package is importable as `fruitlangs` without an install."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
import trimesh
from PIL import Image

TESTS = Path(__file__).resolve().parent
SCRIPTS = TESTS.parent / "scripts"
sys.path[:0] = [str(folder) for folder in (SCRIPTS, SCRIPTS / "developer", SCRIPTS / "checks", TESTS, TESTS / "engine")]

import _checkout  # noqa: F401

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
"""Two processes of tests have two threads each: those that wait must not take the cores from the others."""
os.environ["FRUITLANGS_WORDS"] = tempfile.mkdtemp(prefix="fruitlangs-words-")
"""No word that the user taught takes part in tests."""
hypothesis.settings.register_profile("same on any computer", deadline=None, derandomize=True)
hypothesis.settings.load_profile("same on any computer")
STATUS = pytest.StashKey[int]()
SAMPLE = Path(__file__).resolve().parents[1] / "examples" / "orchard_tree"


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    session.config.stash[STATUS] = int(exitstatus)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """End a process that loaded Blender at once: its clean-up at exit sometimes waits forever."""
    if "bpy" in sys.modules and STATUS in config.stash:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(config.stash[STATUS])


@pytest.fixture(scope="session")
def adapter() -> Any:
    """Any graphics card that this computer has, also one that a program plays (Mesa's lavapipe)."""
    from fruitlangs.engine.errors import GpuError
    from fruitlangs.engine.splatting.gpu.adapters import find_adapters

    leave = pytest.fail if os.environ.get("FRUITLANGS_TEST_CARD") else pytest.skip
    try:
        found = [each for each in find_adapters() if not each.missing]
    except GpuError as error:
        leave(str(error))
    if not found:
        leave("no graphics card; Debian's package mesa-vulkan-drivers plays one")
    return found[0]


@pytest.fixture(scope="session")
def balls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos, cameras and truth of five red balls over ground: trained and counted in seconds."""
    import ball_scene

    return ball_scene.write_scene(tmp_path_factory.mktemp("balls") / "balls")


@pytest.fixture(scope="session")
def counted_balls(balls: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The balls' result, counted as apples by `balls_config`."""
    from fruitlangs.engine.pipeline import count_scene

    out = tmp_path_factory.mktemp("counted") / "out"
    return count_scene(balls, ["apple"], out, config=balls_config())


def balls_config() -> Any:
    """Settings that count the balls in seconds."""
    from fruitlangs.engine.config import Config, CountConfig, TrainConfig

    return Config(train=TrainConfig(steps=150, max_gaussians=3000), count=CountConfig(threshold=0.3))


@pytest.fixture(scope="session")
def few_photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight small photos of the sample with a transforms.json: a real scene that is trained and counted in seconds."""
    from fruitlangs.engine.scene.read import read_scene

    folder = tmp_path_factory.mktemp("few") / "photos"
    folder.mkdir()
    sample = read_scene(SAMPLE)
    frames = []
    for camera, photo in list(zip(sample.cameras, sample.images, strict=True))[::8]:
        Image.fromarray(photo.pixels()).resize((camera.width // 4, camera.height // 4)).save(folder / photo.name)
        pose = np.linalg.inv(camera.world_to_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
        lens = {"fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2]}
        size = {"w": camera.width // 4, "h": camera.height // 4}
        intrinsics = {name: value / 4 for name, value in lens.items()}
        frames.append({"file_path": photo.name, "transform_matrix": pose.tolist(), **intrinsics, **size})
    trimesh.PointCloud(sample.points[:2000], sample.colors[:2000]).export(folder / "points.ply")
    (folder / "transforms.json").write_text(json.dumps({"frames": frames, "ply_file_path": "points.ply"}))
    return folder
