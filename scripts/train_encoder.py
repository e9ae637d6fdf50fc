"""Train the embedded encoder on rendered orchards and a folder of photos, and write its weights and model card.

PHOTOS holds one folder a set, each with `images/` and `annotations.csv` (image, split, label, xmin, ymin, xmax, ymax;
split train or val; boxes in pixels). RENDERS holds one folder a scene, as `scripts/make_orchard.py --scenes` writes
them; whole walks among them are not trained on: Gaussians are trained from each, to calibrate on what many views give.
The same inputs, seed and number of steps give the same weights on the same machine.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import _checkout  # noqa: F401

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning threads triple a step's cost on a busy machine

import numpy as np
import torch
from encoder.batches import Material
from encoder.calibration import calibrate
from encoder.card import write_card
from encoder.learning import Course, learn
from encoder.lifted import calibrate_lifted, lifted_measures, lifted_scene, walks
from encoder.measures import Unseen, halves, measure
from encoder.pasting import cut_fruit
from encoder.pictures import Picture, plain_pictures, read_photos, read_renders, training_seeds
from encoder.samples import sample
from encoder.widening import widened

from _terminal import import_tyro, run
from fruitlangs.engine.errors import ConfigError, EncoderError
from fruitlangs.engine.language.embedded import Calibration, EmbeddedEncoder, read_weights, save_weights
from fruitlangs.engine.language.network import DEPTHS, WIDTHS, Network
from fruitlangs.engine.language.vocabulary import CONCEPTS, FRUITS

tyro = import_tyro()

HELD_OUT_EVERY = 8
"""Every n-th render scene is kept out of training, to calibrate and to measure on."""


@dataclass(frozen=True, kw_only=True)
class Options(Course):
    """What to train on and for how long."""

    renders: Path | None = None
    """Folder of rendered training scenes and walks."""
    photos: Path
    """Folder of photo sets with annotations.csv."""
    start: Path | None = None
    """Weights of an earlier run to go on from, of this or an earlier vocabulary and of this size or a smaller one;
    without it all starts at random."""
    out: Path
    """Weights to write; OUT with suffix .json and MODEL_CARD.md are written beside it."""


@dataclass(frozen=True)
class Past:
    """What made weights: the runs, one after the other, and the seeds of all scenes they saw."""

    runs: list[dict[str, Any]]
    seeds: list[int]


@dataclass(frozen=True, eq=False)
class Pictures:
    """All that is learnt from, measured on and calibrated on."""

    material: Material
    val_photos: Sequence[Picture]
    held_out: Sequence[Picture]
    walks: Sequence[Path]
    seeds: Sequence[int]


def main(options: Options) -> None:
    if options.start is None and options.minutes is None and options.steps <= 0:
        raise ConfigError("--steps 0 only calibrates earlier weights: name them by --start, or give steps to train")
    torch.manual_seed(options.seed)
    pictures = read_pictures(options)
    network = Network(len(CONCEPTS), widths=WIDTHS, depths=DEPTHS)
    past = resume(network, options.start) if options.start else Past([], [])
    steps = learn(network, pictures.material, options) if options.steps or options.minutes else 0
    judge(network, pictures, made_by(past, pictures, options, steps), options.out)


def read_pictures(options: Options) -> Pictures:
    """Read the photos and the renders, and cut the fruit out of those that are trained on."""
    photos, renders = read_photos(options.photos, "train"), read_renders(options.renders) if options.renders else []
    lifted = walks(options.renders) if options.renders else []
    rendered = [options.renders / name for name in {p.source for p in renders}] if options.renders else []
    seeds = training_seeds([*rendered, *lifted])
    learnt, held_out = split_scenes(renders)
    material = Material(photos, learnt, cut_fruit([*photos, *learnt]))
    print(f"{len(photos)} photos, {len(learnt)} renders to train on, {len(held_out)} held out", flush=True)
    print("cutouts by fruit:", [len(cutouts) for cutouts in material.bank], flush=True)
    return Pictures(material, read_photos(options.photos, "val"), held_out, lifted, seeds)


def made_by(past: Past, pictures: Pictures, options: Options, steps: int) -> Past:
    """What made the weights, with this run when it took steps."""
    this_run = {
        "steps": steps,
        "processes": options.processes,
        "seed": options.seed,
        "rate": options.rate,
        "photos": len(pictures.material.photos),
        "renders": len(pictures.material.renders),
        "repeatable": options.minutes is None,
    }
    runs = [*past.runs, this_run] if steps else past.runs
    return Past(runs, sorted({*past.seeds, *pictures.seeds}))


def judge(network: Network, pictures: Pictures, past: Past, out: Path) -> None:
    """Calibrate the network, measure it on what it has not seen, and write weights, figures and card.

    Until all of it is done the weights stand in a file of their own, `OUT.draft.safetensors`.
    """
    draft = out.with_suffix(".draft.safetensors")

    def opened(calibration: Calibration) -> EmbeddedEncoder:
        save_weights(draft, network, calibration, widths=WIDTHS, depths=DEPTHS, **asdict(past))
        return EmbeddedEncoder.open(draft)

    encoder = opened(Calibration())
    unseen = Unseen(
        pictures.val_photos,
        pictures.held_out,
        *(sample(encoder, each) for each in (pictures.val_photos, pictures.held_out, plain_pictures())),
    )
    fitted, judged = halves(unseen)
    pixels = calibrate(encoder, fitted.photo_samples, fitted.render_samples)
    measures = measure(opened(pixels.calibration), unseen, judged, pixels)
    scenes = [lifted_scene(encoder, walk) for walk in pictures.walks]
    calibration = calibrate_lifted(scenes, pixels.calibration).calibration if scenes else pixels.calibration
    overlap = lifted_measures(scenes, pixels.calibration)
    opened(calibration)
    draft.replace(out)
    document = {
        **asdict(past),
        "held_out_renders": len(pictures.held_out),
        "calibration": asdict(calibration),
        "pixel_calibration": asdict(pixels.calibration),
        "lifted": asdict(overlap) if overlap else None,
        "measures": measures.document(),
    }
    out.with_suffix(".json").write_text(json.dumps(document, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    print(write_card(out.parent / "MODEL_CARD.md", document))


def resume(network: Network, start: Path) -> Past:
    """Load earlier weights into `network`, which may be larger and know more words. Returns what made them.

    Raises:
        EncoderError: they cannot be read, are of a larger network, or do not record what made them.
    """
    stored = read_weights(start)
    try:
        network.load_state_dict(widened(stored, network))
    except ValueError as error:
        raise EncoderError(f"the weights {start} are of a larger network; start from weights of this script") from error
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


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
