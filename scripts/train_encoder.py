"""Train the embedded encoder on rendered orchards and a folder of photos, and write its weights and model card.

PHOTOS holds one folder a set, each with `images/` and `annotations.csv` (image, split, label, xmin, ymin, xmax, ymax;
split train or val; boxes in pixels). RENDERS holds one folder a scene, as scripts/make_orchard.py writes them with
class masks. The same inputs, seed and number of steps give the same weights on the same machine.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import _checkout  # noqa: F401

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning threads triple a step's cost on a busy machine

import numpy as np
import torch
from encoder.batches import Material, make_batch
from encoder.card import write_card
from encoder.lifted import calibrate_lifted, intersection_over_union, lifted_scene, walks
from encoder.losses import concept_loss
from encoder.measures import calibrate, measure, sample
from encoder.pasting import cut_fruit
from encoder.pictures import Picture, read_photos, read_renders, training_seeds
from safetensors import safe_open
from safetensors.torch import load_file

from _terminal import import_tyro, run
from fruitlangs.engine.errors import ConfigError, EncoderError
from fruitlangs.engine.language.embedded import Calibration, EmbeddedEncoder, save_weights
from fruitlangs.engine.language.network import DEPTHS, WIDTHS, Network, normalise
from fruitlangs.engine.language.vocabulary import CONCEPTS

tyro = import_tyro()

HELD_OUT_EVERY = 8
"""Every n-th render scene is kept out of training, to calibrate and to measure on."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to train on and for how long."""

    renders: Path | None = None
    """Folder of rendered training scenes."""
    photos: Path
    """Folder of photo sets with annotations.csv."""
    lifted: Path | None = None
    """Folder of rendered walks with the gaussians.ply trained from each, to calibrate on Gaussians that many views
    drew; without it the calibration is that of single pixels."""
    start: Path | None = None
    """Weights of an earlier run to go on from; without it the network starts at random."""
    out: Path
    """Weights to write; OUT with suffix .json and MODEL_CARD.md are written beside it."""
    steps: int = 6000
    """Optimiser steps; 0 only calibrates and measures the weights of --start anew."""
    minutes: float | None = None
    """Stop after this many minutes instead, with the learning rate ended by then; not reproducible to the byte."""
    batch: int = 8
    """Crops a step."""
    rate: float = 2e-3
    """Highest learning rate."""
    threads: int = 2
    """CPU threads; 1 is quicker on a machine that is busy otherwise."""
    bf16: bool = True
    """Compute convolutions in bfloat16 while training."""
    seed: int = 0
    """Seed of the weights and of every crop."""


