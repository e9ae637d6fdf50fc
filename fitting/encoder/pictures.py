"""Labelled pictures: photos with boxes as weak labels, renders with exact masks, plain backgrounds."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...engine.errors import FormatError
from ...engine.language.vocabulary import CONCEPTS, parse
from ...orchard.config import FIRST_TRAINING_SEED

IGNORED = 255
"""Label of a pixel that is not used."""
NOT_FRUIT = 254
"""Label of a pixel of the surroundings whose word is unknown."""
POSITIVE_SHARE = 0.6
"""Central share of a box that is certainly fruit, as an ellipse."""
NEGATIVE_SHARE = 1.1
"""Outside this multiple of every box a pixel counts as no fruit."""
UNBOXED = Path(__file__).with_name("unboxed.csv")
"""Fruit of the validation photos without a box, marked by eye: set, image, corners in pixels."""
LEAST_WALK = 24
"""A scene with this many pictures is used for calibration, never for training."""
SMALL = 14.0
"""Fruit of at most this many pixels is small."""

Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Box:
    """A labelled box in pixels."""

    label: str
    left: float
    top: float
    right: float
    bottom: float


@dataclass(frozen=True, eq=False)
class Picture:
    """pixels: (H, W, 3) sRGB; labels: (H, W) index into CONCEPTS, NOT_FRUIT or IGNORED; instances: (H, W) fruit ids of
    a render, 0 none; boxes of a photo; unboxed: fruit in it that has no box; traits: what makes a render's fruit hard;
    source: its set or scene; seed: of a render's scene.
    """

    pixels: NDArray[np.uint8]
    labels: Labels
    source: str
    boxes: Sequence[Box] = ()
    unboxed: Sequence[Box] = ()
    traits: Sequence[str] = ()
    instances: NDArray[np.uint16] | None = None
    seed: int | None = None


def read_photos(folder: Path, split: str) -> list[Picture]:
    """Every set below `folder` that has an annotations.csv (image, split, label, xmin, ymin, xmax, ymax).

    Raises:
        FormatError: there is none, or a row cannot be read.
    """
    pictures = []
    unboxed = _read_unboxed()
    for table in sorted(folder.glob("*/annotations.csv")):
        boxes: dict[str, list[Box]] = {}
        with table.open(newline="", encoding="utf-8") as file:
            for number, row in enumerate(csv.DictReader(file), start=2):
                try:
                    if row["split"] != split:
                        continue
                    mine = boxes.setdefault(row["image"], [])
                    if row["label"]:
                        corners = (float(row[name]) for name in ("xmin", "ymin", "xmax", "ymax"))
                        mine.append(Box(parse(row["label"]).concepts[0], *corners))
                except (KeyError, ValueError) as error:
                    raise FormatError(f"{table} line {number} cannot be read ({error}). See --help") from error
        for name, mine in sorted(boxes.items()):
            pixels = np.asarray(Image.open(table.parent / name).convert("RGB"))
            source = table.parent.name
            missed = unboxed.get((source, name), [])
            pictures.append(Picture(pixels, box_labels(mine, pixels.shape[:2]), source, mine, missed))
    if not pictures:
        raise FormatError(f"{folder} has no folder with an annotations.csv of split '{split}'")
    return pictures


def _read_unboxed() -> dict[tuple[str, str], list[Box]]:
    """By set and image."""
    boxes: dict[tuple[str, str], list[Box]] = {}
    with UNBOXED.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            corners = (float(row[name]) for name in ("xmin", "ymin", "xmax", "ymax"))
            boxes.setdefault((row["set"], row["image"]), []).append(Box(row["set"], *corners))
    return boxes


def box_labels(boxes: Sequence[Box], shape: tuple[int, ...]) -> Labels:
    """(H, W): fruit in the central ellipses, unknown around them, no fruit outside."""
    labels = np.full(shape, NOT_FRUIT, np.uint8)
    for box in boxes:
        labels[find_inside(box, NEGATIVE_SHARE, shape, ellipse=False)] = IGNORED
    for box in boxes:
        labels[find_inside(box, POSITIVE_SHARE, shape)] = CONCEPTS.index(box.label)
    return labels


def find_inside(box: Box, share: float, shape: tuple[int, ...], *, ellipse: bool = True) -> NDArray[np.bool_]:
    """Return (H, W): True in the box, or in its ellipse, scaled about its centre by `share`."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    u = (x + 0.5 - (box.left + box.right) / 2.0) / (share * (box.right - box.left) / 2.0)
    v = (y + 0.5 - (box.top + box.bottom) / 2.0) / (share * (box.bottom - box.top) / 2.0)
    return u * u + v * v < 1.0 if ellipse else (np.abs(u) < 1.0) & (np.abs(v) < 1.0)


def read_renders(folder: Path) -> list[Picture]:
    """Every finished scene below `folder` except those for calibration: images/, classes/ and instances/ of the same
    names, classes.json (index → word).

    Raises:
        FormatError: a scene lacks a file, names an unknown class, or is kept for tests.
    """
    pictures = []
    for table in sorted(folder.glob("*/classes.json")):
        scene = table.parent
        images = sorted((scene / "images").glob("*"))
        if len(images) >= LEAST_WALK:
            continue
        lookup, record = _make_lookup(table), _record(scene)
        for image in images:
            classes = scene / "classes" / f"{image.stem}.png"
            instances = scene / "instances" / f"{image.stem}.png"
            if not (classes.is_file() and instances.is_file()):
                continue
            pictures.append(
                Picture(
                    np.asarray(Image.open(image).convert("RGB")),
                    lookup[np.asarray(Image.open(classes))],
                    scene.name,
                    traits=_traits(record),
                    instances=np.asarray(Image.open(instances)).astype(np.uint16),
                    seed=record["seed"],
                )
            )
    if not pictures:
        raise FormatError(f"{folder} has no scene with classes.json, images, classes and instances. See --help")
    return pictures


