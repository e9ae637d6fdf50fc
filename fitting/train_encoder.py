"""A training run of the embedded encoder: train, calibrate, measure, and write weights and model card."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from ..engine.errors import ConfigError, EncoderError
from ..engine.language.encoders.embedded import Calibration, EmbeddedEncoder, read_weights, save_weights
from ..engine.language.encoders.network import DEPTHS, WIDTHS, Network
from ..engine.language.vocabulary import CONCEPTS
from ..orchard.training_scenes import is_held_out
from .encoder.batches import Material
from .encoder.calibration import calibrate
from .encoder.card import write_card
from .encoder.learning import Course, check_course, learn
from .encoder.lifted import FRUIT_SHARE, calibrate_lifted, find_rendered_scenes, lift_scene, measure_lifted
from .encoder.measures import Unseen, measure, split_halves
from .encoder.pasting import cut_fruit, cut_objects
from .encoder.pictures import Picture, make_plain_pictures, read_photos, read_renders, training_seeds
from .encoder.samples import sample
from .encoder.widening import widen


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


def train_encoder(options: Options) -> None:
    """Train, calibrate and measure, and write weights, figures and model card.

    Raises:
        ConfigError: the options contradict each other, or a picture to measure on was trained on.
        EncoderError: the weights to start from cannot be used.
    """
    check_course(options)
    if options.start is None and not options.learns:
        raise ConfigError("--steps 0 only calibrates earlier weights: name them by --start, or give steps to train")
    torch.manual_seed(options.seed)
    pictures = read_pictures(options)
    network = Network(len(CONCEPTS), widths=WIDTHS, depths=DEPTHS)
    past = resume(network, options.start) if options.start else Past([], [])
    check_unseen(pictures.held_out, past)
    steps = learn(network, pictures.material, options)
    judge(network, pictures, describe_origin(past, pictures, options, steps), options.out)


def read_pictures(options: Options) -> Pictures:
    """Read the photos and the renders, and cut out the fruit of those for training."""
    photos, renders = read_photos(options.photos, "train"), read_renders(options.renders) if options.renders else []
    lifted = find_rendered_scenes(options.renders) if options.renders else []
    learnt, held_out = split_scenes(renders)
    rendered = [options.renders / name for name in {p.source for p in learnt}] if options.renders else []
    seeds = training_seeds([*rendered, *lifted])
    material = Material(photos, learnt, cut_fruit([*photos, *learnt]), cut_objects(learnt))
    print(f"{len(photos)} photos, {len(learnt)} renders to train on, {len(held_out)} held out", flush=True)
    by_fruit = [len(cutouts) for cutouts in material.bank]
    print(f"cutouts by fruit: {by_fruit} of objects: {len(material.objects)}", flush=True)
    return Pictures(material, read_photos(options.photos, "val"), held_out, lifted, seeds)


def describe_origin(past: Past, pictures: Pictures, options: Options, steps: int) -> Past:
    """Return the origin of the weights, with this run if it took steps."""
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

    def open_encoder(calibration: Calibration) -> EmbeddedEncoder:
        save_weights(draft, network, calibration, widths=WIDTHS, depths=DEPTHS, **asdict(past))
        return EmbeddedEncoder.open(draft)

    encoder = open_encoder(Calibration())
    unseen = Unseen(
        pictures.val_photos,
        pictures.held_out,
        *(sample(encoder, each) for each in (pictures.val_photos, pictures.held_out, make_plain_pictures())),
    )
    fitted, judged = split_halves(unseen)
    pixels = calibrate(encoder, fitted.photo_samples, fitted.render_samples)
    measures = measure(open_encoder(pixels.calibration), unseen, judged, pixels)
    scenes = [
        scene
        for rendered_scene in pictures.rendered_scenes
        if (scene := lift_scene(encoder, rendered_scene)).is_informative
    ]
    calibration = calibrate_lifted(scenes, pixels.calibration).calibration if scenes else pixels.calibration
    overlap = measure_lifted(scenes, pixels.calibration)
    open_encoder(calibration)
    draft.replace(out)
    document = {
        **asdict(past),
        "held_out_renders": len(pictures.held_out),
        "calibration": asdict(calibration),
        "pixel_calibration": asdict(pixels.calibration),
        "lifted": {"scenes": len(scenes), "fruit_share": FRUIT_SHARE, **(asdict(overlap) if overlap else {})},
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
        network.load_state_dict(widen(stored, network))
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
