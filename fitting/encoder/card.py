"""The model card of the embedded encoder, written from the figures of its training run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ...engine.evaluation.calibration import BINS
from ...engine.language.vocabulary import COLOURS, CONCEPTS, FRUITS, GENERAL
from .render_scores import GUESTS

_PICTURE = "reliability.png"
_CARD = """\
# Embedded encoder: model card

A small convolutional network that gives every pixel of a photo one of {concepts} words, with a calibrated
probability. It ships with FruitLangs, needs no download and no GPU, and takes about half a second of two CPU cores
for a 480×360 photo. Written by `scripts/developer/train_encoder.py`; the figures are those of the weights next to this
card.

Words: {words_known}; colours, measured from the pixels and not learnt: {colours}.

## Figures

All were measured on pictures that were not used for training.

{table}

- *Photos*: validation photos, pixels ranked by the probability of "fruit": AUC and average precision. Positive: the
  central 0.6 ellipse of each box; negative: outside 1.1 times every box. Boxes are weak labels and fruit of background
  rows often has no box, so these are lower bounds; *seen*: without such fruit, 659 places marked by eye (in crowded
  photos by their red colour) and listed in `fitting/encoder/unboxed.csv`; *boxes*: whole boxes against everything else;
  *redness*: the same as the first for red minus green, a colour rule.
- *Pasted word*: fruit of one validation set pasted into photos of the other sets; share of its pixels whose most
  probable fruit word, of all {fruits}, is right.
- *Renders*: IoU, precision and recall of the fruit's word at P ≥ 0.5 against exact masks, also asked of scenes with
  another fruit. As in use, the kinds of fruit of a scene are weighted by their share of all its pictures.

Where fruit is hard to see (renders; "mixed species": {guests} fruit of other kinds pasted into each picture):

{conditions}

How well every word is distinguished from the word it is most often confused with: the AUC of its probability on its
pixels against those of the other; {general} stand for several words and are compared
with the others. Colours are measured on the named colours of the XKCD survey. {judged} words are
evaluated, {good} of them reach 0.8; {unjudged}.

{words}

Calibration of "fruit", single pixels. The error is the expected calibration error in {bins} bins of equal mass, with
fruit and not fruit brought to half of the mass each; the Brier score is the mean squared error of the same. Fitted on
every other photo and scene, measured on the rest.

{reliability}

![Share of fruit among pixels by their probability, renders and photos]({picture})

Temperature {pixel_temperature:.3f}, bias {pixel_bias:.3f}; temperature of the kind of fruit {kind_temperature:.3f}.
{lifted}
## Training

Trained in {number} (a later run continues from the weights of the earlier one and is repeatable only from
those); {held_out} renders were held out from the last one, of scenes whose seeds are reserved for it
(one round through the species of every eleven), so additional renders never add one of them to the training.

{runs}

Two commands generate the renders, train on them, and calibrate on the whole trees among them:

    python scripts/make_orchard.py --scenes 1500:1604 --out RENDERS
    python scripts/developer/train_encoder.py --renders RENDERS --photos PHOTOS --steps 6000 \\
        --out NEW/embedded.safetensors

A second output says where on its fruit each pixel lies, in radii from the centre. It is a network of its own on the
features of this one (`offsets.safetensors`), learnt afterwards from rendered scenes and the same photos:

    python scripts/developer/fit_offsets.py --renders RENDERS --photos PHOTOS

The seeds of the rendered scenes are listed in the JSON file next to the weights and in their header; they start at
1000, and the sample orchard and the test scenes are not among them.

## Data and credits

