"""Compiles the kernels of later stages in another process, the first time that this computer counts.

All kernels take Numba about a minute. The forward pass is compiled when training starts. At the same time a child
process compiles the backward pass, and then counts, lifts and trains a small synthetic scene. This leaves machine code
in the cache of `compiled.jit`, where training and the later stages find it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread

import numpy as np
import torch
from numpy.typing import NDArray

from .child_process import ChildError, end_with_parent, run_child, tell
from .compiled.jit import CACHE_FOLDER, is_all_compiled, mark_compiled
from .config import CountConfig, TrainConfig
from .counting.count import count_fruit
from .errors import Cancelled
from .language.features.lift import lift_features
from .language.prompts.photo_probability import PhotoMap
from .progress import Progress
from .scene.camera import ArrayPhoto, Camera, Scene, look_along
from .splatting.gaussians import Gaussians
from .splatting.kernels.records import RECORD, TILE_HEIGHT, TILE_WIDTH
from .splatting.kernels.tile import CHANNELS
from .splatting.rendering.render import DrawRules, Tiles, view_backward
from .splatting.rendering.workspace import Workspace
from .splatting.training.losses import PhotometricLoss
from .splatting.training.step import SSIM_WEIGHT
from .splatting.training.train import train

COUNTING = 0.5
"""Progress of the child when the kernels of counting are compiled; those of training follow."""
POLL_SECONDS = 0.2
FRUITS, PER_FRUIT, VIEWS = 5, 400, 12
WIDTH, HEIGHT, FOCAL = 160, 120, 160.0


class Compilation:
    """The child that compiles."""

    def __init__(self) -> None:
        self._counting, self._stopped = Event(), Event()
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        def follow(fraction: float, message: str) -> None:
            if fraction >= COUNTING:
                self._counting.set()
            if self._stopped.is_set():
                raise Cancelled("compilation is not needed any more")

        try:
            with TemporaryDirectory() as folder:
                run_child("compile_ahead", [], Path(folder) / "log.txt", follow)
        except (ChildError, Cancelled, OSError):
            pass  # then the kernels are compiled where they are called first
        finally:
            self._counting.set()

    def wait_for_counting(self, progress: Progress, fraction: float) -> None:
        """Return when the kernels of counting are compiled, reporting progress at `fraction`.

        Raises:
            Cancelled: `progress` asked for it.
        """
        while not self._counting.wait(POLL_SECONDS):
            progress(fraction, "Compiling for this computer (first run only)")

    def stop(self) -> None:
        """End the child."""
        self._stopped.set()


@contextmanager
def compile_alongside(progress: Progress, fraction: float) -> Iterator[None]:
    """Compile the kernels of counting while the block runs; it ends when they are compiled, reporting at `fraction`.

    Does nothing on a computer that has counted before, or that cannot keep machine code.

    Raises:
        Cancelled: `progress` asked for it.
    """
    if is_all_compiled() or CACHE_FOLDER is None:
        yield
        return
    compilation = Compilation()
    try:
        yield
        compilation.wait_for_counting(progress, fraction)
    except BaseException:
        compilation.stop()
        raise


def compile_once() -> None:
    """Compile all kernels in a child process now, so that several workers need not each do it at the same time.

    Does nothing on a computer that has counted before, or that cannot keep machine code.
    """
    if is_all_compiled() or CACHE_FOLDER is None:
        return
    with TemporaryDirectory() as folder, suppress(ChildError, OSError):  # then each worker compiles
        run_child("compile_ahead", [], Path(folder) / "log.txt")


def main(arguments: Sequence[str]) -> None:
    """The child. arguments: none."""
    end_with_parent()
    compile_all()


def compile_all() -> None:
    """Compile all kernels: count, lift and train a small synthetic scene."""
    gaussians, probability, cameras = _scene()
    _compile_backward(cameras[0])
    maps = [PhotoMap(np.ones((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH, 2), np.float32)) for _ in cameras]
    count_fruit(gaussians, probability, cameras, CountConfig(threshold=0.3), label="fruit", photos=maps)
    lift_features(gaussians, cameras, (torch.ones(HEIGHT, WIDTH, 4) for _ in cameras), encoder_id="none")
    tell(COUNTING, "training")
    photo = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    points = gaussians.means.double().numpy()
    scene = Scene(
        cameras=cameras,
        images=[ArrayPhoto(f"{view:02d}", photo) for view in range(VIEWS)],
        points=points,
        colors=np.full((len(points), 3), 128, np.uint8),
        up=np.array([0.0, 0.0, 1.0]),
    )
    train(scene, TrainConfig(steps=20, max_gaussians=4 * len(points), densify_every=5))
    mark_compiled()
    tell(1.0, "done")


def _compile_backward(camera: Camera) -> None:
    """Compile what a step of training needs last: the loss and the backward pass, with no Gaussian."""
    workspace = Workspace()
    shapes = {"means": (0, 3), "log_scales": (0, 3), "quats": (0, 4), "opacity_logits": (0,), "sh": (0, 9, 3)}
    parameters = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    rules, features = DrawRules(sh_degree=2), np.zeros((0, 0), np.float32)
    columns, rows = -(-WIDTH // TILE_WIDTH), -(-HEIGHT // TILE_HEIGHT)
    none, tile_starts = np.zeros(0, np.int32), np.zeros(columns * rows + 1, np.int64)
    tiles = Tiles(
        np.zeros((0, RECORD), np.float32), np.zeros(1, np.int64), none, columns, tile_starts, none, none,
        np.arange(columns * rows),
    )  # fmt: skip
    planes = np.zeros((CHANNELS, HEIGHT, WIDTH), np.float32)
    gradients = np.zeros((5, HEIGHT, WIDTH), np.float32)
    photo = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    PhotometricLoss(SSIM_WEIGHT, workspace).backward(planes[:3], photo, None, gradients[:3])
    background = np.zeros(3, np.float32)
    view_backward(
        parameters, camera, rules, tiles, planes, gradients, workspace, features=features, background=background
    )


def _scene() -> tuple[Gaussians, NDArray[np.float64], list[Camera]]:
    """A row of spheres, the second touching the first, whose surfaces are opaque Gaussians; and cameras around them."""
    rng = np.random.default_rng(0)
    centers = np.zeros((FRUITS, 3))
    centers[:, 0] = [-2.2, -1.2, 0.2, 1.6, 3.0]
    normals = rng.normal(size=(FRUITS * PER_FRUIT, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    means = np.repeat(centers, PER_FRUIT, axis=0) + 0.5 * normals
    # The rotation that takes z to the normal: the flat side of a Gaussian lies in the surface.
    quats = np.stack([1.0 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))], axis=1)
    gaussians = Gaussians(
        means=torch.tensor(means, dtype=torch.float32),
        log_scales=torch.tensor(np.log([0.06, 0.06, 0.01]), dtype=torch.float32).repeat(len(means), 1),
        quats=torch.tensor(quats, dtype=torch.float32),
        opacity_logits=torch.full((len(means),), 3.0),
        sh=torch.zeros(len(means), 9, 3),
    )
    K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    cameras = []
    for angle in np.linspace(0.0, 2.0 * np.pi, VIEWS, endpoint=False):
        place = np.array([7.0 * np.cos(angle), 7.0 * np.sin(angle), 2.0])
        cameras.append(Camera(K, look_along(place, -place, np.array([0.0, 0.0, 1.0])), WIDTH, HEIGHT))
    return gaussians, np.full(len(means), 0.9), cameras
