"""The training loop: one network, trained by several processes that share gradients."""

from __future__ import annotations

import copy
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, distributed

from ...engine.errors import ConfigError
from ...engine.language.encoders.network import Network, normalise
from .batches import Material, make_batch
from .losses import concept_loss, overlap_loss

Batch = TypeVar("Batch")

MEMORY = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(1 << 33), "MALLOC_TOP_PAD_": str(1 << 28)}
"""Settings of glibc for the processes: memory freed by a step is kept for the next one, which is a tenth faster."""
REPORT_EVERY = 100
RISE = 0.03
"""Share of the training in which the learning rate rises; then it falls as a cosine."""
AVERAGED_STEPS = 500
"""The written weights are the mean of about this many last steps."""


@dataclass(frozen=True, kw_only=True)
class Course:
    """Length and settings of the training."""

    steps: int = 6000
    """Optimiser steps; 0 only calibrates and measures the weights of --start."""
    minutes: float | None = None
    """Stop after this many minutes, with the learning rate ended by then; not reproducible to the byte."""
    batch: int = 8
    """Crops per step and process."""
    processes: int = 2
    """Processes of one thread and one batch each; one per CPU core is fastest."""
    rate: float = 2e-3
    """Highest learning rate."""
    bf16: bool = True
    """Compute convolutions in bfloat16 while training."""
    seed: int = 0
    """Seed of the weights and of every crop."""

    @property
    def learns(self) -> bool:
        return self.minutes is not None or self.steps > 0


def learn(network: Network, material: Material, course: Course) -> int:
    """AdamW with a one-cycle learning rate; writes the averaged weights to `network`. Returns the number of steps.

    Raises:
        ConfigError: a number of the course is not one that anything can be learnt with.
    """
    check_course(course)
    if not course.learns:
        return 0
    network.share_memory()
    taken = torch.zeros(1, dtype=torch.int64).share_memory_()
    if course.processes == 1:
        _learn(0, network, material, course, taken)
    else:
        os.environ.update(MEMORY)
        with tempfile.TemporaryDirectory() as folder:
            meeting = (Path(folder) / "meeting").as_uri()
            torch.multiprocessing.spawn(_join, (network, material, course, taken, meeting), nprocs=course.processes)
    network.eval()
    return int(taken)


def check_course(course: Course) -> None:
    """Refuse a training without steps or without end.

    Raises:
        ConfigError: naming the setting and what it can be.
    """
    least = {"steps": 0, "batch": 1, "processes": 1}
    for name, value in least.items():
        if getattr(course, name) < value:
            raise ConfigError(f"--{name} {getattr(course, name)}: give at least {value}")
    if course.minutes is not None and not course.minutes > 0:
        raise ConfigError(f"--minutes {course.minutes:g}: give more than 0, or --steps")
    if not course.rate > 0:
        raise ConfigError(f"--rate {course.rate:g}: give more than 0")


def _join(rank: int, network: Network, material: Material, course: Course, taken: Tensor, meeting: str) -> None:
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", init_method=meeting, rank=rank, world_size=course.processes)
    try:
        _learn(rank, network, material, course, taken)
    finally:
        distributed.destroy_process_group()


def _learn(rank: int, shared: Network, material: Material, course: Course, taken: Tensor) -> None:
    """The part of one process. The first process writes the weights, which all share, to `shared`."""
    network = copy.deepcopy(shared)
    torch.nn.Module.to(network, memory_format=torch.channels_last)  # type: ignore[call-overload]
    network.train()
    rng = np.random.default_rng([course.seed, 1, rank])
    drawn = np.random.default_rng([course.seed, 0, rank])
    batches = make_ahead(lambda: make_batch(material, course.batch, drawn))
    optimiser = torch.optim.AdamW(network.parameters(), lr=course.rate, weight_decay=1e-3, fused=True)
    average = torch.optim.swa_utils.AveragedModel(network, avg_fn=_average, use_buffers=True)
    autocast = torch.autocast("cpu", torch.bfloat16) if course.bf16 else nullcontext()
    losses: list[float] = []
    start, step, done = time.monotonic(), 0, 0.0
    while done < 1.0:
        optimiser.param_groups[0]["lr"] = course.rate * rate_share(done)
        images, labels = next(batches)
        with autocast:
            logits = network(normalise(images).contiguous(memory_format=torch.channels_last))
        down, right = rng.integers(
            0, 2, size=2
        )  # the network has one output for 2×2 pixels: compare it with each in turn
        shown = labels[:, down::2, right::2]
        log_probability = logits.float().log_softmax(1)
        loss = concept_loss(log_probability, shown) + overlap_loss(log_probability, shown)
        optimiser.zero_grad()
        loss.backward()
        step += 1
        now = step / course.steps if course.minutes is None else (time.monotonic() - start) / (60.0 * course.minutes)
        done = _share_gradient(network, course.processes, now)
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        losses.append(float(loss.detach()))
        if rank == 0:
            average.update_parameters(network)
            if step % REPORT_EVERY == 0:
                print(f"step {step} ({done:.0%}) loss {np.mean(losses[-REPORT_EVERY:]):.4f}", flush=True)
    if rank == 0:
        shared.load_state_dict(average.module.state_dict())
        taken.fill_(step)


def _share_gradient(network: Network, processes: int, done: float) -> float:
    """Give every process the mean gradient; returns the progress of the first process, so that all end together."""
    if processes == 1:
        return done
    gradients = [p.grad for p in network.parameters() if p.grad is not None]
    first = done if distributed.get_rank() == 0 else 0.0
    flat = torch.cat([*(gradient.flatten() for gradient in gradients), torch.tensor([processes * first])])
    distributed.all_reduce(flat)
    flat /= processes
    place = 0
    for gradient in gradients:
        gradient.copy_(flat[place : place + gradient.numel()].view_as(gradient))
        place += gradient.numel()
    return float(flat[-1])


def rate_share(done: float) -> float:
    """The learning rate over its highest, after a share of the training."""
    return float(min(1.0, done / RISE + 0.01) * 0.5 * (1 + np.cos(np.pi * done)))


def make_ahead(make: Callable[[], Batch]) -> Iterator[Batch]:
    """Yield an endless sequence of batches, each made while the network trains on the one before."""
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(make)
        while True:
            ready = coming.result()
            coming = pool.submit(make)
            yield ready


def _average(average: Tensor, current: Tensor, count: Tensor | int) -> Tensor:
    """Compute the exponential moving average over about AVERAGED_STEPS steps, over fewer at the start."""
    if not current.is_floating_point():
        return current
    return current + (average - current) * min(1.0 - 1.0 / AVERAGED_STEPS, (1 + int(count)) / (10 + int(count)))
