"""The model card of the embedded encoder, written from the figures of its training run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fruitlangs.engine.language.vocabulary import COLOURS, CONCEPTS, FRUITS

_CARD = """\
# Embedded encoder: model card

A small convolutional network that gives every pixel of a photo one of {concepts} words, with a calibrated
probability. It ships with FruitLangs, needs no download and no GPU, and takes about a third of a CPU second for a
480×360 photo. Written by `scripts/train_encoder.py`; the figures below are of the weights beside this card.

Words: {words}; colours, measured from the pixels and not learnt: {colours}.

## Figures

{table}

- *Photos*: validation photos, ranking of pixels by the probability of "fruit": AUC and average precision. Positive: the
  central 0.6 ellipse of each box; negative: outside 1.1 times every box. Boxes are weak labels and fruit of background
  rows is often unboxed, so these are lower bounds.
- *Pasted word*: fruit of one validation set pasted into photos of the other sets; share of its pixels whose likeliest
  fruit word, of all {fruits}, is right.
- *Renders*: synthetic scenes kept out of training; the fruit's word at P ≥ 0.5 against exact masks, also asked of
  scenes with another fruit. As in use, a scene's kinds of fruit are weighed by their shares of all its pictures. The
  word "fruit" alone: IoU {fruit_iou:.3f}.
- Calibration of single pixels on held-out renders: expected calibration error of "fruit" {ece:.3f} (pixels with
  P ≥ 0.05); temperature {pixel_temperature:.3f}, bias {pixel_bias:.3f}; temperature of the kind of fruit
  {kind_temperature:.3f}.
{lifted}
Trained in {number} (a later run goes on from the weights of the earlier one, and is repeatable only from
those); {held_out} renders of the last one's scenes were held out from it.

{runs}

The commands of such a run, and of calibrating its weights on rendered walks that were counted, each with the
`gaussians.ply` of its count beside its `sparse/` (CONTRIBUTING.md has every step):

    python scripts/make_orchard.py --scenes 1300:1347 --out RENDERS
    python scripts/train_encoder.py --renders RENDERS --photos PHOTOS --steps 6000 --out NEW/embedded.safetensors
    python scripts/train_encoder.py --renders RENDERS --photos PHOTOS --lifted WALKS --steps 0 \\
        --start NEW/embedded.safetensors --out CALIBRATED/embedded.safetensors

Calibrations were fitted on the held-out renders, the validation photos and the rendered walks, so the calibration error
and the overlap of Gaussians are of the data they were fitted on.
Seeds of the rendered scenes are listed in the JSON file beside the weights and in the weights' header; they
start at 1000, and the sample orchard and the test scenes are not among them.

## Data and credits

