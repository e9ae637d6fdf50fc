"""What is counted in a block: a table of trees (CSV or TOML), or a folder with a folder of photos for each tree."""

from __future__ import annotations

import csv
import io
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from ..config import PRESETS, STAGES, Config, Preset
from ..errors import ConfigError, FormatError, FruitLangsError
from ..scene.sfm.find_cameras import list_photos
from ..storage.files import names_device
from ..storage.keys import stage_key

IDS = re.compile(r"[\w-][\w. -]{0,79}")
"""What an id looks like: it names a folder."""
MANIFEST, STATES = "manifest.json", "states"
"""A file and a folder that together only the folder of a block has."""
COLUMNS = {
    "id": "name of the tree, unique",
    "source": "folder of photos or of a model, video, or earlier result; relative to the manifest",
    "prompt": "what to count; several separated by |",
    "negative": "what to exclude; several separated by |",
    "row": "name of its row",
    "position": "place along the row: a number",
    "trees": "number of trees, if the source shows a row; or x y z of each trunk, separated by spaces",
    "latitude": "degrees north",
    "longitude": "degrees east",
    "metres_per_unit": "scale, if known",
    "box": "region to count in: six numbers x y z x y z",
    "preset": "quick, standard or paper",
    "settings": "settings, such as train.steps=800; several separated by |",
}
"""{column: what it holds} of a manifest. A TOML manifest may give each also for all trees."""
WORDS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}
NUMBERS = ("position", "latitude", "longitude", "metres_per_unit")


