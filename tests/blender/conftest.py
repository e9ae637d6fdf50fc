"""A fresh Blender file for every test, and small engine values to write into it."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

if importlib.util.find_spec("bpy") is None:  # pragma: no cover
    collect_ignore_glob = ["test_*.py"]

UP = np.array([0.0, -0.8, 0.6])
"""Not an axis, so that a forgotten or transposed rotation shows."""


@dataclass(frozen=True, eq=False)
class Counted:
    """The four values that every writer is given."""

    scene: Any
    gaussians: Any
    probability: Any
    fruit_count: Any

    def parts(self) -> tuple[Any, Any, Any, Any]:
        return self.scene, self.gaussians, self.probability, self.fruit_count


def make_scene(metres_per_unit: float | None = None) -> Any:
    """Six cameras with uneven intrinsics about (1, 2, 3), in a frame whose up is `UP`."""
    from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene

    middle, sideways = np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0])
    cameras = []
    for angle in np.arange(6) * np.pi / 3:
        outward = np.cos(angle) * sideways + np.sin(angle) * np.cross(UP, sideways)
        right = np.cross(UP, outward)
        rotation = np.stack([right, -UP, -outward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (middle + 4.0 * outward)
        cameras.append(Camera(np.array([[210.0, 0, 70.0], [0, 190.0, 41.0], [0, 0, 1]]), pose, 160, 90))
    photos = [ArrayPhoto(f"row/photo_{index}.jpg", np.zeros((90, 160, 3), np.uint8)) for index in range(6)]
    points = middle + np.random.default_rng(0).uniform(-1, 1, (200, 3))
    return Scene(cameras, photos, points, np.full((200, 3), 188, np.uint8), UP, metres_per_unit)


def make_counted(metres_per_unit: float | None = None, label: str = "apple", fruits: int = 3) -> Counted:
    """Twenty Gaussians, of which fruit k has the two 2k and 2k + 1."""
    import torch

    from fruitlangs.engine.counting.fruit import Fruit, FruitCount
    from fruitlangs.engine.splatting.gaussians import Gaussians

    generator = torch.Generator().manual_seed(1)
    gaussians = Gaussians(
        means=torch.rand(20, 3, generator=generator),
        log_scales=torch.rand(20, 3, generator=generator) - 4.0,
        quats=torch.randn(20, 4, generator=generator),
        opacity_logits=torch.randn(20, generator=generator),
        sh=torch.rand(20, 4, 3, generator=generator),
    )
    found = [
        Fruit(
            id=index + 1,
            label=label,
            center=np.array([1.0 + 0.3 * index, 2.0, 3.0]),
            diameter=0.1 * (index + 1),
            diameter_sd=0.01,
            volume=0.001,
            axes=0.05 * (index + 1) * np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.0, 0.0]]),
            probability=0.9,
            visible_fraction=None if index == 0 else 0.25,
            views=7,
            color=np.array([255, 51, 0], np.uint8),
            kind="single",
            members=np.array([2 * index, 2 * index + 1]),
        )
        for index in range(fruits)
    ]
    mean = 0.2 if found else None
    probability = torch.linspace(0, 1, 20)
    return Counted(make_scene(metres_per_unit), gaussians, probability, FruitCount(found, [], 0.97, mean))


def make_result(counted: Counted, out: Path, **changes: Any) -> Any:
    """What `count_scene` returns for these values."""
    from fruitlangs.engine.config import Config
    from fruitlangs.engine.publishing import Result

    training = {"steps": 9, "gaussians": 20, "psnr": 21.25, "ssim": 0.7}
    values = dict(zip(("scene", "gaussians", "probability", "fruit_count"), counted.parts(), strict=True))
    given = {
        "features": None,
        "origin": {"prompts": ["apple"], "negatives": [], "training": training},
        "config": Config(),
        "seconds": {},
        "reused": [],
        "notices": ["no pictures"],
        "out": out,
        "set_id": "f00",
    }
    return Result(**{**values, **given, **changes})


@pytest.fixture
def result_of() -> Callable[..., Any]:
    """`make_result`, for tests that need what a count returns."""
    return make_result


@pytest.fixture(autouse=True)
def empty_file() -> None:
    """Start every test from a file with nothing in it."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture
def counted() -> Counted:
    return make_counted()


@pytest.fixture
def counted_with() -> Callable[..., Counted]:
    """`make_counted`, for tests that choose its arguments."""
    return make_counted


@pytest.fixture
def extension() -> Iterator[Any]:
    """The extension, registered for the time of the test (a module left registered can hang at exit)."""
    import fruitlangs

    fruitlangs.register()
    try:
        yield fruitlangs
    finally:
        fruitlangs.unregister()