Rendered scenes come from `scripts/make_orchard.py` of this repository. The photos are not part of FruitLangs. Three
sets were used, all under the Creative Commons Attribution 4.0 International licence
(https://creativecommons.org/licenses/by/4.0/); no endorsement by their authors is implied. Changes: 640×640 tiles were
selected, re-encoded as JPEG without EXIF, boxes were converted from YOLO text to pixel corners and slivers under 2 px
dropped; in training they were cropped, scaled, recoloured, blurred and mixed by pasting.

- **AppleBBCH81** (apples on trees, LatHort orchard, Dobele, Latvia; Kaggle account projectlzp201910094, 2024),
  https://www.kaggle.com/datasets/projectlzp201910094/applebbch81, by way of
  https://github.com/ai-agriculture-circuits-and-systems/AppleBBCH81. Described in "Autonomous Yield Estimation System
  for Small Commercial Orchards Using UAV and AI", Drones 2024, 8(12), 734, doi 10.3390/drones8120734.
- **Pear640** (pears on trees), https://www.kaggle.com/datasets/projectlzp201910094/pear640, by way of
  https://github.com/ai-agriculture-circuits-and-systems/Pear640. Sergejs Kodors, Marks Sondors, Gunārs Lācis, Edgars
  Rubauskis, Ilmārs Apeināns, Imants Zarembo, "Rapid prototyping of pear detection neural network with YOLO architecture
  in photographs", Environment. Technology. Resources., Rezekne 2023, vol. 1, pp. 81-85, doi 10.17770/etr2023vol1.7293.
- **CherryBBCH81** (mostly green cherry fruitlets, LatHort orchard, Dobele, Latvia),
  https://www.kaggle.com/datasets/projectlzp201910094/cfruitlets81-640, by way of
  https://github.com/ai-agriculture-circuits-and-systems/CherryBBCH81. Ilmārs Apeināns, Marks Sondors, Lienīte
  Litavniece, Sergejs Kodors, Imants Zarembo, Daina Feldmane, "Cherry Fruitlet Detection using YOLOv5 or YOLOv8?",
  Environment. Technology. Resources., Rezekne 2024, vol. 2, pp. 29-33, doi 10.17770/etr2024vol2.8013.

## Limits

- Real photos taught it apples, pears and cherries from one region and season; it knows other fruit from renders only.
- Words of the surroundings (leaf, branch, trunk, soil, grass, sky, post) come from renders; in photos they were only
  known as "no fruit".
- Small green fruit in shade is missed often, touching fruit merges, glossy branches may light up.
- It names a fruit by what 10 to 250 pixels of it look like; fruit below about 8 pixels is not seen.
- Any other object is "background" or one of the words above; there is no word for people, nets, tools or animals.
"""


def write_card(path: Path, document: Mapping[str, Any]) -> str:
    """Write the card; returns its table of figures."""
    table = _table(document["measures"])
    text = _CARD.format(
        concepts=len(CONCEPTS),
        words=", ".join(CONCEPTS),
        colours=", ".join(COLOURS),
        fruits=len(FRUITS),
        table=table,
        ece=document["measures"]["calibration_error"] or 0.0,
        pixel_temperature=document["pixel_calibration"]["temperature"],
        pixel_bias=document["pixel_calibration"]["bias"],
        lifted=_lifted(document),
        kind_temperature=document["calibration"]["kind_temperature"],
        fruit_iou=document["measures"]["fruit_iou"] or 0.0,
        number="one run" if len(document["runs"]) == 1 else f"{len(document['runs'])} runs",
        runs=_runs(document["runs"]),
        held_out=document["held_out_renders"],
    )
    path.write_text(text, encoding="utf-8")
    return table


def _runs(runs: Sequence[Mapping[str, Any]]) -> str:
    rows = ["| run | steps | highest rate | seed | photos | renders | repeatable |", "|---|---|---|---|---|---|---|"]
    for number, run in enumerate(runs, start=1):
        again = "yes" if run["repeatable"] else "no: ended by the clock"
        cells = (number, run["steps"], run["rate"], run["seed"], run["photos"], run["renders"], again)
        rows.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(rows)


def _lifted(document: Mapping[str, Any]) -> str:
    if document["lifted_iou"] is None:
        return "- The weights carry this calibration of pixels; none was made on lifted Gaussians.\n"
    calibration = document["calibration"]
    return (
        "- The weights carry another calibration, made where it is used: on Gaussians of rendered walks, into which\n"
        f"  the features of many views were lifted: temperature {calibration['temperature']:.3f}, bias "
        f"{calibration['bias']:.3f}. There the Gaussians with\n  P(fruit) ≥ 0.5 and the true ones overlap by IoU "
        f"{document['lifted_iou']:.3f}.\n"
    )


def _table(measures: Mapping[str, Any]) -> str:
    rows = [
        "| fruit | photos: AUC / AP | pasted word | renders: IoU | precision | recall |",
        "|---|---|---|---|---|---|",
    ]
    for fruit in FRUITS:
        photo, render = measures["photos"].get(fruit), measures["renders"].get(fruit)
        cells = [
            fruit,
            f"{photo['auc']:.3f} / {photo['average_precision']:.3f}" if photo else "–",
            f"{measures['pasted_word'][fruit]:.2f}" if fruit in measures["pasted_word"] else "–",
            *(f"{render[name]:.3f}" if render else "–" for name in ("iou", "precision", "recall")),
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)
