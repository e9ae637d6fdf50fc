"""Training interrupted and taken up again: one safetensors file with everything that the next step depends on."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ..config import TrainConfig
from ..errors import TrainingError
from ..files import replacing
from ..scene.camera import Scene
from .densify import Pulls
from .parameters import NAMES, Parameters

SCHEMA = 1


@dataclass(eq=False)
class TrainingState:
    """Everything that changes while training. Random choices are drawn from (seed, step), so no generator is kept."""

    parameters: Parameters
    pulls: Pulls

    @property
    def step(self) -> int:
        """Steps done."""
        return self.parameters.step


def training_key(scene: Scene, config: TrainConfig) -> str:
    """Hash of what a checkpoint must agree with: the settings, the cameras, the photos' names and the sparse cloud."""
    digest = hashlib.sha256(json.dumps(asdict(config), sort_keys=True).encode())
    for camera, photo in zip(scene.cameras, scene.images, strict=True):
        digest.update(f"{photo.name} {camera.width} {camera.height}".encode())
        digest.update(np.ascontiguousarray(camera.K, np.float64).tobytes())
        digest.update(np.ascontiguousarray(camera.world_to_camera, np.float64).tobytes())
    digest.update(np.ascontiguousarray(scene.points, np.float64).tobytes())
    return digest.hexdigest()


def write_checkpoint(path: Path, state: TrainingState, key: str) -> None:
    """Put the state in place of the earlier one, which stays readable until then.

    Raises:
        OutputError: the folder cannot be written.
    """
    parameters = state.parameters
    tensors = {"pulls.sums": state.pulls.sums, "pulls.counts": state.pulls.counts}
    for group in ("values", "first", "second"):
        tensors |= {f"{group}.{name}": getattr(parameters, group)[name].contiguous() for name in NAMES}
    about = {"schema": SCHEMA, "step": parameters.step, "key": key}
    with replacing(path) as temporary:
        save_file(tensors, str(temporary), metadata={"fruitlangs": json.dumps(about)})


def read_checkpoint(path: Path, key: str) -> TrainingState:
    """Read what `write_checkpoint` wrote.

    Raises:
        TrainingError: the file is damaged, or belongs to another scene or other settings.
    """
    try:
        with safe_open(str(path), framework="pt") as file:
            about = json.loads((file.metadata() or {})["fruitlangs"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        if about["schema"] != SCHEMA or about["key"] != key:
            raise TrainingError(f"{path} belongs to another scene or other settings")
        values, first, second = (
            {name: tensors[f"{group}.{name}"] for name in NAMES} for group in ("values", "first", "second")
        )
        parameters = Parameters(values, first, second, step=int(about["step"]))
        pulls = Pulls(tensors["pulls.sums"], tensors["pulls.counts"])
    except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
        raise TrainingError(f"{path} is not a whole checkpoint ({error}); delete it to start anew") from error
    if any(len(tensor) != len(parameters) for tensor in tensors.values()):
        raise TrainingError(f"{path} is not a whole checkpoint (tensors differ in length); delete it to start anew")
    if any(not torch.isfinite(tensor).all() for tensor in parameters.values.values()):
        raise TrainingError(f"{path} holds numbers that are not finite; delete it to start anew")
    return TrainingState(parameters, pulls)
