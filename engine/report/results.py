"""The content of `fruits.json`, the file other programs rely on.

Its `files` hold the SHA-256 of every other file of the set, so an incomplete set is detected. `scene.blend` is not a
function of its input (Blender writes memory addresses), so it has `set_id` as a scene property instead and is listed in
`unhashed_files`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..counting.accounts.describe import nearest_sphere
from ..counting.accounts.ids import NO_FRUIT, KnownFruit
from ..counting.fruit import AuditEntry, Fruit, FruitCount, Tree
from ..errors import FormatError, OutputError
from ..storage.files import text_hash
from .words import file_unit, place

SCHEMA = "fruitlangs.fruits/1"
FRUITS_JSON = "fruits.json"
BLEND = "scene.blend"

_NUMBER = (int, float)
_FIELDS: dict[str, dict[str, Any]] = {
    "document": {"set_id": str, "fruits": list, "config": dict, "files": dict, "provenance": dict}
    | {"metres_per_unit": (*_NUMBER, type(None))},
    "provenance": {"source": str, "inputs_sha256": str, "encoder": str, "training": dict, "prompts": list},
    "training": {"psnr": (*_NUMBER, type(None)), "ssim": (*_NUMBER, type(None))},
    "fruit": {"id": int, "label": str, "center": list, "diameter": _NUMBER},
    "earlier fruit": {"id": int, "center": list, "diameter": _NUMBER},
}
"""The fields that readers rely on: {part: {field: its type}}."""


def set_id(files: Mapping[str, str]) -> str:
    """A short name of a set of result files: a hash of the hashes, given as {file name: SHA-256}."""
    return text_hash(*(f"{name} {files[name]}" for name in sorted(files)))[:16]


def fruits_document(
    fruit_count: FruitCount,
    *,
    config: Mapping[str, Any],
    provenance: Mapping[str, Any],
    files: Mapping[str, str],
    unhashed_files: Sequence[str] = (),
    metres_per_unit: float | None,
    known: KnownFruit = NO_FRUIT,
    notices: Sequence[str] = (),
) -> dict[str, Any]:
    """The content of fruits.json.

    Lengths are metres if metres_per_unit is known, else scene units; centres are always in the input scene's frame.
    unhashed_files: names of the set's files that are not in `files`; known: fruit that earlier counts of the scene
    numbered, those that this count did not find are kept for the next; notices: messages for the user.
    """
    unit_name, unit = file_unit(metres_per_unit)
    return {
        "schema": SCHEMA,
        "set_id": set_id(files),
        "count": fruit_count.count,
        **_intervals(fruit_count),
        "last_id": fruit_count.last_id,
        "unit": unit_name,
        "metres_per_unit": metres_per_unit,
        "hanging": fruit_count.hanging,
        "fallen": fruit_count.fallen,
        "trees": [_tree_entry(tree) for tree in fruit_count.trees],
        "mean_diameter": None if fruit_count.mean_diameter is None else fruit_count.mean_diameter * unit,
        "pixel_width": None if fruit_count.pixel_width is None else round(fruit_count.pixel_width, 1),
        "other_fruit": fruit_count.other_fruit,
        "other_colors": fruit_count.other_colors,
        "notices": list(notices),
        "fruits": [_fruit_entry(fruit, unit) for fruit in fruit_count.fruits],
        "earlier_fruits": _earlier_entries(known, {fruit.id for fruit in fruit_count.fruits}, unit),
        "audit": {
            "max_probability": round(fruit_count.max_probability, 6),
            "clusters": [_audit_entry(entry, unit) for entry in fruit_count.audit],
        },
        "config": dict(config),
        "files": dict(sorted(files.items())),
        "unhashed_files": sorted(unhashed_files),
        "provenance": dict(provenance),
    }


def _fruit_entry(fruit: Fruit, unit: float) -> dict[str, Any]:
    return {
        "id": fruit.id,
        "label": fruit.label,
        "center": [round(float(value), 6) for value in fruit.center],
        "diameter": round(fruit.diameter * unit, 6),
        "diameter_sd": round(fruit.diameter_sd * unit, 6),
        "volume": float(f"{fruit.volume * unit**3:.6g}"),
        "axes": [[round(float(value) * unit, 6) for value in axis] for axis in fruit.axes],
        "probability": round(fruit.probability, 4),
        "visible_fraction": None if fruit.visible_fraction is None else round(fruit.visible_fraction, 4),
        "views": fruit.views,
        "color": [int(value) for value in fruit.color],
        "kind": fruit.kind,
        "fallen": fruit.fallen,
        "tree": fruit.tree,
    }


def _earlier_entries(known: KnownFruit, found: Collection[int], unit: float) -> list[dict[str, Any]]:
    """The known fruit whose ids are not among those `found`, by ascending id."""
    return [
        {
            "id": int(known.ids[index]),
            "center": [round(float(value), 6) for value in known.centers[index]],
            "diameter": round(float(known.diameters[index]) * unit, 6),
        }
        for index in np.argsort(known.ids)
        if known.ids[index] not in found
    ]


def _tree_entry(tree: Tree) -> dict[str, Any]:
    position = [round(float(value), 6) for value in tree.position]
    numbers = {"number": tree.number, "position": position, "count": tree.count}
    return {**numbers, **_intervals(tree), "other_fruit": tree.other_fruit}


def _intervals(counted: FruitCount | Tree) -> dict[str, Any]:
    return {name: getattr(counted, name) for name in ("likely", "interval", "total", "total_interval")}


def _audit_entry(entry: AuditEntry, unit: float) -> dict[str, Any]:
    document = dataclasses.asdict(entry)
    document["diameter"] = None if entry.diameter is None else round(entry.diameter * unit, 6)
    center = place(entry)
    document["center"] = None if center is None else [round(float(value), 6) for value in center]
    document["fruit_ids"] = list(entry.fruit_ids)
    return document


def dump(document: Mapping[str, Any]) -> str:
    """JSON text of a results document; refuses NaN, which JSON does not have."""
    try:
        return json.dumps(document, indent=1, allow_nan=False) + "\n"
    except ValueError as error:
        raise OutputError(
            f"{FRUITS_JSON} would hold a number that is not finite ({error}). Please report this"
        ) from error


def parse_results(path: Path) -> dict[str, Any]:
    """The content of a fruits.json.

    Raises:
        FormatError: it is not of a schema this version reads, or lacks a field that a reader relies on.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        schema = document["schema"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path} is not a results file ({error}). Count again into this folder") from error
    if schema != SCHEMA:
        raise FormatError(f"{path} has schema {schema!r}. This version reads {SCHEMA!r}")
    _check_fields(document, "document", path)
    _check_fields(document["provenance"], "provenance", path)
    _check_fields(document["provenance"]["training"], "training", path)
    for part, entries in (("fruit", document["fruits"]), ("earlier fruit", document.get("earlier_fruits", []))):
        for fruit in entries:
            _check_fields(fruit, part, path)
            if len(fruit["center"]) != 3 or not all(isinstance(value, _NUMBER) for value in fruit["center"]):
                raise FormatError(f"{path}: the centre of {part} {fruit['id']} is not three numbers. Count again")
    return document


