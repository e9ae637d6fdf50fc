"""The stages of the ablation ladder: one count each, with true masks, poses or geometry instead of estimated ones.

The difference between two stages is the loss of the part that was replaced.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...engine.config import Config
from ...engine.counting.count import count_fruit
from ...engine.counting.fruit import FruitCount
from ...engine.errors import FormatError
from ...engine.evaluation.camera_errors import CameraErrors, camera_errors
from ...engine.evaluation.datasets.cloud import ColoredCloud, write_cloud
from ...engine.evaluation.renders import DEPTH, INSTANCES, check_instances, read_depths, read_instances
from ...engine.evaluation.true_surface import TrueSurface, true_surface
from ...engine.evaluation.truth import TrueView, Truth
from ...engine.language.encoders.encoder import sees_fruit
from ...engine.language.encoders.seen import resize
from ...engine.language.features.embedder import Embedder
from ...engine.language.prompts.photo_probability import PhotoMap
from ...engine.language.prompts.relevancy import MIN_WEIGHT
from ...engine.language.prompts.selection import select
from ...engine.photo_size import photo_scales
from ...engine.pipeline import Result, count_scene
from ...engine.progress import Progress, part, silent
from ...engine.scene.camera import Camera, Scene
from ...engine.scene.photos.photo import FilePhoto
from ...engine.scene.read import read_scene
from ...engine.splatting.gaussians import Gaussians
from ...engine.splatting.rendering.rasterize import accumulate
from ...engine.storage.files import write_text
from .frames import align_by_cameras, align_by_fruit, cameras_by_file, warp_to_view

FloatArray = NDArray[np.float64]

COUNTING_ONLY = "counting-only"
TRUE_GEOMETRY = "true-geometry"
TRUE_MASKS = "true-masks"
TRUE_POSES = "true-poses"
END_TO_END = "end-to-end"
STAGES: Mapping[str, str] = {
    COUNTING_ONLY: "true surfaces as seen, true masks: only the counting can lose",
    TRUE_GEOMETRY: "true surfaces as seen, masks by the encoder",
    TRUE_MASKS: "trained Gaussians from true poses, true masks",
    TRUE_POSES: "trained Gaussians from true poses, masks by the encoder",
    END_TO_END: "poses from the photos alone, trained Gaussians, masks by the encoder",
}
"""{stage: what is true and what is estimated}."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Counted:
    """The count of one stage, in the frame of the truth.

    centers: (P, 3); diameters, probabilities: (P,); interval, total_interval: of visible and of all fruit, None
    without one; total_estimate: most likely number of all fruit, None without one; psnr, ssim: of held-out photos, None
    without training; views: number of views; cameras: errors of estimated cameras, None if the true ones were used;
    seconds by stage.
    """

    centers: FloatArray
    diameters: FloatArray
    probabilities: FloatArray
    interval: tuple[float, float] | None = None
    total_interval: tuple[float, float] | None = None
    total_estimate: float | None = None
    psnr: float | None = None
    ssim: float | None = None
    views: int = 0
    cameras: CameraErrors | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Given:
    """The input of a count: N Gaussians with probability (N,) of being fruit, and their cameras."""

    gaussians: Gaussians
    probability: torch.Tensor
    cameras: Sequence[Camera]


SAME_POSE = 1e-6
"""Poses that differ by no more than this are equal: values in text files are rounded."""


