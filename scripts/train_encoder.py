"""Train the embedded encoder on rendered orchards and a folder of photos, and write its weights and model card.

PHOTOS holds one folder a set, each with `images/` and `annotations.csv` (image, split, label, xmin, ymin, xmax, ymax;
split train or val; boxes in pixels). RENDERS holds one folder a scene, as `scripts/make_orchard.py --scenes` writes
them; whole walks among them are not trained on: Gaussians are trained from each, to calibrate on what many views give.
The same inputs, seed and number of steps give the same weights on the same machine.
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
from encoder.calibration import calibrate
from encoder.card import write_card
from encoder.lifted import calibrate_lifted, lifted_measures, lifted_scene, walks
from encoder.losses import concept_loss, overlap_loss
from encoder.measures import Unseen, halves, measure
from encoder.pasting import cut_fruit
from encoder.pictures import Picture, plain_pictures, read_photos, read_renders, training_seeds
from encoder.samples import sample

from _terminal import import_tyro, run
from fruitlangs.engine.errors import ConfigError, EncoderError
from fruitlangs.engine.language.embedded import Calibration, EmbeddedEncoder, read_weights, save_weights
from fruitlangs.engine.language.network import DEPTHS, WIDTHS, Network, normalise
from fruitlangs.engine.language.vocabulary import CONCEPTS, FRUITS

tyro = import_tyro()

HELD_OUT_EVERY = 8
"""Every n-th render scene is kept out of training, to calibrate and to measure on."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to train on and for how long."""

    renders: Path | None = None
    """Folder of rendered training scenes and walks."""
    photos: Path
    """Folder of photo sets with annotations.csv."""
    start: Path | None = None
    """Weights of an earlier run to go on from, of this or an earlier vocabulary; without it all starts at random."""
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
    lifted = walks(options.renders) if options.renders else []
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
    unseen = Unseen(val_photos, held_out, *(sample(encoder, each) for each in (val_photos, held_out, plain_pictures())))
    fitted, judged = halves(unseen)
    pixels = calibrate(encoder, fitted.photo_samples, fitted.render_samples)
    measures = measure(opened(pixels.calibration), unseen, judged, pixels)
    scenes = [lifted_scene(encoder, walk) for walk in lifted]
    calibration = calibrate_lifted(scenes, pixels.calibration).calibration if scenes else pixels.calibration
    overlap = lifted_measures(scenes, pixels.calibration)
    opened(calibration)
    draft.replace(options.out)
    document = {
        **notes,
        "held_out_renders": len(held_out),
        "calibration": asdict(calibration),
        "pixel_calibration": asdict(pixels.calibration),
        "lifted": asdict(overlap) if overlap else None,
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
    """Load earlier weights into `network`; words that they do not know start at random. Returns what made them.

    Raises:
        EncoderError: they cannot be read, are of another size, or do not record what made them.
    """
    stored = read_weights(start)
    if (stored.widths, stored.depths) != (WIDTHS, DEPTHS):
        raise EncoderError(f"the weights {start} are of a network of another size; start from weights of this script")
    tensors = dict(stored.tensors)
    for name in ("head.weight", "head.bias"):
        rows = network.state_dict()[name].clone()
        for row, word in enumerate(CONCEPTS):
            if word in stored.concepts:
                rows[row] = tensors[name][stored.concepts.index(word)]
        tensors[name] = rows
    network.load_state_dict(tensors)
    try:
        return Past(stored.notes["runs"], stored.notes["seeds"])
    except KeyError as error:
        raise EncoderError(
            f"the weights {start} do not record the {error.args[0]} behind them; start from weights of this script"
        ) from error


def split_scenes(pictures: list[Picture]) -> tuple[list[Picture], list[Picture]]:
    """Training pictures and held-out pictures; every HELD_OUT_EVERY-th scene of each fruit is held out."""
    by_fruit: dict[int, list[str]] = {}
    for picture in pictures:
        fruit = picture.labels[picture.labels < len(FRUITS)]
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
        shown = labels[:, down::2, right::2]
        loss = concept_loss(logits, shown) + overlap_loss(logits, shown)
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
