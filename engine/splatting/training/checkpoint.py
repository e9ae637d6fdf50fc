"""Checkpoints: one safetensors file with everything that the next training step depends on."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...config import TrainConfig, select_decisive
from ...errors import TrainingError
from ...scene.camera import Scene
from ...storage.files import read_tensors, write_tensors
from ..gaussians import PARAMETERS
from .densify import GradientStats
from .exposure import Exposures
from .parameters import CHANNELS, Parameters
from .poses import Poses

SCHEMA = 2
_PARTS: dict[str, Any] = {"exposures": Exposures, "poses": Poses}
"""Parts of a state that exist only if requested."""


@dataclass(eq=False)
class TrainingState:
    """Everything that changes during training. Random choices depend on (seed, step), so no generator is stored.

    exposures: the learnt colour maps of the photos; poses: the refined poses; None if not requested; checks: (step,
    held-out PSNR in dB) so far.
    """

    parameters: Parameters
    mean_gradients: GradientStats
    exposures: Exposures | None = None
    poses: Poses | None = None
    checks: list[tuple[int, float]] = field(default_factory=list)

    @property
    def step(self) -> int:
        """Steps done."""
        return self.parameters.step

    def select(self, index: torch.Tensor) -> None:
        """Keep the Gaussians at `index` (mask or integers)."""
        self.parameters.select(index)
        self.mean_gradients = GradientStats(self.mean_gradients.sums[index], self.mean_gradients.counts[index])


def training_key(scene: Scene, config: TrainConfig, extra: str = "") -> str:
    """Hash of what a checkpoint must agree with: settings, cameras, names of photos and sparse cloud.

    extra: a text that identifies the target of further channels; empty without any.
    """
    digest = hashlib.sha256((json.dumps(select_decisive(config), sort_keys=True) + extra).encode())
    for camera, photo in zip(scene.cameras, scene.images, strict=True):
        digest.update(f"{photo.name} {camera.width} {camera.height}".encode())
        digest.update(np.ascontiguousarray(camera.K, np.float64).tobytes())
        digest.update(np.ascontiguousarray(camera.world_to_camera, np.float64).tobytes())
    digest.update(np.ascontiguousarray(scene.points, np.float64).tobytes())
    return digest.hexdigest()


def write_checkpoint(path: Path, state: TrainingState, key: str) -> None:
    """Replace the checkpoint atomically.

    Raises:
        OutputError: the folder cannot be written.
    """
    parameters = state.parameters
    tensors = {
        "pulls.sums": state.mean_gradients.sums,
        "pulls.counts": state.mean_gradients.counts,
        "updates": parameters.updates,
    }
    for group in ("values", "first", "second"):
        tensors |= {f"{group}.{name}": tensor.contiguous() for name, tensor in getattr(parameters, group).items()}
    for part, kind in _PARTS.items():
        held = getattr(state, part)
        if held is not None:
            tensors |= {f"{part}.{entry.name}": torch.from_numpy(getattr(held, entry.name)) for entry in fields(kind)}
    about = {"schema": SCHEMA, "step": parameters.step, "key": key, "checks": state.checks}
    write_tensors(path, tensors, about)


def read_checkpoint(path: Path, key: str) -> TrainingState:
    """Read what `write_checkpoint` wrote.

    Raises:
        TrainingError: the file is damaged, or belongs to another scene or other settings.
    """
    try:
        tensors, about = read_tensors(path)
        if about["schema"] != SCHEMA or about["key"] != key:
            raise TrainingError(f"{path} belongs to another scene or other settings")
        names = [*PARAMETERS, *([CHANNELS] if f"values.{CHANNELS}" in tensors else [])]
        values, first, second = (
            {name: tensors[f"{group}.{name}"] for name in names} for group in ("values", "first", "second")
        )
        parameters = Parameters(values, first, second, tensors["updates"], step=int(about["step"]))
        mean_gradients = GradientStats(tensors["pulls.sums"], tensors["pulls.counts"])
        parts = {
            part: kind(**{entry.name: tensors.pop(f"{part}.{entry.name}").numpy() for entry in fields(kind)})
            for part, kind in _PARTS.items()
            if any(name.startswith(f"{part}.") for name in tensors)
        }
        checks = [(int(step), float(quality)) for step, quality in about["checks"]]
    except (KeyError, ValueError, TypeError) as error:
        raise TrainingError(f"{path} is not a complete checkpoint ({error}). Delete it to start again") from error
    if any(len(tensor) != len(parameters) for tensor in tensors.values()):
        raise TrainingError(f"{path} is not a complete checkpoint (tensors differ in length). Delete it to start again")
    return TrainingState(parameters, mean_gradients, **parts, checks=checks)