class LadderStages:
    """The ablation stages of one generated scene; shared intermediate results are computed once, on demand.

    folder: the scene; out: folder of trained results; truth: its fruit, None if only stages without masks are
    requested; views: its true cameras, empty if the model's own are true; prompts: what to count.
    """

    def __init__(
        self,
        folder: Path,
        out: Path,
        truth: Truth | None,
        views: Sequence[TrueView],
        prompts: Sequence[str],
        config: Config,
    ) -> None:
        self.folder, self.out, self.truth, self.views = folder, out, truth, views
        self.prompts, self.config = prompts, config
        self._scene: Scene | None = None
        self._instances: list[NDArray[np.uint16]] | None = None
        self._surface: TrueSurface | None = None
        self._result: Result | None = None

    def run(self, name: str, progress: Progress) -> Counted:
        """Count in one stage.

        Raises:
            FruitLangsError: it cannot be done, for example because no poses were found.
        """
        runners: dict[str, Callable[[Progress], Counted]] = {
            COUNTING_ONLY: self._run_counting_only,
            TRUE_GEOMETRY: self._run_true_geometry,
            TRUE_MASKS: self._run_true_masks,
            TRUE_POSES: self._run_true_poses,
            END_TO_END: self._run_end_to_end,
        }
        return runners[name](progress)

    @property
    def scene(self) -> Scene:
        """The scene with its true cameras."""
        if self._scene is None:
            self._scene = read_scene(self._prepare_true_source(), self.config.scene)
        return self._scene

    @property
    def instances(self) -> list[NDArray[np.uint16]]:
        """The fruit ids (H, W) of every view, after checking that they belong to this truth."""
        if self._instances is None:
            read = read_instances(self.folder, self.scene)
            assert self.truth is not None
            check_instances(self.truth, self.scene.cameras, read)
            self._instances = read
        return self._instances

    def prepare_input(self, name: str, progress: Progress = silent) -> Given:
        """Prepare the input of one of the stages with true masks.

        Raises:
            FruitLangsError: it cannot be had.
        """
        if name == COUNTING_ONLY:
            surface = self._read_true_surface(progress)
            probability = torch.from_numpy(np.isin(surface.fruit, self._ids()).astype(np.float64))
            return Given(surface.gaussians, probability, self.scene.cameras)
        assert name == TRUE_MASKS
        trained = self._train_once(progress)
        cameras = trained.scene.cameras
        probability = measure_masked_probability(trained.gaussians, cameras, self.instances, self._ids())
        return Given(trained.gaussians, probability, cameras)

    def _run_counting_only(self, progress: Progress) -> Counted:
        given = self.prepare_input(COUNTING_ONLY, part(progress, 0.0, 0.3))
        return self._count(given.gaussians, given.probability, part(progress, 0.3, 1.0))

    def _run_true_geometry(self, progress: Progress) -> Counted:
        surface = self._read_true_surface(part(progress, 0.0, 0.2))
        embedder = Embedder.open(self.config.embed)
        scales = photo_scales(self.scene, embedder.encoder)
        features = embedder.lift(
            surface.gaussians, self.scene, self.out / "cache", scales=scales, progress=part(progress, 0.2, 0.6)
        )
        probability = select(features, embedder.encoder, self.prompts, (), self.config.count, surface.gaussians.means)
        return self._count(surface.gaussians, probability, part(progress, 0.6, 1.0))

    def _run_true_masks(self, progress: Progress) -> Counted:
        given = self.prepare_input(TRUE_MASKS, part(progress, 0.0, 0.7))
        trained, rest = self._train_once(silent), part(progress, 0.7, 1.0)
        maps = self._make_true_maps(trained.scene)
        counted = self._count(given.gaussians, given.probability, rest, given.cameras, maps)
        quality = _read_counted(trained)
        counted = dataclasses.replace(counted, psnr=quality.psnr, ssim=quality.ssim)
        return self._move(trained, counted) if self.config.train.refine_poses else counted

    def _run_true_poses(self, progress: Progress) -> Counted:
        result = self._train_once(progress)
        counted = _read_counted(result)
        return self._move(result, counted) if self.config.train.refine_poses else counted

    def _run_end_to_end(self, progress: Progress) -> Counted:
        """Count in the frame estimated from the photos, then move the fruit to the frame of the truth."""
        result = self._train(self.folder / "images", END_TO_END, progress)
        errors = camera_errors(cameras_by_file(result.scene), cameras_by_file(self.scene)) if self.truth else None
        return dataclasses.replace(self._move(result, _read_counted(result)), cameras=errors)

    def _move(self, result: Result, counted: Counted) -> Counted:
        """Move the fruit in the frame of `result` to the frame of the truth."""
        if self.truth is not None and all((self.folder / name).is_dir() for name in (DEPTH, INSTANCES)):
            depths = read_depths(self.folder, self.scene)
            moved = align_by_fruit(result.gaussians, result.scene, self.scene, depths, self.instances)
        else:
            moved = align_by_cameras(result.scene, self.scene)
        return dataclasses.replace(
            counted,
            centers=moved.apply(counted.centers),
            diameters=moved.apply_to_lengths(counted.diameters),
        )

    def _train_once(self, progress: Progress) -> Result:
        if self._result is None:
            self._result = self._train(self._prepare_true_source(), TRUE_POSES, progress)
        return self._result

    def _train(self, source: Path, name: str, progress: Progress) -> Result:
        """The product's own pipeline from photos to fruit; earlier training is taken from its cache."""
        return count_scene(source, self.prompts, self.out / name, config=self.config, progress=progress)

    def _count(
        self,
        gaussians: Gaussians,
        probability: torch.Tensor,
        progress: Progress,
        cameras: Sequence[Camera] | None = None,
        maps: Sequence[PhotoMap] | None = None,
    ) -> Counted:
        """Count with the true cameras, or with `cameras` if training moved them."""
        cameras = self.scene.cameras if cameras is None else cameras
        found = count_fruit(
            gaussians, probability, cameras, self.config.count, label=self.prompts[0], photos=maps, progress=progress
        )
        return _make_counted(found, len(cameras))

    def _make_true_maps(self, scene: Scene) -> list[PhotoMap] | None:
        """Return the true masks of the photos of a scene as maps, as large as the encoder's offsets, with these; None
        if it gives none."""
        encoder = Embedder.open(self.config.embed).encoder
        if not sees_fruit(encoder):
            return None
        maps = []
        for photo, ids, scales in zip(scene.images, self.instances, photo_scales(scene, encoder), strict=True):
            shown = warp_to_view(photo, np.isin(ids, self._ids())[..., None].astype(np.float32))
            offsets = encoder.encode_fruit(photo.pixels(), scales).offsets
            probability = resize(torch.from_numpy(shown).permute(2, 0, 1), *offsets.shape[:2])[0]
            maps.append(PhotoMap(np.ascontiguousarray(probability), offsets.numpy()))
        return maps

    def _read_true_surface(self, progress: Progress) -> TrueSurface:
        if self._surface is None:
            depths = read_depths(self.folder, self.scene)
            self._surface = true_surface(self.scene, depths, self.instances, progress=progress)
        return self._surface

    def _ids(self) -> NDArray[np.int64]:
        assert self.truth is not None
        assert self.truth.ids is not None  # `instances` has checked it
        return self.truth.ids

    def _prepare_true_source(self) -> Path:
        """Prepare the source with true poses: the scene itself, or a transforms.json that replaces noisy ones."""
        if not self.views:
            return self.folder
        given = read_scene(self.folder, self.config.scene)
        true = {view.name: view.world_to_camera for view in self.views}
        unknown = [name for name in cameras_by_file(given) if name not in true]
        if unknown:
            raise FormatError(f"The truth lists no true camera of {unknown[0]}. Make the scene again")
        off = [np.abs(camera.world_to_camera - true[name]).max() for name, camera in cameras_by_file(given).items()]
        if max(off) < SAME_POSE:
            return self.folder
        path = self.out / "true_poses" / "transforms.json"
        write_transforms(path, given, true)
        return path