def find_near_members(document: Mapping[str, Any], means: NDArray[np.float64]) -> NDArray[np.int32]:
    """Find the id (N,) of the fruit in or near which each of the means (N, 3) lies, -1 for none: its members in results
    that do not store them."""
    entries = document["fruits"]
    centers = np.array([entry["center"] for entry in entries], np.float64).reshape(-1, 3)
    diameters = np.array([entry["diameter"] for entry in entries], np.float64) / (document["metres_per_unit"] or 1.0)
    ids = np.array([*(entry["id"] for entry in entries), -1], np.int32)
    return ids[nearest_sphere(means, centers, diameters / 2.0)]


def parse_count(document: Mapping[str, Any], member_ids: NDArray[np.int32]) -> FruitCount:
    """Parse the count in fruits.json, without its sampled points. member_ids: (N,) the fruit of each Gaussian."""
    unit = document["metres_per_unit"] or 1.0
    fruits = [
        Fruit(
            **{name: entry[name] for name in ("id", "label", "probability", "visible_fraction", "views", "kind")},
            center=np.array(entry["center"], np.float64),
            diameter=entry["diameter"] / unit,
            diameter_sd=entry["diameter_sd"] / unit,
            volume=entry["volume"] / unit**3,
            axes=np.array(entry["axes"], np.float64) / unit,
            color=np.array(entry["color"], np.uint8),
            members=np.flatnonzero(member_ids == entry["id"]),
            fallen=entry["fallen"],
            tree=entry["tree"],
        )
        for entry in document["fruits"]
    ]
    mean = document["mean_diameter"]
    return FruitCount(
        fruits=fruits,
        audit=[_parse_audit(entry, unit) for entry in document["audit"]["clusters"]],
        max_probability=document["audit"]["max_probability"],
        mean_diameter=None if mean is None else mean / unit,
        last_id=document["last_id"],
        trees=[
            Tree(
                entry["number"],
                np.array(entry["position"], np.float64),
                entry["count"],
                other_fruit=entry.get("other_fruit", 0),
                **_parse_intervals(entry),
            )
            for entry in document["trees"]
        ],
        pixel_width=document.get("pixel_width"),  # results of earlier versions have none of these, nor `likely`
        other_fruit=document.get("other_fruit", 0),
        other_colors=document.get("other_colors", 0),
        **_parse_intervals(document),
    )


def _parse_audit(entry: Mapping[str, Any], unit: float) -> AuditEntry:
    center = tuple(entry["center"] or (0.0, 0.0, 0.0))
    diameter = None if entry.get("diameter") is None else entry["diameter"] / unit
    return AuditEntry(**{**entry, "center": center, "fruit_ids": tuple(entry["fruit_ids"]), "diameter": diameter})


def _parse_intervals(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Parse the intervals written by `_intervals`; JSON has lists instead of tuples."""
    pairs = {name: entry[name] and tuple(entry[name]) for name in ("interval", "total_interval")}
    return {**pairs, "likely": entry.get("likely"), "total": entry["total"]}


def parse_known_fruit(document: Mapping[str, Any], inputs_sha256: str) -> KnownFruit:
    """Parse the fruit that an earlier count numbered, if it was of the same inputs."""
    if document["provenance"]["inputs_sha256"] != inputs_sha256:
        return NO_FRUIT
    fruits = document["fruits"] + document.get("earlier_fruits", [])
    ids = np.array([fruit["id"] for fruit in fruits], np.int64)
    centers = np.array([fruit["center"] for fruit in fruits], np.float64).reshape(-1, 3)
    diameters = np.array([fruit["diameter"] for fruit in fruits], np.float64) / (document["metres_per_unit"] or 1.0)
    return KnownFruit(ids, centers, diameters, max(int(document.get("last_id", 0)), int(ids.max(initial=0))))


def _check_fields(content: Any, part: str, path: Path) -> None:
    """Raise FormatError unless `content` is an object with the fields of that part in their types."""
    for field, kind in _FIELDS[part].items():
        if not isinstance(content, dict) or field not in content or not isinstance(content[field], kind):
            raise FormatError(
                f"{path} is damaged: the field '{field}' of its {part} is missing or of a wrong type. Count again "
                "into this folder"
            )