def _make_lookup(table: Path) -> Labels:
    lookup = np.full(256, IGNORED, np.uint8)
    try:
        for index, word in json.loads(table.read_text(encoding="utf-8")).items():
            concept = CONCEPTS.index(word) if word in CONCEPTS else None
            if concept is not None:
                lookup[int(index)] = concept
    except (ValueError, AttributeError) as error:
        raise FormatError(f"{table} cannot be read ({error}). Make the scene again") from error
    return lookup


def _traits(config: dict[str, Any]) -> tuple[str, ...]:
    """What makes the fruit of a scene hard to see or to name."""
    variant, size = str(config.get("variant", "")), float(config.get("fruit_pixels", math.inf))
    traits = {"green on green": variant == "green", "two colours": "-" in variant, "small": size <= SMALL}
    return tuple(name for name, so in traits.items() if so)


def _record(scene: Path) -> dict[str, Any]:
    """The settings of a scene.

    Raises:
        FormatError: they are not recorded, or the scene is kept for tests.
    """
    path = scene / "orchard.json"
    try:
        config: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["config"]
        config["seed"] = int(config["seed"])
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise FormatError(f"{path} does not tell the scene's seed ({error}). Make the scene again") from error
    if config["seed"] < FIRST_TRAINING_SEED:
        raise FormatError(
            f"{scene} has seed {config['seed']}, and seeds below {FIRST_TRAINING_SEED} are for tests alone. Take it out"
        )
    return config


def training_seeds(scenes: Iterable[Path]) -> list[int]:
    """Seeds of these scene folders, sorted, as their orchard.json records them.

    Raises:
        FormatError: a scene's seed is not recorded, or is kept for tests.
    """
    return sorted({_record(scene)["seed"] for scene in scenes})


def make_plain_picture(rng: np.random.Generator, size: int) -> Picture:
    """Make a picture of a wall, cloth or table top: plain or shaded, with grain, stripes or bumps, labelled
    background."""
    y, x = np.mgrid[:size, :size].astype(np.float32) / size
    base = rng.uniform(0.1, 1.0) * (1.0 - rng.uniform(0.0, 0.5) * rng.random(3) ** 2)
    shade = 1.0 + rng.uniform(-0.35, 0.35) * (x - 0.5) + rng.uniform(-0.35, 0.35) * (y - 0.5)
    texture = np.zeros_like(x)
    for _ in range(rng.integers(0, 3)):
        angle, frequency = rng.uniform(0, np.pi), rng.uniform(4, 80)
        texture += rng.uniform(0.0, 0.06) * np.sin(
            2 * np.pi * frequency * (x * np.cos(angle) + y * np.sin(angle)) + rng.uniform(0, 6)
        )
    cells = int(rng.integers(3, 40))
    coarse = Image.fromarray(rng.normal(0.0, 1.0, (cells, cells)).astype(np.float32), mode="F")
    texture += rng.uniform(0.0, 0.08) * np.asarray(coarse.resize((size, size), Image.Resampling.BICUBIC))
    pixels = np.clip((shade + texture)[..., None] * base, 0.0, 1.0)
    labels = np.full((size, size), CONCEPTS.index("background"), np.uint8)
    return Picture((pixels * 255.0).astype(np.uint8), labels, "plain")


def make_plain_pictures() -> list[Picture]:
    """Make plain pictures for measurement, each with an object that is not fruit."""
    rng = np.random.default_rng(23)
    pictures = [make_plain_picture(rng, 256) for _ in range(24)]
    for picture in pictures:
        put_object(picture.pixels, picture.labels, rng)
    return pictures


def put_object(pixels: NDArray[np.uint8], labels: Labels, rng: np.random.Generator) -> None:
    """Draw a long bent object in place, round in section and of any colour, that no word names."""
    size = pixels.shape[0]
    y, x = np.mgrid[:size, :size].astype(np.float32)
    radius = rng.uniform(0.25, 1.5) * size
    thickness = float(np.exp(rng.uniform(np.log(0.02), np.log(0.12)))) * size
    middle, turn = rng.uniform(0.2, 0.8, 2) * size, rng.uniform(0, 2 * np.pi)
    dx, dy = x - middle[0] + radius * np.cos(turn), y - middle[1] + radius * np.sin(turn)
    across = (np.hypot(dx, dy) - radius) / thickness
    along = np.angle(np.exp(1j * (np.arctan2(dy, dx) - turn))) * radius / thickness / rng.uniform(3.0, 7.0)
    section = across**2 / np.clip(1.15 - along**4, 0.05, 1.0) + along**8
    shade = np.clip(0.55 + 0.6 * np.sqrt(np.clip(1.0 - section, 0.0, 1.0)) + rng.uniform(-0.3, 0.3) * across, 0.2, 1.3)
    hue = np.array([rng.uniform(0.4, 1.0), rng.uniform(0.2, 1.0), rng.uniform(0.0, 0.8)])
    hue = hue * (1.0 + rng.normal(0.0, 0.05, (size, size, 1)) * rng.random())
    drawn = np.clip(255.0 * shade[..., None] * hue * rng.uniform(0.4, 1.0), 0.0, 255.0)
    alpha = np.clip((1.0 - section) * thickness / 2.0, 0.0, 1.0)[..., None]
    pixels[:] = (drawn * alpha + pixels * (1.0 - alpha)).astype(np.uint8)
    opaque = alpha[..., 0]
    labels[opaque > 0.05] = IGNORED
    labels[opaque > 0.5] = CONCEPTS.index("object")