def main(options: Options) -> None:
    if options.start is None and options.minutes is None and options.steps <= 0:
        raise ConfigError("--steps 0 only calibrates earlier weights: name them by --start, or give steps to train")
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    photos, val_photos = read_photos(options.photos, "train"), read_photos(options.photos, "val")
    pictures = read_renders(options.renders) if options.renders else []
    lifted = walks(options.lifted) if options.lifted else []
    rendered = [options.renders / name for name in {p.source for p in pictures}] if options.renders else []
    seeds = training_seeds([*rendered, *lifted])
    renders, held_out = split_scenes(pictures)
    material = Material(photos, renders, cut_fruit([*photos, *renders]))
    print(f"{len(photos)} photos, {len(renders)} renders to train on, {len(held_out)} held out", flush=True)
    print("cutouts by fruit:", [len(cutouts) for cutouts in material.bank], flush=True)

    network = Network(len(CONCEPTS), widths=WIDTHS, depths=DEPTHS)
    earlier = resume(network, options.start) if options.start else Past([], [])
    steps = train(network, material, options)
    draft = options.out.with_suffix(".draft.safetensors")
    this_run = {
        "steps": steps,
        "seed": options.seed,
        "rate": options.rate,
        "photos": len(photos),
        "renders": len(renders),
        "repeatable": options.minutes is None,
    }
    notes = {
        "seeds": sorted({*earlier.seeds, *seeds}),
        "runs": [*earlier.runs, this_run] if steps else earlier.runs,
    }

    def opened(calibration: Calibration) -> EmbeddedEncoder:
        save_weights(draft, network, calibration, widths=WIDTHS, depths=DEPTHS, **notes)
        return EmbeddedEncoder.open(draft)

    encoder = opened(Calibration())
    photo_sample, render_sample = sample(encoder, val_photos), sample(encoder, held_out)
    pixels = calibrate(encoder, photo_sample, render_sample)
    measures = measure(opened(pixels), val_photos, photo_sample, render_sample)
    calibration, overlap = pixels, None
    if lifted:
        scenes = [lifted_scene(encoder, walk) for walk in lifted]
        calibration = calibrate_lifted(scenes, pixels)
        overlap = intersection_over_union(scenes, calibration)
    opened(calibration)
    draft.replace(options.out)
    document = {
        **notes,
        "held_out_renders": len(held_out),
        "calibration": asdict(calibration),
        "pixel_calibration": asdict(pixels),
        "lifted_iou": overlap,
        "measures": measures.document(),
    }
    options.out.with_suffix(".json").write_text(json.dumps(document, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    print(write_card(options.out.parent / "MODEL_CARD.md", document))


@dataclass(frozen=True)
class Past:
    """What made earlier weights: the runs, one after the other, and the seeds of all scenes they saw."""

    runs: list[dict[str, Any]]
    seeds: list[int]


def resume(network: Network, start: Path) -> Past:
    """Load earlier weights into `network`; returns what made them.

    Raises:
        EncoderError: they cannot be read or do not record what made them.
    """
    EmbeddedEncoder.open(start)  # says what is wrong with them
    with safe_open(start, framework="pt") as file:
        header = json.loads(file.metadata()["fruitlangs"])
    network.load_state_dict({name: tensor.float() for name, tensor in load_file(start).items()})
    try:
        return Past(header["runs"], header["seeds"])
    except KeyError as error:
        raise EncoderError(
            f"the weights {start} do not record the {error.args[0]} behind them; start from weights of this script"
        ) from error


def split_scenes(pictures: list[Picture]) -> tuple[list[Picture], list[Picture]]:
    """Training pictures and held-out pictures; every HELD_OUT_EVERY-th scene of each fruit is held out."""
    by_fruit: dict[int, list[str]] = {}
    for picture in pictures:
        fruit = picture.labels[picture.labels < 8]
        kind = int(np.bincount(fruit).argmax()) if fruit.size else -1
        scenes = by_fruit.setdefault(kind, [])
        if not any(picture.source in names for names in by_fruit.values()):
            scenes.append(picture.source)
    held = {name for scenes in by_fruit.values() for name in scenes[2::HELD_OUT_EVERY]}
    return [p for p in pictures if p.source not in held], [p for p in pictures if p.source in held]


def train(network: Network, material: Material, options: Options) -> int:
    """Adam with a one-cycle learning rate; leaves the averaged weights in `network`. Returns the steps taken."""
    rng = np.random.default_rng([options.seed, 1])
    batches = ahead(material, options)
    torch.nn.Module.to(network, memory_format=torch.channels_last)  # type: ignore[call-overload]
    network.train()
    optimiser = torch.optim.AdamW(network.parameters(), lr=options.rate, weight_decay=1e-3, fused=True)
    average = torch.optim.swa_utils.AveragedModel(network, avg_fn=_moving_average, use_buffers=True)
    autocast = torch.autocast("cpu", torch.bfloat16) if options.bf16 else nullcontext()
    losses: list[float] = []
    step = 0
    for done in _fractions(options):
        rise = min(1.0, done / 0.03 + 0.01)
        optimiser.param_groups[0]["lr"] = options.rate * rise * 0.5 * (1 + np.cos(np.pi * done))
        images, labels = next(batches)
        with autocast:
            logits = network(normalise(images).contiguous(memory_format=torch.channels_last))
        down, right = rng.integers(0, 2, size=2)  # the network answers for 2×2 pixels: ask it about each in turn
        loss = concept_loss(logits, labels[:, down::2, right::2])
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        average.update_parameters(network)
        losses.append(float(loss.detach()))
        step += 1
        if step % 100 == 0:
            print(f"step {step} ({done:.0%}) loss {np.mean(losses[-100:]):.4f}", flush=True)
    network.load_state_dict(average.module.state_dict())
    network.eval()
    return step


def ahead(material: Material, options: Options) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Batches without end, each made while the network learns from the one before."""
    rng = np.random.default_rng(options.seed)
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(make_batch, material, options.batch, rng)
        while True:
            batch = coming.result()
            coming = pool.submit(make_batch, material, options.batch, rng)
            yield batch


def _moving_average(average: torch.Tensor, current: torch.Tensor, count: torch.Tensor | int) -> torch.Tensor:
    """Exponential, over about 500 steps, over fewer at the start."""
    if not current.is_floating_point():
        return current
    return current + (average - current) * min(0.998, (1 + int(count)) / (10 + int(count)))


def _fractions(options: Options) -> Iterator[float]:
    start = time.monotonic()
    if options.minutes is None:
        yield from (step / options.steps for step in range(options.steps))
        return
    while (done := (time.monotonic() - start) / (60.0 * options.minutes)) < 1.0:
        yield done


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
