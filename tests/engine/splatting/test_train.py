"""Training learns, ends the same however often it is interrupted, and says what is wrong."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from splats import drawn_scene

from fruitlangs.engine.config import PRESETS, SceneConfig, TrainConfig
from fruitlangs.engine.errors import Cancelled, OutputError, SceneError, TrainingError
from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.engine.splatting.gaussians import PARAMETERS, Gaussians
from fruitlangs.engine.splatting.rendering.rasterize import render
from fruitlangs.engine.splatting.training.exposure import fit_exposure
from fruitlangs.engine.splatting.training.initialise import initialise_gaussians
from fruitlangs.engine.splatting.training.losses import psnr
from fruitlangs.engine.splatting.training.photos import PhotoShelf
from fruitlangs.engine.splatting.training.poses import apply_twist
from fruitlangs.engine.splatting.training.schedule import Schedule, view_at
from fruitlangs.engine.splatting.training.train import Training, choose_held_out, is_stalled, train

QUICK = TrainConfig(
    steps=60,
    max_gaussians=900,
    sh_degree=1,
    holdout_every=4,
    densify_every=10,
    checkpoint_every=7,
    reset_opacity_every=25,
    coarse_until=0.0,
    sh_rest_rate=4e-4,
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return drawn_scene()


@pytest.fixture(scope="module")
def uninterrupted(scene: Scene) -> Training:
    return train(scene, QUICK)


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in PARAMETERS)


def scaled(scene: Scene, scale: float) -> Scene:
    """The scene in other units: 1 of the old are `scale` of the new."""
    cameras = [replace(camera, world_to_camera=camera.world_to_camera.copy()) for camera in scene.cameras]
    for camera in cameras:
        camera.world_to_camera[:3, 3] *= scale
    return replace(scene, cameras=cameras, points=scene.points * scale)


def shifted(scene: Scene, offset: NDArray[np.float64]) -> Scene:
    cameras = []
    for camera in scene.cameras:
        pose = camera.world_to_camera.copy()
        pose[:3, 3] -= pose[:3, :3] @ offset
        cameras.append(replace(camera, world_to_camera=pose))
    return replace(scene, cameras=cameras, points=scene.points + offset)


class StopAt:
    """A progress that cancels at a step."""

    def __init__(self, step: int) -> None:
        self.step = step

    def __call__(self, fraction: float, message: str) -> None:
        if message.startswith(f"step {self.step}/"):
            raise Cancelled


def test_training_learns_photos_it_never_saw() -> None:
    scene = drawn_scene(views=24)
    grey = replace(scene, colors=np.full_like(scene.colors, 128))
    config = replace(QUICK, max_gaussians=3000, reset_opacity_every=0)
    barely = train(grey, replace(config, steps=1))
    longer = train(grey, replace(config, steps=300))
    assert barely.psnr is not None
    assert longer.psnr is not None
    assert longer.psnr > barely.psnr + 3.0
    assert [score.name for score in longer.held_out] == [f"{view:03d}.png" for view in range(0, 24, 4)]
    assert longer.steps == 300


def test_two_runs_give_the_same_bytes(scene: Scene, uninterrupted: Training) -> None:
    assert same(train(scene, QUICK).gaussians, uninterrupted.gaussians)


def test_another_seed_gives_others(scene: Scene, uninterrupted: Training) -> None:
    assert not same(train(scene, replace(QUICK, seed=1)).gaussians, uninterrupted.gaussians)


@pytest.mark.parametrize("stop", [20, 40])
def test_a_resumed_run_equals_the_uninterrupted_one(
    scene: Scene, uninterrupted: Training, tmp_path: Path, stop: int
) -> None:
    checkpoint = tmp_path / "c.safetensors"
    with pytest.raises(Cancelled):
        train(scene, QUICK, checkpoint=checkpoint, progress=StopAt(stop))
    assert checkpoint.is_file()
    resumed = train(scene, QUICK, checkpoint=checkpoint)
    assert resumed.steps == 60
    assert same(resumed.gaussians, uninterrupted.gaussians)


def test_a_resumed_run_starts_where_the_checkpoint_was(scene: Scene, tmp_path: Path) -> None:
    checkpoint = tmp_path / "c.safetensors"
    with pytest.raises(Cancelled):
        train(scene, QUICK, checkpoint=checkpoint, progress=StopAt(40))
    messages: list[str] = []
    train(scene, QUICK, checkpoint=checkpoint, progress=lambda fraction, message: messages.append(message))
    assert not any(message.startswith(("step 20/", "placing")) for message in messages)


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.999])
def test_a_damaged_checkpoint_is_passed_over_with_a_message(
    scene: Scene, uninterrupted: Training, tmp_path: Path, kept: float
) -> None:
    checkpoint = tmp_path / "c.safetensors"
    with pytest.raises(Cancelled):
        train(scene, QUICK, checkpoint=checkpoint, progress=StopAt(40))
    content = checkpoint.read_bytes()
    checkpoint.write_bytes(content[: int(len(content) * kept)])
    messages: list[str] = []
    again = train(scene, QUICK, checkpoint=checkpoint, progress=lambda fraction, message: messages.append(message))
    assert any("starting again" in message and "c.safetensors" in message for message in messages)
    assert same(again.gaussians, uninterrupted.gaussians)


def test_a_checkpoint_of_other_settings_is_passed_over(scene: Scene, tmp_path: Path) -> None:
    checkpoint = tmp_path / "c.safetensors"
    with pytest.raises(Cancelled):
        train(scene, QUICK, checkpoint=checkpoint, progress=StopAt(40))
    other = replace(QUICK, seed=3, steps=30)
    assert same(train(scene, other, checkpoint=checkpoint).gaussians, train(scene, other).gaussians)


KILLED = """
import sys
sys.path[:0] = [{scripts!r}, {tests!r}]
import _checkout
from pathlib import Path
from splats import drawn_scene
from fruitlangs.engine.config import TrainConfig
from fruitlangs.engine.splatting.training.train import train
config = TrainConfig(steps=100000, max_gaussians=900, sh_degree=1, checkpoint_every=1)
train(drawn_scene(), config, checkpoint=Path(sys.argv[1]))
"""


def test_a_kill_leaves_a_whole_checkpoint(scene: Scene, tmp_path: Path) -> None:
    from fruitlangs.engine.splatting.training.checkpoint import read_checkpoint, training_key

    root = Path(__file__).resolve().parents[3]
    script = KILLED.format(scripts=str(root / "scripts"), tests=str(root / "tests" / "engine"))
    checkpoint = tmp_path / "c.safetensors"
    config = TrainConfig(steps=100000, max_gaussians=900, sh_degree=1, checkpoint_every=1)
    for delay in (0.0, 0.05, 0.11):
        process = subprocess.Popen([sys.executable, "-c", script, str(checkpoint)])
        before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
        limit = time.monotonic() + 120
        while (not checkpoint.exists() or checkpoint.stat().st_mtime_ns == before) and time.monotonic() < limit:
            time.sleep(0.01)
        time.sleep(delay)
        process.kill()
        process.wait()
        assert read_checkpoint(checkpoint, training_key(scene, config)).step > 0


def test_a_checkpoint_that_cannot_be_written_is_named(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        train(scene, QUICK, checkpoint=tmp_path / "file" / "c.safetensors")


def test_cancel_passes_through(scene: Scene) -> None:
    with pytest.raises(Cancelled):
        train(scene, QUICK, progress=StopAt(20))


def test_progress_never_goes_back_and_ends_near_one(scene: Scene) -> None:
    fractions: list[float] = []
    train(scene, QUICK, progress=lambda fraction, message: fractions.append(fraction))
    assert fractions == sorted(fractions)
    assert 0.9 < fractions[-1] <= 1.0


def test_a_scene_without_points_is_trained_from_random_ones(scene: Scene) -> None:
    bare = replace(scene, points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8))
    training = train(bare, replace(QUICK, steps=200, max_gaussians=3000, reset_opacity_every=0))
    assert training.psnr is not None
    assert training.psnr > 18.0


def test_photos_of_mixed_sizes_and_masks_are_trained(scene: Scene) -> None:
    cameras, images = list(scene.cameras), list(scene.images)
    K = np.diag([0.5, 0.5, 1.0]) @ cameras[1].K
    cameras[1] = replace(cameras[1], K=K, width=32, height=24)
    images[1] = ArrayPhoto("001.png", images[1].pixels()[::2, ::2].copy())
    images[2] = ArrayPhoto("002.png", images[2].pixels(), np.zeros((48, 64), bool))
    training = train(replace(scene, cameras=cameras, images=images), QUICK)
    assert all(math.isfinite(score.psnr) for score in training.held_out)


def test_a_photo_of_another_size_than_its_camera_is_named(scene: Scene) -> None:
    images = list(scene.images)
    images[3] = ArrayPhoto("wrong.png", np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(SceneError, match=r"wrong\.png"):
        train(replace(scene, images=images), QUICK)


def test_a_broken_photo_that_is_held_out_is_named_before_the_first_step(scene: Scene) -> None:
    images = list(scene.images)
    images[4] = ArrayPhoto("broken.png", np.zeros((10, 10, 3), np.uint8))
    assert 4 in choose_held_out(scene, QUICK.holdout_every)
    messages: list[str] = []
    with pytest.raises(SceneError, match=r"broken\.png"):
        train(replace(scene, images=images), QUICK, progress=lambda fraction, message: messages.append(message))
    assert not any(message.startswith("step") for message in messages)


def test_a_loss_that_is_no_number_is_an_error(scene: Scene) -> None:
    config = replace(QUICK)
    object.__setattr__(config, "means_rate", float("nan"))  # past the config's own check
    with pytest.raises(TrainingError, match="broke down"):
        train(scene, config)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_a_scene_of_any_scale_is_learnt_alike(scene: Scene, uninterrupted: Training, scale: float) -> None:
    other = train(scaled(scene, scale), QUICK)
    assert other.psnr == pytest.approx(uninterrupted.psnr, abs=0.8)  # seeds alone differ by 0.4 in so short a training
    assert len(other.gaussians) == pytest.approx(len(uninterrupted.gaussians), rel=0.05)


def test_noise_of_faint_gaussians_grows_with_the_scene(scene: Scene) -> None:
    config = replace(QUICK, densify="mcmc", densify_until=0.0, means_rate=0.0, steps=3)
    here, large = train(scene, config), train(scaled(scene, 100.0), config)
    moved_here, moved_large = here.gaussians.means, large.gaussians.means / 100.0
    torch.testing.assert_close(moved_large, moved_here, rtol=0.05, atol=0.02)
    assert not torch.allclose(moved_here, train(scene, replace(config, densify="gradient")).gaussians.means, atol=1e-3)


def test_a_scene_of_any_scale_starts_alike_from_no_points(scene: Scene) -> None:
    bare = replace(scene, points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8))
    first, small = (initialise_gaussians(PhotoShelf(s), range(8), 0, 900, 0) for s in (bare, scaled(bare, 1e-5)))
    torch.testing.assert_close(small.means * 1e5, first.means, rtol=1e-4, atol=1e-4)


def test_cameras_in_one_place_still_spread_the_first_gaussians(scene: Scene) -> None:
    cameras = [replace(camera, world_to_camera=camera.world_to_camera.copy()) for camera in scene.cameras]
    for camera in cameras:
        camera.world_to_camera[:3, 3] = camera.world_to_camera[:3, :3] @ [3.0, 0.1, 0.7]
    bare = replace(scene, cameras=cameras, points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8))
    assert bare.spread == 1.0
    assert replace(bare, points=scene.points).spread == pytest.approx(3.2, abs=1.0)
    around = shifted(replace(bare, points=scene.points), -bare.middle)  # now their centres are nothing but rounding
    assert around.spread == pytest.approx(3.2, abs=1.0)
    assert shifted(bare, -bare.middle).spread == 1.0


def test_a_scene_too_far_from_its_origin_for_its_size_is_refused(scene: Scene) -> None:
    with pytest.raises(TrainingError, match=r"lies 5e\+06 units from its origin.* Move the model"):
        train(shifted(scene, np.array([5e6, 0.0, 0.0])), QUICK)


def test_dropping_what_no_photo_needs_never_drops_everything(scene: Scene) -> None:
    with pytest.raises(TrainingError, match=r"--train\.drop-unneeded 1e\+06 would remove every Gaussian"):
        train(scene, replace(QUICK, drop_unneeded=1e6))


def test_what_no_photo_needs_is_dropped_also_when_gaussians_come_to_the_end(scene: Scene) -> None:
    config = replace(QUICK, densify_until=1.0)
    assert len(train(scene, replace(config, drop_unneeded=1.0)).gaussians) < len(train(scene, config).gaussians)


def test_opacities_are_not_reset_after_the_last_gaussian_came(scene: Scene) -> None:
    schedule = Schedule(PRESETS["paper"], scene)
    assert [step for step in range(1, 30_001) if schedule.resets_opacity(step)] == [3000, 6000, 9000, 12_000]


def test_no_plateau_before_photos_have_their_full_size_ends_a_training(scene: Scene) -> None:
    schedule = Schedule(TrainConfig(), scene)
    settled = [step for step in range(1, 1201) if schedule.is_settled(step)]
    assert settled == list(range(720, 1201))
    assert Schedule(PRESETS["paper"], scene).is_settled(15_001)
    assert not Schedule(PRESETS["paper"], scene).is_settled(15_000)


def test_few_gaussians_may_be_larger_than_many(scene: Scene) -> None:
    sizes = [Schedule(TrainConfig(max_gaussians=n), scene).densify_rules().oversize for n in (2800, 70_000, 1_000_000)]
    assert sizes == pytest.approx([0.5, 0.1, 0.1])


def test_every_round_shows_every_photo_once() -> None:
    views = [1, 2, 3, 5, 6, 7]
    for lap in range(3):
        assert sorted(view_at(step, views, 0) for step in range(lap * 6, lap * 6 + 6)) == views
    assert [view_at(k, views, 0) for k in range(6)] != [view_at(k, views, 1) for k in range(6)]


def test_nothing_is_held_out_of_a_single_photo_or_when_not_asked(scene: Scene) -> None:
    assert choose_held_out(scene, 0) == frozenset()
    assert choose_held_out(scene, 3) == {0, 3, 6}
    assert choose_held_out(replace(scene, cameras=scene.cameras[:1]), 8) == frozenset()


def test_a_scene_far_from_the_origin_is_learnt_alike(scene: Scene, uninterrupted: Training) -> None:
    far = shifted(scene, np.array([1e4, -2e4, 1.5e4]))
    other = train(far, QUICK)
    assert other.psnr == pytest.approx(uninterrupted.psnr, abs=0.05)
    offset = (other.gaussians.means.double().mean(0) - uninterrupted.gaussians.means.double().mean(0)).numpy()
    np.testing.assert_allclose(offset, [1e4, -2e4, 1.5e4], atol=0.1)
    drawn = render(other.gaussians, far.cameras[1]).color
    near = render(uninterrupted.gaussians, scene.cameras[1]).color
    assert float((drawn - near).abs().mean()) < 0.02


def test_half_the_steps_may_be_coarse(scene: Scene, uninterrupted: Training) -> None:
    coarse = train(scene, replace(QUICK, coarse_until=0.5))
    assert coarse.psnr == pytest.approx(uninterrupted.psnr, abs=1.5)
    assert not same(coarse.gaussians, uninterrupted.gaussians)


def test_training_stops_when_the_photos_held_out_gain_nothing(scene: Scene) -> None:
    frozen = replace(
        QUICK, means_rate=0, scales_rate=0, quats_rate=0, opacity_rate=0, sh_rate=0, sh_rest_rate=0, densify_until=0
    )
    stopped = train(scene, replace(frozen, reset_opacity_every=0, check_every=10, patience=2))
    assert stopped.steps == 30
    assert [step for step, _ in stopped.checks] == [10, 20, 30]
    assert stopped.psnr == pytest.approx(stopped.checks[-1][1])


@pytest.mark.parametrize("settings", [{"check_every": 0}, {"check_every": 10, "holdout_every": 0}])
def test_patience_without_measurements_is_refused(settings: dict[str, int], scene: Scene) -> None:
    with pytest.raises(TrainingError, match=r"--train\.patience needs measurements of held-out photos"):
        train(scene, replace(QUICK, patience=2, **settings))


@pytest.mark.parametrize(
    ("checks", "patience", "expected"),
    [([20, 21, 22], 2, False), ([20, 22, 22, 22.01], 2, True), ([20, 22, 22, 22.01], 0, False), ([22, 21], 2, False)],
)
def test_stalled_is_no_gain_over_what_was_best(checks: list[float], patience: int, expected: bool) -> None:
    assert is_stalled(checks, patience) is expected


def test_what_no_photo_needs_is_dropped(scene: Scene, uninterrupted: Training) -> None:
    config = replace(QUICK, densify_until=0.5)
    dropped, all_kept = train(scene, replace(config, drop_unneeded=1.0)), train(scene, config)
    assert len(dropped.gaussians) < len(all_kept.gaussians)
    assert dropped.psnr == pytest.approx(all_kept.psnr, abs=1.0)


@pytest.mark.parametrize(
    "settings",
    [
        {"densify": "mcmc", "opacity_weight": 0.01, "scale_weight": 0.01, "flatness_weight": 0.01},
        {"exposure": True, "refine_poses": True, "forgive": 0.1},
        {"antialiased": True, "load_weight": 0.1, "coarse_until": 0.4, "check_every": 10, "patience": 9},
    ],
    ids=["mcmc", "exposure", "antialiased"],
)
def test_a_resumed_run_equals_the_uninterrupted_one_with(
    settings: dict[str, Any], scene: Scene, uninterrupted: Training, tmp_path: Path
) -> None:
    config = replace(QUICK, **settings)
    whole = train(scene, config)
    checkpoint = tmp_path / "checkpoint.safetensors"
    with pytest.raises(Cancelled):
        train(scene, config, checkpoint=checkpoint, progress=StopAt(40))
    resumed = train(scene, config, checkpoint=checkpoint)
    assert same(resumed.gaussians, whole.gaussians)
    assert not same(whole.gaussians, uninterrupted.gaussians)
    assert (resumed.checks, resumed.gaussians.antialiased) == (whole.checks, "antialiased" in settings)
    for ours, theirs in zip(resumed.cameras, whole.cameras, strict=True):
        assert np.array_equal(ours.world_to_camera, theirs.world_to_camera)


def test_light_that_varies_from_photo_to_photo_is_learnt_as_exposure() -> None:
    scene = drawn_scene(views=24)
    random = np.random.default_rng(0)
    photos = []
    for photo in scene.images:
        gain = random.uniform(0.6, 1.0, 3)
        photos.append(ArrayPhoto(photo.name, np.rint(photo.pixels() * gain).astype(np.uint8)))
    varied = replace(scene, images=photos)
    config = replace(QUICK, steps=240, reset_opacity_every=0)
    plain, learnt = train(varied, config), train(varied, replace(config, exposure=True))
    truth = [render(plain.gaussians, scene.cameras[0]).color, render(learnt.gaussians, scene.cameras[0]).color]
    errors = [-psnr(affine(color, scene.images[0].pixels()), scene.images[0].pixels()) for color in truth]
    assert errors[1] < errors[0]


def affine(color: torch.Tensor, photo: NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(fit_exposure(color.numpy(), photo, None))


def test_poses_that_are_off_are_refined() -> None:
    sample = Path(__file__).resolve().parents[3] / "examples" / "orchard_tree"
    scene = read_scene(sample, SceneConfig(downscale=4))
    random = np.random.default_rng(1)
    off = [
        replace(camera, world_to_camera=apply_twist(camera.world_to_camera, random.normal(0, [0.015] * 3 + [0.02] * 3)))
        for camera in scene.cameras
    ]
    config = TrainConfig(steps=600, max_gaussians=12_000, sh_degree=0, holdout_every=0, coarse_until=0.0)
    refined = train(replace(scene, cameras=off), replace(config, refine_poses=True))
    assert turned_away(refined.cameras, scene) < 0.8 * turned_away(off, scene)


def turned_away(cameras: Sequence[Camera], scene: Scene) -> float:
    """Mean angle in degrees between cameras and the true ones, after the rotation that brings their places together."""
    ours, theirs = (np.array([camera.center for camera in some]) for some in (cameras, scene.cameras))
    rotation, _ = Rotation.align_vectors(theirs - theirs.mean(0), ours - ours.mean(0))
    angles = [
        Rotation.from_matrix(
            camera.world_to_camera[:3, :3] @ rotation.inv().as_matrix() @ true.world_to_camera[:3, :3].T
        )
        for camera, true in zip(cameras, scene.cameras, strict=True)
    ]
    return float(np.degrees(np.mean([angle.magnitude() for angle in angles])))


def test_one_photo_alone_is_trained(scene: Scene) -> None:
    alone = replace(scene, cameras=scene.cameras[:1], images=scene.images[:1])
    training = train(alone, replace(QUICK, steps=20))
    assert training.psnr is None
    assert len(training.gaussians) > 0


def test_a_photo_held_out_that_is_masked_out_is_not_measured(scene: Scene) -> None:
    blind = [ArrayPhoto(photo.name, photo.pixels(), np.zeros((48, 64), bool)) for photo in scene.images[:1]]
    config = replace(QUICK, steps=2, exposure=True)
    training = train(replace(scene, images=[*blind, *scene.images[1:]]), config)
    assert [score.name for score in training.held_out] == [photo.name for photo in scene.images[4::4]]
    assert math.isfinite(training.psnr or math.nan)


def test_one_usable_photo_among_masked_ones_is_enough(scene: Scene) -> None:
    blind = [ArrayPhoto(photo.name, photo.pixels(), np.zeros((48, 64), bool)) for photo in scene.images]
    some = replace(scene, images=[*blind[:-1], scene.images[-1]])
    assert train(some, replace(QUICK, steps=30, holdout_every=0)).steps == 30


def test_masked_pixels_colour_no_first_gaussian(scene: Scene) -> None:
    half = np.zeros((48, 64), bool)
    half[:, 32:] = True
    photos = [ArrayPhoto(photo.name, photo.pixels(), half) for photo in scene.images]
    whole = initialise_gaussians(PhotoShelf(scene), range(8), 0, 9000, 0)
    masked = initialise_gaussians(PhotoShelf(replace(scene, images=photos)), range(8), 0, 9000, 0)
    assert len(scene.points) < len(masked) < len(whole)


def test_masks_that_leave_nothing_are_refused_within_a_round(scene: Scene) -> None:
    black = [ArrayPhoto(photo.name, photo.pixels(), np.zeros(photo.pixels().shape[:2], bool)) for photo in scene.images]
    with pytest.raises(TrainingError, match="masks leave no pixel"):
        train(replace(scene, images=black), QUICK)


def test_points_that_no_camera_sees_are_refused(scene: Scene) -> None:
    turned = []
    for camera in scene.cameras:
        pose = np.diag([-1.0, 1.0, -1.0, 1.0]) @ camera.world_to_camera  # looks the other way from the same place
        turned.append(replace(camera, world_to_camera=pose))
    with pytest.raises(TrainingError, match=r"None of the .* sparse points lies before any camera"):
        train(replace(scene, cameras=turned), QUICK)
