"""Training on a graphics card: the same as on the CPU but for rounding, the same bytes every time, and never lost."""

from __future__ import annotations

import gc
import os
import re
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splats import drawn_scene

from fruitlangs.engine.config import TrainConfig
from fruitlangs.engine.errors import Cancelled, GpuError
from fruitlangs.engine.scene.camera import Scene
from fruitlangs.engine.splatting.gaussians import PARAMETERS, Gaussians
from fruitlangs.engine.splatting.gpu import card as card_module
from fruitlangs.engine.splatting.gpu.adapters import Adapter
from fruitlangs.engine.splatting.gpu.card import Card
from fruitlangs.engine.splatting.gpu.drawing import Canvas
from fruitlangs.engine.splatting.training.card_step import CardStep, adapter_for
from fruitlangs.engine.splatting.training.checkpoint import TrainingState
from fruitlangs.engine.splatting.training.densify import GradientStats
from fruitlangs.engine.splatting.training.exposure import Exposures
from fruitlangs.engine.splatting.training.initialise import initialise_gaussians
from fruitlangs.engine.splatting.training.parameters import Parameters
from fruitlangs.engine.splatting.training.photos import PhotoShelf
from fruitlangs.engine.splatting.training.poses import Poses
from fruitlangs.engine.splatting.training.schedule import Schedule
from fruitlangs.engine.splatting.training.step import Step
from fruitlangs.engine.splatting.training.train import CPU, Training, train

QUICK = TrainConfig(steps=60, max_gaussians=200, densify_every=20, coarse_until=0.3, sh_degree=1)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return drawn_scene()


@pytest.fixture(scope="module")
def trained(scene: Scene, adapter: Adapter) -> Training:
    return train(scene, QUICK, adapter=adapter)


def bytes_of(gaussians: Gaussians) -> list[bytes]:
    return [getattr(gaussians, name).numpy().tobytes() for name in PARAMETERS]


def test_a_card_trains_as_well_as_the_cpu(scene: Scene, trained: Training, adapter: Adapter) -> None:
    ours = train(scene, QUICK)
    assert (ours.device, trained.device) == (CPU, adapter.identity)
    assert trained.steps == ours.steps == 60
    assert len(trained.gaussians) == pytest.approx(len(ours.gaussians), abs=3)
    fixed = replace(QUICK, densify_until=0.0)  # another order of equal gradients adds other Gaussians
    assert train(scene, fixed, adapter=adapter).psnr == pytest.approx(train(scene, fixed).psnr, abs=0.5)


def test_a_training_on_a_card_gives_the_same_bytes_again(scene: Scene, trained: Training, adapter: Adapter) -> None:
    assert bytes_of(train(scene, QUICK, adapter=adapter).gaussians) == bytes_of(trained.gaussians)


