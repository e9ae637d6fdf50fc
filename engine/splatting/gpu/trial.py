"""The first use of a graphics card, in a process of its own: a driver that our kernels crash ends that process only."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ...child_process import ChildError, end_with_parent, give_up, run_child
from ...compiled.jit import CACHE_FOLDER
from ...errors import Cancelled, GpuError
from ...scene.camera import Camera
from ..rendering.render import DrawRules
from .adapters import Adapter, find_adapters
from .card import SHADERS, Card
from .drawing import Canvas, view_of

MOST_SECONDS = 60.0
"""For which a card may be silent."""
GAUSSIANS, SIZE = 1000, 64


def refusal(adapter: Adapter) -> str:
    """Why a card must not be used; empty if it may. A success is remembered for this card, driver and these kernels."""
    marker = None if CACHE_FOLDER is None else CACHE_FOLDER / _marker(adapter)
    if marker is not None and marker.is_file():
        return ""
    begun = time.monotonic()

    def wait(_: float, __: str) -> None:
        if time.monotonic() > begun + MOST_SECONDS:
            raise Cancelled

    try:
        with TemporaryDirectory() as folder:
            run_child("splatting.gpu.trial", [adapter.identity], Path(folder) / "log.txt", wait)
    except Cancelled:
        return f"it did not answer in {MOST_SECONDS:.0f} s"
    except (ChildError, OSError) as error:
        return f"a first use in a process of its own failed ({error})"
    if marker is not None:
        marker.touch()
    return ""


def _marker(adapter: Adapter) -> str:
    """The name of the file that remembers a success."""
    digest = hashlib.sha256(adapter.identity.encode())
    for path in sorted(SHADERS.glob("*.wgsl")):
        digest.update(path.read_bytes())
    return f"card-{digest.hexdigest()[:16]}"


def main(arguments: Sequence[str]) -> None:
    """The child: draw a view and compute its gradients. arguments: the identity of an adapter."""
    end_with_parent()
    random = np.random.default_rng(0)
    parameters = {
        "means": random.normal(size=(GAUSSIANS, 3)).astype(np.float32),
        "log_scales": np.full((GAUSSIANS, 3), -2.0, np.float32),
        "quats": random.normal(size=(GAUSSIANS, 4)).astype(np.float32),
        "opacity_logits": np.zeros(GAUSSIANS, np.float32),
        "sh": random.normal(size=(GAUSSIANS, 4, 3)).astype(np.float32),
    }
    pose = np.eye(4)
    pose[2, 3] = 4.0
    K = np.array([[SIZE, 0.0, SIZE / 2], [0.0, SIZE, SIZE / 2], [0.0, 0.0, 1.0]])
    view = view_of(Camera(K=K, world_to_camera=pose, width=SIZE, height=SIZE), DrawRules(sh_degree=1), GAUSSIANS)
    try:
        [adapter] = [each for each in find_adapters() if each.identity == arguments[0]]
        pixels = np.ones((5, SIZE, SIZE), np.float32)
        found = Canvas(Card.open(adapter)).compute(parameters, view, pixel_gradients=pixels)
    except (GpuError, ValueError) as error:
        give_up(str(error))
    if not all(np.isfinite(values).all() and values.any() for values in (found.planes, found.gradients["means"])):
        give_up("its numbers are not finite, or all 0")