Rendered scenes come from `scripts/make_orchard.py` of this repository. The photos are not part of FruitLangs. Three
sets were used, all under the Creative Commons Attribution 4.0 International licence
(https://creativecommons.org/licenses/by/4.0/); no endorsement by their authors is implied. Changes: 640×640 tiles were
selected, re-encoded as JPEG without EXIF, boxes were converted from YOLO text to pixel corners and slivers under 2 px
dropped; for training they were cropped, scaled, recoloured, blurred and mixed by pasting.

- **AppleBBCH81** (apples on trees, LatHort orchard, Dobele, Latvia; Kaggle account projectlzp201910094, 2024),
  https://www.kaggle.com/datasets/projectlzp201910094/applebbch81, from
  https://github.com/ai-agriculture-circuits-and-systems/AppleBBCH81. Described in "Autonomous Yield Estimation System
  for Small Commercial Orchards Using UAV and AI", Drones 2024, 8(12), 734, doi 10.3390/drones8120734.
- **Pear640** (pears on trees), https://www.kaggle.com/datasets/projectlzp201910094/pear640, from
  https://github.com/ai-agriculture-circuits-and-systems/Pear640. Sergejs Kodors, Marks Sondors, Gunārs Lācis, Edgars
  Rubauskis, Ilmārs Apeināns, Imants Zarembo, "Rapid prototyping of pear detection neural network with YOLO architecture
  in photographs", Environment. Technology. Resources., Rezekne 2023, vol. 1, pp. 81-85, doi 10.17770/etr2023vol1.7293.
- **CherryBBCH81** (mostly green cherry fruitlets, LatHort orchard, Dobele, Latvia),
  https://www.kaggle.com/datasets/projectlzp201910094/cfruitlets81-640, from
  https://github.com/ai-agriculture-circuits-and-systems/CherryBBCH81. Ilmārs Apeināns, Marks Sondors, Lienīte
  Litavniece, Sergejs Kodors, Imants Zarembo, Daina Feldmane, "Cherry Fruitlet Detection using YOLOv5 or YOLOv8?",
  Environment. Technology. Resources., Rezekne 2024, vol. 2, pp. 29-33, doi 10.17770/etr2024vol2.8013.

## Limits

- It learnt apples, pears and cherries from real photos of one region and season, and other fruit from renders only.
- It learnt words of the surroundings from renders, and "background" from drawn cloths and walls; in photos they were
  only labelled "no fruit".
- Small green fruit in shade is often missed, touching fruit merges, and glossy branches may be taken for fruit.
- It finds fruit better than it names them: bicoloured apples, plums, peaches and mangoes are confused with each other.
  If a tree has one kind, the word `fruit` finds more.
- It recognises fruit of 10 to 250 pixels; fruit below about 8 pixels is not found.
- Every other object should be "object", which it learnt from random shapes, patterns and colours; there is no word for
  people, nets, tools or animals.
"""


def write_card(path: Path, document: Mapping[str, Any]) -> str:
    """Write the card; returns its table of figures."""
    measures = document["measures"]
    table = _table(measures)
    colours = {f"{word} (colour)": found for word, found in measures["colours"].items()}
    judged = {**measures["words"], **colours}
    unjudged = [word for word in (*CONCEPTS, *GENERAL) if word not in measures["words"]]
    unjudged += [word for word in COLOURS if word not in measures["colours"]]
    text = _CARD.format(
        concepts=len(CONCEPTS),
        words_known=", ".join(CONCEPTS),
        colours=", ".join(COLOURS),
        fruits=len(FRUITS),
        guests=GUESTS,
        bins=BINS,
        table=table,
        conditions=_conditions(measures["conditions"]),
        general=", ".join(GENERAL),
        judged=len(judged),
        good=sum(each["auc"] >= 0.8 for each in judged.values()),
        unjudged=f"too few pixels to judge: {', '.join(unjudged)}" if unjudged else "none is left out",
        words=_words(judged),
        reliability=_reliability(measures["reliability"]),
        picture=_PICTURE,
        pixel_temperature=document["pixel_calibration"]["temperature"],
        pixel_bias=document["pixel_calibration"]["bias"],
        lifted=_describe_lifted(document),
        kind_temperature=document["calibration"]["kind_temperature"],
        number="one run" if len(document["runs"]) == 1 else f"{len(document['runs'])} runs",
        runs=_runs(document["runs"]),
        held_out=document["held_out_renders"],
    )
    path.write_text(text, encoding="utf-8")
    _draw_reliability(path.with_name(_PICTURE), measures["reliability"])
    return table


def _draw_reliability(path: Path, reliability: Mapping[str, Mapping[str, Any]]) -> None:
    figure = Figure(figsize=(4.2, 3.6), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1, label="a probability that means what it says")
    for (name, each), marker in zip(reliability.items(), "os", strict=False):
        axes.plot(each["predicted"], each["observed"], marker=marker, markersize=4, linewidth=1, label=name)
    axes.set(xlabel='P("fruit"), classes of equal mass', ylabel="share of fruit", aspect="equal")
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _rows(*rows: Sequence[object]) -> str:
    """A table; its first line is the head."""
    head, *body = (f"| {' | '.join(map(str, row))} |" for row in rows)
    return "\n".join([head, "|" + "---|" * len(rows[0]), *body])


def _runs(runs: Sequence[Mapping[str, Any]]) -> str:
    names = ("steps", "processes", "rate", "seed", "photos", "renders")
    return _rows(
        ("run", "steps", "processes", "highest rate", "seed", "photos", "renders", "repeatable"),
        *(
            (number, *(run.get(name, "–") for name in names), "yes" if run["repeatable"] else "no: ended by the clock")
            for number, run in enumerate(runs, start=1)
        ),
    )


def _describe_lifted(document: Mapping[str, Any]) -> str:
    lifted, calibration = document["lifted"], document["calibration"]
    if lifted["scenes"] == 0:
        return "The weights use this calibration of pixels; none was made for lifted Gaussians.\n"
    made = (
        "The weights use another calibration, made for their use: on Gaussians of rendered trees, into which the\n"
        f"features of many views were lifted, for a share of fruit of {lifted['fruit_share']}: temperature "
        f"{calibration['temperature']:.3f}, bias {calibration['bias']:.3f}.\n"
    )
    if lifted["scenes"] == 1:
        return made + "It was made on one tree, so it could not be evaluated on another.\n"
    return made + (
        f"Each of {lifted['scenes']} trees "
        f"was evaluated with the calibration of the others: calibration error {lifted['calibration_error']:.3f}; the\n"
        f"Gaussians with P(fruit) ≥ 0.5 and the true ones overlap by IoU {lifted['iou']:.3f}.\n"
    )


def _conditions(conditions: Mapping[str, Mapping[str, Any]]) -> str:
    return _rows(
        ("condition", "pictures", 'IoU of "fruit"', "IoU of the kinds"),
        *(
            (name, each["pictures"], f"{each['fruit_iou']:.3f}", f"{each['kind_iou']:.3f}")
            for name, each in conditions.items()
        ),
    )


def _words(judged: Mapping[str, Mapping[str, Any]]) -> str:
    return _rows(
        ("word", "AUC", "against"), *((word, f"{each['auc']:.3f}", each["against"]) for word, each in judged.items())
    )


def _reliability(reliability: Mapping[str, Mapping[str, Any]]) -> str:
    return _rows(
        ("measured on", "calibration error", "Brier", "Brier of always answering one half"),
        *(
            (name, f"{each['calibration_error']:.3f}", f"{each['brier']:.3f}", f"{each['constant_brier']:.2f}")
            for name, each in reliability.items()
        ),
    )


def _table(measures: Mapping[str, Any]) -> str:
    asked = ("photos: AUC / AP", "seen", "boxes", "redness", "pasted word", "renders: IoU", "precision", "recall")
    rows = []
    for fruit in (*FRUITS, "fruit"):
        photo, render = measures["photos"].get(fruit), measures["renders"].get(fruit)
        rankings = [photo[name] for name in ("ellipses", "seen", "boxes", "redness")] if photo else []
        shown = [f"{each['auc']:.3f} / {each['average_precision']:.3f}" for each in rankings]
        pasted = measures["pasted_word"].get(fruit)
        rows.append(
            (
                fruit,
                *(shown or ["–"] * 4),
                "–" if pasted is None else f"{pasted:.2f}",
                *(f"{render[name]:.3f}" if render else "–" for name in ("iou", "precision", "recall")),
            )
        )
    return _rows(("fruit", *asked), *rows)
