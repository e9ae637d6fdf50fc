"""Memory of training."""

from __future__ import annotations

import resource
import sys

import numpy as np

from ...engine.config import TrainConfig
from ...engine.memory import training_bytes
from ...engine.scene.camera import ArrayPhoto, Scene
from ...engine.splatting.training.checkpoint import TrainingState
from ...engine.splatting.training.densify import GradientStats
from ...engine.splatting.training.parameters import Parameters
from ...engine.splatting.training.photos import PhotoShelf
from ...engine.splatting.training.schedule import Schedule
from ...engine.splatting.training.step import Step
from .step_times import SH_DEGREE, look_ahead, make_orchard_like


def peak_bytes() -> int:
    """The peak memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def training_peak(gaussians: int, views: int, width: int, height: int) -> tuple[int, int]:
    """Peak bytes of a training after one round and its three densifications, and the estimate of it.

    Call it in a separate process: the peak is that of the process.
    """
    camera = look_ahead(width, height)
    random = np.random.default_rng(0)
    photos = [
        ArrayPhoto(str(view), random.integers(0, 256, (height, width, 3), dtype=np.uint8)) for view in range(views)
    ]
    scene = Scene(
        cameras=[camera] * views, images=photos, points=np.zeros((1, 3)), colors=np.zeros((1, 3), np.uint8),
        up=np.array([0.0, -1.0, 0.0]),
    )  # fmt: skip
    config = TrainConfig(
        steps=views,
        max_gaussians=gaussians,
        sh_degree=SH_DEGREE,
        coarse_until=0.0,
        densify_every=max(views // 3, 1),
        densify_until=1.0,
    )
    start = make_orchard_like(gaussians)
    state = TrainingState(Parameters.start(start), GradientStats.none(gaussians))
    step, shelf = Step(Schedule(config, scene)), PhotoShelf(scene)
    for view in range(views):
        step.take(state, shelf.picture(view))
    shelf.close()
    return peak_bytes(), training_bytes(gaussians, SH_DEGREE, scene.cameras)