@dataclass(frozen=True, kw_only=True)
class TreeEntry:
    """One tree, or one segment of a row, as the manifest names it.

    source: absolute; prompt, negative: what to count and what to exclude; row: empty if it has none; position: along
    its row; latitude, longitude: degrees, None if not given; settings: {"train.steps": value} that differ from the
    preset's.
    """

    id: str
    source: Path
    prompt: tuple[str, ...]
    negative: tuple[str, ...] = ()
    row: str = ""
    position: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    preset: Preset = "standard"
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def config(self) -> Config:
        """The settings of every stage.

        Raises:
            ConfigError: one of them has no such value, or is unknown to this version.
        """
        stages: dict[str, dict[str, Any]] = {}
        for name, value in self.settings.items():
            stage, _, setting = name.partition(".")
            stages.setdefault(stage, {})[setting] = value
        train = {**asdict(PRESETS[self.preset]), **stages.pop("train", {})}
        try:
            return Config(
                train=STAGES["train"](**train), **{stage: STAGES[stage](**given) for stage, given in stages.items()}
            )
        except (ConfigError, KeyError, TypeError) as error:
            raise ConfigError(f"tree {self.id}: {error}") from error

    @property
    def trees(self) -> int:
        """How many trees its result has."""
        return max(len(self.settings.get("count.tree_places") or ()) // 3, int(self.settings.get("count.trees", 0)), 1)

    @property
    def fingerprint(self) -> str:
        """A text that is another one if the tree must be counted again."""
        what = asdict(self)
        for name in ("row", "position", "latitude", "longitude"):  # they move the tree, not its count
            del what[name]
        return stage_key((), str(sorted((key, str(value)) for key, value in what.items())))


def names_folder(own: str) -> bool:
    """Whether an id can name a folder on every system."""
    return IDS.fullmatch(own) is not None and not own.endswith((".", " ")) and not names_device(own)


def holds_block(folder: Path) -> bool:
    """Whether a folder is that of a block."""
    return (folder / MANIFEST).is_file() and (folder / STATES).is_dir()


def read_manifest(path: Path, *, prompt: Sequence[str] = (), settings: str = "") -> list[TreeEntry]:
    """The trees of a manifest or of a folder of folders, in its order. prompt, settings: of trees that name none.

    Raises:
        FormatError: it cannot be read, or a line is wrong; names the line and the column.
        ConfigError: two trees have one id, or a tree has no prompt.
    """
    common = {"prompt": "|".join(prompt), "settings": settings}
    if path.is_dir():
        rows = [({"id": each.name, "source": each.name}, each.name) for each in _folders(path)]
        base = path
    elif path.suffix.lower() == ".toml":
        rows, base = _toml(path, common), path.parent
    else:
        rows, base = _table(path), path.parent
    trees = [_tree(row, place, base, common, path) for row, place in rows]
    if not trees:
        raise FormatError(f"{path} names no tree. Give a line for each, with the columns id, source and prompt")
    _require_own_ids(trees, [place for _, place in rows], path)
    return trees


def _require_own_ids(trees: Sequence[TreeEntry], places: Sequence[str], path: Path) -> None:
    """
    Raises:
        ConfigError: two lines have one id, or one has the id that the tables give to a tree of a row.
    """
    seen: dict[str, str] = {}
    for tree, place in zip(trees, places, strict=True):
        folded = tree.id.casefold()  # of a file system that does not tell A from a
        if folded in seen:
            raise ConfigError(f"{path}: {place} and {seen[folded]} have one id, '{tree.id}'. Give each tree its own")
        seen[folded] = place
    for tree, place in zip(trees, places, strict=True):
        for number in range(1, tree.trees + 1 if tree.trees > 1 else 1):
            own = f"{tree.id}-{number}"
            if own.casefold() in seen:
                raise ConfigError(
                    f"{path}: '{own}' is the id of {seen[own.casefold()]} and of tree {number} of the row in {place}. "
                    "Give one of them another id"
                )
            seen[own.casefold()] = f"a tree of the row in {place}"


def _folders(path: Path) -> list[Path]:
    """The folders in a folder that hold something to count, by name."""
    found = [each for each in sorted(path.iterdir()) if each.is_dir() and not each.name.startswith(".")]
    found = [each for each in found if not holds_block(each)]  # an --out in the folder of the photos
    return [each for each in found if list_photos(each) or any(each.glob("*/*")) or any(each.glob("*.json"))]


def _toml(path: Path, common: dict[str, Any]) -> list[tuple[dict[str, Any], str]]:
    """The [[tree]] tables; what stands above them is for all trees and goes to `common`."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FormatError(
            f"{path} cannot be read ({reason}). Write it as TOML, with a [[tree]] for each tree"
        ) from error
    trees = document.pop("tree", [])
    if not isinstance(trees, list) or not all(isinstance(each, dict) for each in trees):
        raise FormatError(f"{path}: trees are written as [[tree]], each with id and source")
    _check_columns(document, path, "for all trees")
    common.update({key: value for key, value in document.items() if value not in ("", {})})
    return [(dict(each), f"tree {number}") for number, each in enumerate(trees, start=1)]


def _table(path: Path) -> list[tuple[dict[str, Any], str]]:
    """The lines of a table, whatever its separator and encoding are: a spreadsheet wrote it."""
    try:
        text = _decode(path.read_bytes())
    except OSError as error:
        raise FormatError(
            f"{path} cannot be read ({error.strerror or error}). Give a .csv, a .toml or a folder"
        ) from error
    head = text.splitlines()[0] if text.strip() else ""
    if not head:
        raise FormatError(f"{path} is empty. Its first line names columns: {', '.join(COLUMNS)}")
    separator = max(";\t,", key=head.count)
    try:
        lines = list(csv.DictReader(io.StringIO(text), delimiter=separator, restkey="", strict=True))
    except csv.Error as error:
        raise FormatError(f"{path} is not a table ({error}). Save it as CSV") from error
    rows = []
    for number, line in enumerate(lines, start=2):
        if line.pop("", None) is not None:
            raise FormatError(
                f"{path}, line {number} has more cells than columns. Put texts with {separator} in quotes"
            )
        row = {(name or "").strip().casefold(): (value or "").strip() for name, value in line.items()}
        if any(row.values()):
            rows.append((row, f"line {number}"))
    if rows:
        _check_columns(rows[0][0], path, "of its first line")
    return rows


def _decode(content: bytes) -> str:
    """Decode text in UTF-8, in UTF-16 with its mark, or in Windows' western encoding."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", errors="replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", errors="replace")


def _check_columns(row: Mapping[str, Any], path: Path, where: str) -> None:
    unknown = [name for name in row if name not in COLUMNS]
    if unknown:
        raise FormatError(f"{path} has an unknown column {where}: '{unknown[0]}'. Known are {', '.join(COLUMNS)}")


def _tree(row: Mapping[str, Any], place: str, base: Path, common: Mapping[str, Any], path: Path) -> TreeEntry:
    """A tree of the manifest; a value of a wrong type, such as a list for a number in TOML, is an error of its line."""
    try:
        return _entry(row, place, base, common, path)
    except (AttributeError, IndexError, OSError, OverflowError, TypeError, ValueError) as error:
        raise FormatError(f"{path}, {place}: a value has the wrong form ({error}). See docs/batch.md") from error


def _entry(row: Mapping[str, Any], place: str, base: Path, common: Mapping[str, Any], path: Path) -> TreeEntry:
    _check_columns(row, path, f"in {place}")
    given = {**common, **{name: value for name, value in row.items() if value not in ("", None)}}

    def wrong(what: str) -> FormatError:
        return FormatError(f"{path}, {place}: {what}")

    for name in ("id", "source"):
        if not str(given.get(name, "")).strip():
            raise wrong(f"{name} is missing")
    own = str(given["id"]).strip()
    if names_device(own):
        raise wrong(f"id '{own}' is the name of a device on Windows and cannot name a folder. Choose another id")
    if not names_folder(own):
        raise wrong(f"id '{own[:40]}' names a folder: use letters, digits, spaces, - and _ only")
    prompt = _texts(given.get("prompt", ""))
    if not prompt:
        raise ConfigError(f"{path}, {place}: nothing says what to count. Fill the column prompt, or give --prompt")
    preset = str(given.get("preset", "standard"))
    if preset not in PRESETS:
        raise wrong(f"preset '{preset}' is unknown; use {', '.join(PRESETS)}")
    numbers = {name: _number(given[name], name, wrong) for name in NUMBERS if name in given}
    _require_place(numbers, wrong)
    settings = {**_settings(common.get("settings", {}), wrong), **_settings(row.get("settings", {}), wrong)}
    if "metres_per_unit" in numbers:
        settings["units.metres_per_unit"] = numbers.pop("metres_per_unit")
    if "box" in given:
        settings["count.box"] = _box(given["box"], wrong)
    if "trees" in given:
        settings |= _trees(given["trees"], wrong)
    entry = TreeEntry(
        id=own,
        source=(base / str(given["source"])).resolve(),
        prompt=prompt,
        negative=_texts(given.get("negative", "")),
        row=str(given.get("row", "")).strip(),
        preset=preset,  # type: ignore[arg-type]
        settings=settings,
        **numbers,  # type: ignore[arg-type]
    )
    try:
        _ = entry.config
    except FruitLangsError as error:
        raise wrong(str(error)) from error
    return entry


def _texts(given: Any) -> tuple[str, ...]:
    texts = given.split("|") if isinstance(given, str) else [str(each) for each in given]
    return tuple(text.strip() for text in texts if text.strip())


def _number(given: Any, name: str, wrong: Any) -> float:
    try:
        number = float(str(given).replace(",", "."))  # of a spreadsheet with decimal commas
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise wrong(f"{name} '{given}' is not a number")
    return number


def _require_place(numbers: Mapping[str, float], wrong: Any) -> None:
    for name, other, most in (("latitude", "longitude", 90.0), ("longitude", "latitude", 180.0)):
        if name not in numbers:
            continue
        if not -most <= numbers[name] <= most:
            raise wrong(f"{name} {numbers[name]:g} is not between -{most:g} and {most:g} degrees")
        if other not in numbers:
            raise wrong(f"{name} is given without {other}")


def _box(given: Any, wrong: Any) -> tuple[float, ...]:
    parts = given.split() if isinstance(given, str) else list(given)
    if len(parts) != 6:
        raise wrong(f"box has {len(parts)} numbers, not six: x y z of one corner, then of the other")
    return tuple(_number(part, "box", wrong) for part in parts)


def _trees(given: Any, wrong: Any) -> dict[str, Any]:
    """The setting for the number of trees, or for their places."""
    parts = given.split() if isinstance(given, str) else list(given) if isinstance(given, list) else [given]
    numbers = [_number(part, "trees", wrong) for part in parts]
    if len(numbers) > 1:
        return {"count.tree_places": tuple(numbers)}
    if numbers[0] != int(numbers[0]) or numbers[0] < 1:
        raise wrong(f"trees '{given}' is not a number of trees")
    return {"count.trees": int(numbers[0])}


def _settings(given: Any, wrong: Any) -> dict[str, Any]:
    """{"train.steps": value}; a text holds them as train.steps=400 | count.threshold=.4."""
    if not isinstance(given, str):
        pairs = list(dict(given).items())
    else:
        pairs = [each.partition("=")[::2] for each in re.split(r"[;|]", given) if each.strip()]
    found = {}
    for name, value in pairs:
        key = str(name).strip().removeprefix("--").replace("-", "_")
        stage, _, setting = key.partition(".")
        known = {each.name: each for each in fields(STAGES[stage])} if stage in STAGES else {}
        if setting not in known:
            raise wrong(f"'{key}' is not a setting. count_fruit.py --help-all lists all")
        try:
            found[key] = _value(value.strip(), known[setting].default) if isinstance(value, str) else value
        except ValueError as error:
            raise wrong(f"{key} '{value}' is {error}") from error
    return found


def _value(text: str, usual: Any) -> Any:
    """A setting's value from its text, of the kind of its default.

    Raises:
        ValueError: it is of another kind.
    """
    if isinstance(usual, bool):
        if text.casefold() not in WORDS:
            raise ValueError("neither true nor false")
        return WORDS[text.casefold()]
    if isinstance(usual, int):
        if not re.fullmatch(r"[+-]?\d+", text):
            raise ValueError("not a whole number")
        return int(text)
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