def test_a_view_without_room_is_repeated_and_changes_no_byte(
    scene: Scene, trained: Training, adapter: Adapter, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin, asked = Canvas.__init__, []

    def narrow(canvas: Canvas, card: Card) -> None:
        begin(canvas, card)
        canvas.capacity = 10

    monkeypatch.setattr(Canvas, "__init__", narrow)
    make_room = Canvas.make_room
    monkeypatch.setattr(Canvas, "make_room", lambda canvas, pairs: (asked.append(pairs), make_room(canvas, pairs)))
    monkeypatch.setattr("fruitlangs.engine.splatting.gpu.drawing.SPARE", 1.0)
    assert bytes_of(train(scene, QUICK, adapter=adapter).gaussians) == bytes_of(trained.gaussians)
    assert len(asked) > 2


def test_a_resumed_training_is_the_uninterrupted_one(
    scene: Scene, trained: Training, adapter: Adapter, tmp_path: Path
) -> None:
    often, file = replace(QUICK, checkpoint_every=25), tmp_path / "checkpoint.safetensors"

    def cancel(share: float, message: str) -> None:
        if message.startswith("step 40/"):
            raise Cancelled

    with pytest.raises(Cancelled):
        train(scene, often, checkpoint=file, adapter=adapter, progress=cancel)
    assert file.is_file()
    resumed = train(scene, often, checkpoint=file, adapter=adapter)
    assert bytes_of(resumed.gaussians) == bytes_of(trained.gaussians)


def test_a_checkpoint_of_a_card_is_not_used_by_the_cpu(scene: Scene, adapter: Adapter, tmp_path: Path) -> None:
    often, file = replace(QUICK, checkpoint_every=25), tmp_path / "checkpoint.safetensors"
    train(scene, often, checkpoint=file, adapter=adapter)
    assert bytes_of(train(scene, often, checkpoint=file).gaussians) == bytes_of(train(scene, often).gaussians)


@pytest.mark.parametrize(
    ("right", "wrong"), [("const MAX_ALPHA: f32 = 0.99", "const MAX_ALPHA: f32 = 0.3"), ("d_mean[k],", "-d_mean[k],")]
)
def test_a_card_that_computes_something_else_is_not_used(
    right: str, wrong: str, scene: Scene, adapter: Adapter, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, said = card_module._source, []
    monkeypatch.setattr(card_module, "_source", lambda name: source(name).replace(right, wrong))
    found = train(scene, QUICK, adapter=adapter, progress=lambda _, message: said.append(message))
    assert found.device.startswith(f"{CPU} from step ")
    assert any("than the CPU" in message and "The CPU goes on" in message for message in said)
    assert len(found.gaussians) == pytest.approx(len(train(scene, QUICK).gaussians), abs=3)


def test_a_card_is_checked_again_and_again_without_another_byte(
    scene: Scene, adapter: Adapter, monkeypatch: pytest.MonkeyPatch
) -> None:
    fixed, checks, check = replace(QUICK, densify_until=0.0), [], CardStep._check
    monkeypatch.setattr(
        CardStep, "_check", lambda step, state, *rest: (checks.append(state.step), check(step, state, *rest))
    )
    once = train(scene, fixed, adapter=adapter)
    assert checks == [0]
    monkeypatch.setattr("fruitlangs.engine.splatting.training.card_step.CHECKED_EVERY", 25)
    assert bytes_of(train(scene, fixed, adapter=adapter).gaussians) == bytes_of(once.gaussians)
    assert checks == [0, 0, 25, 50]


def test_a_card_with_too_little_memory_is_refused_before_training(
    scene: Scene, adapter: Adapter, monkeypatch: pytest.MonkeyPatch
) -> None:
    resource = pytest.importorskip("resource")
    if not adapter.software:
        pytest.skip("only the memory of a card that the CPU plays can be limited")
    usual = Card.open

    def with_64_megabytes(adapter: Adapter) -> Card:
        card = usual(adapter)
        process = card._line._child.pid
        used = 4096 * int(Path(f"/proc/{process}/statm").read_text().split()[0])
        resource.prlimit(process, resource.RLIMIT_AS, (used + (64 << 20), used + (64 << 20)))
        return card

    monkeypatch.setattr(Card, "open", with_64_megabytes)
    config = replace(QUICK, max_gaussians=1_200_000)
    found = train(scene, config, adapter=adapter)
    assert found.device.startswith(f"{CPU}: {adapter.name} failed: ")
    assert "1,200,000 Gaussians in photos of" in found.device
    assert "Lower --train.max-gaussians" in found.device
    assert found.steps == 60


@pytest.mark.parametrize(
    ("sign", "reason"), [(signal.SIGABRT, "its process ended with code -6"), (signal.SIGSTOP, "it did not answer in")]
)
def test_when_the_driver_crashes_or_hangs_the_cpu_goes_on_from_the_last_sound_state(
    sign: signal.Signals,
    reason: str,
    scene: Scene,
    trained: Training,
    adapter: Adapter,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    submit, done = Card.submit, [0]

    def lose(card: Card, commands: Any) -> None:
        done[0] += 1
        if done[0] == 34:
            monkeypatch.setattr(card._line, "_most_seconds", 1.0)
            os.kill(card._line._child.pid, sign)
        submit(card, commands)

    monkeypatch.setattr(Card, "submit", lose)
    found = train(scene, QUICK, adapter=adapter)
    assert found.device.startswith(f"CPU from step 20 on: {adapter.name} failed: {reason}")
    assert found.steps == 60
    assert found.psnr == pytest.approx(trained.psnr, abs=1.0)


def test_an_error_of_the_driver_is_raised_when_results_are_fetched(adapter: Adapter) -> None:
    card = Card.open(adapter)
    card.upload("plan", np.zeros(4, np.uint32))
    card._line.tell("write", 1234)
    with pytest.raises(GpuError, match=f"{re.escape(adapter.name)} failed: 1234"):
        card.download("plan", np.uint32, 4)
    card.close()
    with pytest.raises(GpuError, match="failed"):
        card.upload("plan", np.zeros(4, np.uint32))


def test_the_process_of_a_card_ends_with_it(adapter: Adapter) -> None:
    card = Card.open(adapter)
    process = card._line._child
    assert process.poll() is None
    del card
    gc.collect()
    assert process.poll() is not None


def test_a_card_that_cannot_be_opened_leaves_the_training_to_the_cpu(scene: Scene, adapter: Adapter) -> None:
    class Refusing:
        limits = {**adapter.handle.limits, "max-storage-buffers-per-shader-stage": 4}

    found = train(scene, QUICK, adapter=replace(adapter, handle=Refusing()))
    assert found.device.startswith(f"{CPU}: {adapter.name} cannot be used: max-storage-buffers-per-shader-stage is 4")
    assert bytes_of(found.gaussians) == bytes_of(train(scene, QUICK).gaussians)


def begun(scene: Scene, config: TrainConfig) -> tuple[TrainingState, PhotoShelf, Schedule]:
    shelf = PhotoShelf(scene)
    gaussians = initialise_gaussians(
        shelf, range(len(scene.cameras)), config.sh_degree, config.max_gaussians, config.seed
    )
    gaussians.log_scales.add_(torch.randn(gaussians.log_scales.shape, generator=torch.Generator().manual_seed(0)) * 0.3)
    state = TrainingState(
        Parameters.start(gaussians),
        GradientStats.none(len(gaussians)),
        Exposures.neutral(len(scene.cameras)) if config.exposure else None,
        Poses.of(scene.cameras) if config.refine_poses else None,
    )
    return state, shelf, Schedule(config, scene)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"antialiased": True},
        {"exposure": True},
        {"refine_poses": True},
        {"load_weight": 0.41},
        {"opacity_weight": 0.1, "scale_weight": 0.1, "flatness_weight": 0.1},
        {"pair_alpha": 20.0},
        {"literal_pairs": True},
    ],
)
def test_steps_on_a_card_are_those_of_the_cpu(change: dict[str, Any], scene: Scene, adapter: Adapter) -> None:
    config = replace(QUICK, steps=2000, coarse_until=0.0, **change)
    found = []
    for make in (Step, lambda schedule: CardStep(schedule, adapter)):
        state, shelf, schedule = begun(scene, config)
        stepper = make(schedule)
        for view in (0, 3, 0):
            stepper.take(state, shelf.picture(view))
        stepper.collect(state)
        found.append(state)
    ours, theirs = found
    assert theirs.step == 3
    torch.testing.assert_close(theirs.parameters.updates, ours.parameters.updates)
    torch.testing.assert_close(theirs.mean_gradients.sums, ours.mean_gradients.sums, rtol=1e-3, atol=1e-6)
    for name in PARAMETERS:
        for table in ("values", "first", "second"):
            own, other = (getattr(each.parameters, table)[name] for each in found)
            assert float((own - other).norm()) <= 2e-3 * float(own.norm()), (name, table)
    if ours.exposures is not None and theirs.exposures is not None:
        assert not np.array_equal(ours.exposures.matrices[3], np.eye(3, 4))
        np.testing.assert_allclose(theirs.exposures.matrices, ours.exposures.matrices, atol=1e-4)
    if ours.poses is not None and theirs.poses is not None:
        assert not np.array_equal(ours.poses.world_to_camera[3], scene.cameras[3].world_to_camera)
        np.testing.assert_allclose(theirs.poses.world_to_camera, ours.poses.world_to_camera, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "joint", "name"),
    [
        ({"densify": "mcmc"}, False, "--train.densify mcmc"),
        ({"forgive": 0.1}, False, "--train.forgive"),
        ({}, True, "--features joint"),
    ],
)
def test_a_setting_without_kernels_for_cards_trains_on_the_cpu_and_is_named(
    change: dict[str, Any], joint: bool, name: str, adapter: Adapter
) -> None:
    config = replace(QUICK, device=adapter.name, **change)
    assert adapter_for(replace(QUICK, device=adapter.name), joint=False)[0] is not None
    assert adapter_for(config, joint=joint) == (
        None,
        f"{name} cannot be computed on a graphics card yet, so the CPU trains",
    )
