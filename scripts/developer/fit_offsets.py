"""Train where on its fruit each pixel lies, and write engine/language/encoders/weights/offsets.safetensors.

    python scripts/developer/fit_offsets.py --renders RENDERS --photos PHOTOS
    python scripts/developer/fit_offsets.py --renders TREES --photos PHOTOS --start WEIGHTS

Learns from the views of rendered scenes and from photos with boxes, on features of the package's encoder, which stays
as it is. Train it again after scripts/developer/train_encoder.py.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401  puts the checkout on the path

from _terminal import import_tyro, run, say
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.language.encoders.offsets import STORED, read_offsets, save_offsets
from fruitlangs.engine.storage.files import read_tensors
from fruitlangs.fitting.encoder.lifted import find_finished_scenes
from fruitlangs.fitting.encoder.offset_learning import learn_offsets, read_offset_renders, select_offset_photos
from fruitlangs.fitting.encoder.pictures import read_photos, training_seeds

tyro = import_tyro()


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to learn from, and how long."""

    renders: Path
    """Folder of rendered scenes and trees, written by `make_orchard.py`."""
    photos: Path
    """Folder of photo sets with annotations.csv."""
    start: Path | None = None
    """Weights to train on from; if not given, the training starts from scratch."""
    out: Path = STORED
    """File to write."""
    steps: int = 4000
    """Optimiser steps."""
    seed: int = 0
    """Seed of all random numbers."""


def main(options: Options) -> None:
    scenes = find_finished_scenes(options.renders)
    seeds = training_seeds(scenes)
    renders, photos = (
        list(read_offset_renders(options.renders)),
        select_offset_photos(read_photos(options.photos, "train")),
    )
    say(f"{len(renders)} views of {len(scenes)} scenes, {len(photos)} photos")
    encoder = EmbeddedEncoder.open()
    start = None
    if options.start is not None:
        start = read_offsets(encoder.identity, options.start)
        seeds = sorted({*seeds, *read_tensors(options.start)[1]["seeds"]})
    network = learn_offsets(
        encoder.network, renders, photos, steps=options.steps, seed=options.seed, start=start, report=say
    )
    save_offsets(options.out, network, encoder.identity, seeds=seeds, steps=options.steps)


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