def measure_masked_probability(
    gaussians: Gaussians, cameras: Sequence[Camera], instances: Sequence[NDArray[np.uint16]], ids: NDArray[np.int64]
) -> torch.Tensor:
    """Measure the share (N,) of the pixels of each Gaussian that show one of the fruit `ids`; 0 if it covers almost
    none.

    instances: (H, W) fruit ids per view.
    """
    sums, weights = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))
    for camera, mask in zip(cameras, instances, strict=True):
        shown = torch.from_numpy(np.isin(mask, ids).astype(np.float32))[..., None]
        drawn = accumulate(gaussians, camera, shown)
        sums += drawn.sums[:, 0]
        weights += drawn.weights
    return torch.where(weights >= MIN_WEIGHT, sums / weights.clamp_min(1e-9), torch.zeros(())).clamp(0.0, 1.0)


def write_transforms(path: Path, scene: Scene, poses: Mapping[str, FloatArray]) -> None:
    """Write the scene's photos with other poses, world to camera (4, 4) by photo, as a transforms.json with a cloud."""
    frames = []
    for photo, camera in zip(scene.images, scene.cameras, strict=True):
        assert isinstance(photo, FilePhoto)
        pose = np.linalg.inv(poses[Path(photo.name).name]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        lens = {"fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2]}
        size = {"w": camera.width, "h": camera.height}
        frames.append({"file_path": str(photo.path.resolve()), "transform_matrix": pose.tolist(), **lens, **size})
    write_cloud(path.with_name("points.ply"), ColoredCloud(scene.points, scene.colors))
    write_text(path, json.dumps({"frames": frames, "ply_file_path": "points.ply"}) + "\n")


def _make_counted(found: FruitCount, views: int) -> Counted:
    return Counted(
        centers=found.centers,
        diameters=found.diameters,
        probabilities=np.array([fruit.probability for fruit in found.fruits], dtype=np.float64),
        interval=found.interval,
        total_interval=found.total_interval,
        total_estimate=found.total,
        views=views,
    )


def _read_counted(result: Result) -> Counted:
    """Read the count of the product's own pipeline, in its own frame."""
    counted = _make_counted(result.fruit_count, len(result.scene.cameras))
    training = result.origin["training"]
    return dataclasses.replace(counted, seconds=result.seconds, psnr=training["psnr"], ssim=training["ssim"])
