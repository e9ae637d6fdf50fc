"""The value of each part of the trainer: the standard training with one part changed at a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray

from ...engine.config import SceneConfig, TrainConfig
from ...engine.progress import Progress, part, silent
from ...engine.scene.read import read_scene
from ...engine.splatting.rendering.rasterize import measure_load
from ...engine.splatting.training.losses import PhotometricLoss
from ...engine.splatting.training.parameters import Parameters, Rates
from ...engine.splatting.training.schedule import Schedule
from ...engine.splatting.training.train import choose_held_out, train
from . import plain_rasterizer

DENSE_ADAM = "Adam over all Gaussians"
AUTOGRAD_LOSS = "loss by PyTorch's autograd"
VARIANTS: dict[str, dict[str, Any]] = {
    "standard": {},
    "eq. 3: τ = 4/255": {"pair_alpha": 4.0},
    "eq. 3: τ = 16/255": {"pair_alpha": 16.0},
    "eq. 3 as printed": {"literal_pairs": True},
    "eq. 3: Gaussians below 1 px dropped": {"drop_unneeded": 1.0},
    "eq. 4: λ = 0.02": {"load_weight": 0.02},
    "eq. 4: λ = 0.1": {"load_weight": 0.1},
    "eq. 4: AdR-Gaussian's λ = 0.41": {"load_weight": 0.41},
    "full size from the start": {"coarse_until": 0.0},
    AUTOGRAD_LOSS: {},
    DENSE_ADAM: {},
    "exposure": {"exposure": True},
    "antialiased": {"antialiased": True},
    "worst 5 % of pixels forgiven": {"forgive": 0.05},
    "MCMC": {"densify": "mcmc", "opacity_weight": 0.01, "scale_weight": 0.01},
    "no densification": {"densify_until": 0.0},
}
"""What is changed, by the name of its row."""


@dataclass(frozen=True)
class Ablation:
    """One training: its seconds, and those of all processors together, which depend less on other programs; held-out
    PSNR in dB and SSIM, final number of Gaussians; load: Gaussians that a pixel blends (the paper's ℓ) in held-out
    photos, and unevenness: the standard deviation of that over its mean, which eq. 4 lowers."""

    name: str
    seconds: float
    cpu_seconds: float
    psnr: float
    ssim: float
    gaussians: int
    load: float
    unevenness: float


def ablate(
    scene_folder: Path,
    config: TrainConfig,
    *,
    names: Sequence[str] = (),
    scene_config: SceneConfig | None = None,
    progress: Progress = silent,
) -> list[Ablation]:
    """Train once for every variant (or those named), in one process, after a short training that compiles."""
    scene = read_scene(scene_folder, scene_config or SceneConfig())
    train(scene, replace(config, steps=3, densify_until=0.0))
    chosen = {name: change for name, change in VARIANTS.items() if not names or name in names}
    rows = []
    for k, (name, change) in enumerate(chosen.items()):
        share = part(progress, k / len(chosen), (k + 1) / len(chosen))
        with patch.object(*_REPLACED[name]) if name in _REPLACED else nullcontext():
            begun, cpu_begun = time.perf_counter(), time.process_time()
            training = train(scene, replace(config, **change), progress=_prefix_messages(share, name))
            seconds, cpu = time.perf_counter() - begun, time.process_time() - cpu_begun
        rules = Schedule(replace(config, **change), scene).rules(config.steps)
        aside = [training.cameras[view] for view in sorted(choose_held_out(scene, config.holdout_every))]
        loads = [measure_load(training.gaussians, camera, rules).pixels for camera in aside]
        rows.append(
            Ablation(
                name, seconds, cpu, training.psnr or 0.0, training.ssim or 0.0, len(training.gaussians),
                float(np.mean(loads)), float(np.mean([load.std() / load.mean() for load in loads])),
            )
        )  # fmt: skip
    return rows


def _prefix_messages(progress: Progress, name: str) -> Progress:
    return lambda fraction, message: progress(fraction, f"{name}: {message}")


_sparse_update, _fused_backward = Parameters.update, PhotometricLoss.backward


def _update_all(
    parameters: Parameters,
    gradients: Mapping[str, NDArray[np.float32]],
    rates: Rates,
    sh_degree: int,
    drawn: NDArray[np.int32],
) -> None:
    """Update all Gaussians at every step, those out of view by their momentum."""
    for name in parameters.values:
        gradients[name][drawn == 0] = 0.0
    _sparse_update(parameters, gradients, rates, sh_degree, np.ones_like(drawn))


def _backward_by_autograd(
    loss: PhotometricLoss,
    image: NDArray[np.float32],
    photo: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
    gradient: NDArray[np.float32],
    *,
    key: Hashable | None = None,
) -> float:
    """The loss and its gradient as in the baseline, without a mask: SSIM computed by convolutions and autograd."""
    if mask is not None:
        return _fused_backward(loss, image, photo, mask, gradient, key=key)
    color = torch.from_numpy(image).permute(1, 2, 0).clone().requires_grad_()
    truth = torch.from_numpy(np.ascontiguousarray(photo)).float() / 255
    value = plain_rasterizer.loss(color, truth, loss.ssim_weight)
    value.backward()  # type: ignore[no-untyped-call]
    assert color.grad is not None
    gradient[:] = color.grad.permute(2, 0, 1).numpy()
    return float(value.detach())


_REPLACED: dict[str, tuple[type, str, Callable[..., Any]]] = {
    DENSE_ADAM: (Parameters, "update", _update_all),
    AUTOGRAD_LOSS: (PhotometricLoss, "backward", _backward_by_autograd),
}
"""The variants that are not settings: the method that each of them replaces, and its replacement."""
