"""Train the embedded encoder on rendered orchards and a folder of photos, and write its weights and model card.

PHOTOS contains one folder per set, each with `images/` and `annotations.csv` (image, split, label, xmin, ymin, xmax,
ymax; split train or val; boxes in pixels). RENDERS contains one folder per scene, written by `scripts/make_orchard.py
--scenes`. Whole trees among them are not trained on: Gaussians are trained from each, for calibration on many views.
The same inputs, seed and number of steps give the same weights on the same machine.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning threads triple the time of a step on a busy machine

from _terminal import import_tyro, run
from fruitlangs.fitting.train_encoder import Options, train_encoder

tyro = import_tyro()

if __name__ == "__main__":
    run(lambda: train_encoder(tyro.cli(Options, description=__doc__)))
