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

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning threads triple the time of a step on a busy machine

import torch

from _terminal import import_tyro, run
from fruitlangs.engine.errors import ConfigError, EncoderError
from fruitlangs.engine.language.encoders.embedded import Calibration, EmbeddedEncoder, read_weights, save_weights
from fruitlangs.engine.language.encoders.network import DEPTHS, WIDTHS, Network
from fruitlangs.engine.language.vocabulary import CONCEPTS
from fruitlangs.fitting.encoder.batches import Material
from fruitlangs.fitting.encoder.calibration import calibrate
from fruitlangs.fitting.encoder.card import write_card
from fruitlangs.fitting.encoder.learning import Course, check_course, learn
from fruitlangs.fitting.encoder.lifted import (
    FRUIT_SHARE,
    calibrate_lifted,
    lifted_measures,
    lifted_scene,
    rendered_scenes,
)
from fruitlangs.fitting.encoder.measures import Unseen, halves, measure
from fruitlangs.fitting.encoder.pasting import cut_fruit
from fruitlangs.fitting.encoder.pictures import Picture, plain_pictures, read_photos, read_renders, training_seeds
from fruitlangs.fitting.encoder.samples import sample
from fruitlangs.fitting.encoder.widening import widened
from fruitlangs.orchard.training_scenes import is_held_out

tyro = import_tyro()


@dataclass(frozen=True, kw_only=True)
class Options(Course):
    """What to train on and for how long."""

    renders: Path | None = None
    """Folder of rendered training scenes and trees."""
    photos: Path
    """Folder of photo sets with annotations.csv."""
    start: Path | None = None
    """Weights of an earlier run to continue from, of this or an earlier vocabulary and of this size or a smaller one;
    random without it."""
    out: Path
    """Weights to write; OUT with suffix .json and MODEL_CARD.md are written next to it."""


@dataclass(frozen=True)
class Past:
    """The origin of weights: the runs, and the seeds of all scenes that they were trained or calibrated on."""

    runs: list[dict[str, Any]]
    seeds: list[int]


@dataclass(frozen=True, eq=False)
class Pictures:
    """All pictures for training, measurement and calibration."""

    material: Material
    val_photos: Sequence[Picture]
    held_out: Sequence[Picture]
    rendered_scenes: Sequence[Path]
    seeds: Sequence[int]


def main(options: Options) -> None:
    check_course(options)
    if options.start is None and not options.learns:
        raise ConfigError("--steps 0 only calibrates earlier weights: name them by --start, or give steps to train")
    torch.manual_seed(options.seed)
    pictures = read_pictures(options)
    network = Network(len(CONCEPTS), widths=WIDTHS, depths=DEPTHS)
    past = resume(network, options.start) if options.start else Past([], [])
    check_unseen(pictures.held_out, past)
    steps = learn(network, pictures.material, options)
    judge(network, pictures, made_by(past, pictures, options, steps), options.out)


def read_pictures(options: Options) -> Pictures:
    """Read the photos and the renders, and cut out the fruit of those for training."""
    photos, renders = read_photos(options.photos, "train"), read_renders(options.renders) if options.renders else []
    lifted = rendered_scenes(options.renders) if options.renders else []
    learnt, held_out = split_scenes(renders)
    rendered = [options.renders / name for name in {p.source for p in learnt}] if options.renders else []
    seeds = training_seeds([*rendered, *lifted])
    material = Material(photos, learnt, cut_fruit([*photos, *learnt]))
    print(f"{len(photos)} photos, {len(learnt)} renders to train on, {len(held_out)} held out", flush=True)
    print("cutouts by fruit:", [len(cutouts) for cutouts in material.bank], flush=True)
    return Pictures(material, read_photos(options.photos, "val"), held_out, lifted, seeds)


def made_by(past: Past, pictures: Pictures, options: Options, steps: int) -> Past:
    """The origin of the weights, with this run if it took steps."""
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
    """Calibrate the network, measure it on held-out pictures, and write weights, figures and card.

    Until then the weights are in a separate file, `OUT.draft.safetensors`.
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
    scenes = [
        scene
        for rendered_scene in pictures.rendered_scenes
        if (scene := lifted_scene(encoder, rendered_scene)).is_informative
    ]
    calibration = calibrate_lifted(scenes, pixels.calibration).calibration if scenes else pixels.calibration
    overlap = lifted_measures(scenes, pixels.calibration)
    opened(calibration)
    draft.replace(out)
    document = {
        **asdict(past),
        "held_out_renders": len(pictures.held_out),
        "calibration": asdict(calibration),
        "pixel_calibration": asdict(pixels.calibration),
        "lifted": {"walks": len(scenes), "fruit_share": FRUIT_SHARE, **(asdict(overlap) if overlap else {})},
        "measures": measures.document(),
    }
    out.with_suffix(".json").write_text(json.dumps(document, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    print(write_card(out.parent / "MODEL_CARD.md", document))


def resume(network: Network, start: Path) -> Past:
    """Load earlier weights into `network`, which may be larger and know more words. Returns their origin.

    Raises:
        EncoderError: they cannot be read, are of a larger network, or do not record what made them.
    """
    stored = read_weights(start)
    try:
        network.load_state_dict(widened(stored, network))
    except ValueError as error:
        raise EncoderError(f"The weights {start} are of a larger network. Start from weights of this script") from error
    try:
        return Past(stored.notes["runs"], stored.notes["seeds"])
    except KeyError as error:
        raise EncoderError(
            f"The weights {start} do not record the {error.args[0]} behind them. Start from weights of this script"
        ) from error


def split_scenes(pictures: Sequence[Picture]) -> tuple[list[Picture], list[Picture]]:
    """Pictures for training, and those of the scenes whose seeds are held out (see `orchard.training_scenes`)."""
    sides: tuple[list[Picture], list[Picture]] = ([], [])
    for picture in pictures:
        sides[picture.seed is not None and is_held_out(picture.seed)].append(picture)
    return sides


def check_unseen(held_out: Sequence[Picture], past: Past) -> None:
    """Refuse to measure on scenes that earlier runs were trained on.

    Raises:
        ConfigError: naming the scenes.
    """
    seen = sorted({picture.seed for picture in held_out if picture.seed in past.seeds})
    if seen:
        raise ConfigError(
            f"Earlier runs of the weights in --start learnt from seed {', '.join(map(str, seen))}, which are to be "
            "measured on. Take these scenes out of the folder of --renders"
        )


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
