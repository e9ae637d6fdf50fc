"""The trees of a block with what their results say; a result of a row holds several."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..counting.accounts.review import correct_interval
from ..errors import FormatError, FruitLangsError
from ..report.results import FRUITS_JSON, parse_results
from ..scene.formats.cameras_json import camera_names, read_cameras
from ..scene.gps import GpsTag, degrees_of, read_gps
from ..scene.sfm.find_cameras import list_photos
from ..scene.source import Source
from ..training import CAMERAS
from .inputs import Check
from .ledger import Ledger, TreeState
from .manifest import TreeEntry
from .reviews import REVIEW, ReviewedFruit, fruit_of, read_review
from .totals import Amount

TAGS, TAGS_OF_ROW = 5, 100
"""Photos whose GPS tags give a tree its place, and the trees of a row theirs."""
UNUSED_REVIEW = "its review is of an earlier count and is not used"
MOST_FRUIT = 10**9
"""More fruit than a result can have: the file is damaged."""


@dataclass(frozen=True, kw_only=True)
class CountedTree:
    """A tree of the block.

    folder: id of its line in the manifest, which names the folder of its result; counted, reviewed: fruit before and
    after a review, None without a count or review; visible, total: after the review, None if the method gives no
    interval; diameters: metres or scene units; volumes: of all fruit; metric: whether they are metres; colors: mean
    sRGB of each fruit; elsewhere: fruit of the same result that belong to no tree, of the first tree of a row only;
    outdated: its inputs have changed since it was counted; note: what the user should know about its count. The place
    of `entry` is that of the photos if the manifest does not give it.
    """

    entry: TreeEntry
    state: TreeState
    folder: str = ""
    counted: int | None = None
    reviewed: int | None = None
    visible: Amount | None = None
    total: Amount | None = None
    diameters: tuple[float, ...] = ()
    volume: float = 0.0
    metric: bool = False
    colors: tuple[tuple[int, int, int], ...] = ()
    elsewhere: int = 0
    outdated: bool = False
    note: str = ""

    @property
    def count(self) -> int | None:
        """Its fruit, after the review if there is one; None if it is not counted."""
        return self.counted if self.reviewed is None else self.reviewed


def read_counts(ledger: Ledger) -> list[CountedTree]:
    """Every tree of the block with what its result says. One whose result is damaged has failed.

    Raises:
        OutputError, FormatError: the folder is not that of a block.
    """
    found, states = [], ledger.states()
    for entry in ledger.trees():
        state = states[entry.id]
        if state.stage == "done":
            try:
                trees = _trees_of(entry, state, ledger.result(entry).path)
                check = ledger.check(entry, state)
                found += [_apply_check(tree, check) for tree in trees]
                continue
            except FruitLangsError as error:
                state = replace(state, stage="failed", reason=str(error))
        found.append(CountedTree(entry=_add_place(entry), state=state, folder=entry.id))
    return found


def _apply_check(tree: CountedTree, check: Check) -> CountedTree:
    """Return the tree with what has changed since it was counted."""
    return replace(tree, outdated=check.outdated, note=_notes(check.note, tree.note))


def fruit_text(folder: Path) -> str:
    """The count of a result in words: '98 fruit', of a row '98 fruit on 6 trees', with fruit that may have been taken
    for other kinds '0 fruit, 38 of other kinds'. Of a damaged one, what is wrong."""
    try:
        document = parse_results(folder / FRUITS_JSON)
    except FormatError as error:
        return str(error)
    trees, other = document.get("trees"), document.get("other_fruit")
    text = f"{document['count']} fruit" + (f" on {len(trees)} trees" if isinstance(trees, list) and trees else "")
    return text + (f", {other} of other kinds" if other else "")


def _trees_of(entry: TreeEntry, state: TreeState, folder: Path) -> list[CountedTree]:
    """The tree of a result, or its trees if it is one of a row.

    Raises:
        OutputError, FormatError: the result is damaged.
    """
    document = parse_results(folder / FRUITS_JSON)
    try:
        return _read_trees(entry, state, document, folder)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise FormatError(
            f"{folder / FRUITS_JSON} is damaged ({type(error).__name__}: {error}). Delete it and count again"
        ) from error


def _read_trees(entry: TreeEntry, state: TreeState, document: dict[str, Any], folder: Path) -> list[CountedTree]:
    """Read the trees that a result describes.

    Raises:
        KeyError, TypeError, ValueError: the result is damaged.
    """
    review = read_review(folder, document["set_id"])
    fruits, reviewed = fruit_of(document, review), review is not None
    if document.get("trees"):
        trees = _row(entry, state, document, fruits, reviewed, folder)
    else:
        trees = [
            _make_counted(_add_place(entry), state, document, fruits, reviewed, unit=document["unit"], folder=entry.id)
        ]
    unused = review is None and (folder / REVIEW).is_file()
    return [replace(tree, note=_notes(tree.note, UNUSED_REVIEW)) for tree in trees] if unused else trees


def _row(
    entry: TreeEntry,
    state: TreeState,
    document: dict[str, Any],
    fruits: Sequence[ReviewedFruit],
    reviewed: bool,
    folder: Path,
) -> list[CountedTree]:
    """The trees of a result that tells them apart.

    Raises:
        KeyError, TypeError, ValueError: the result is damaged.
    """
    trees = document["trees"]
    feet = np.array([tree["position"] for tree in trees], np.float64)
    along = np.linalg.norm(feet - feet[0], axis=1) * (document["metres_per_unit"] or 1.0)
    if not np.isfinite(along).all():
        raise ValueError("the position of a tree")
    earth = _places_of_trees(entry, folder, feet)
    found = []
    for place, tree in enumerate(trees):
        given = (entry.latitude, entry.longitude)
        latitude, longitude = given if earth is None else (round(float(each), 7) for each in earth[place])
        own = replace(
            entry,
            id=f"{entry.id}-{tree['number']}",
            row=entry.row or entry.id,
            position=round((entry.position or 0.0) + float(along[place]), 3),
            latitude=latitude,
            longitude=longitude,
        )
        bears = [fruit for fruit in fruits if fruit.tree == tree["number"]]
        found.append(_make_counted(own, state, tree, bears, reviewed, unit=document["unit"], folder=entry.id))
    elsewhere = sum(fruit.counts and fruit.tree is None for fruit in fruits)
    return [replace(found[0], elsewhere=elsewhere), *found[1:]]


def _make_counted(
    entry: TreeEntry,
    state: TreeState,
    said: dict[str, Any],
    fruits: Sequence[ReviewedFruit],
    reviewed: bool,
    *,
    unit: str,
    folder: str,
) -> CountedTree:
    """Make a tree with its fruit. said: count and intervals of the tree before the review; unit: of the result."""
    count = int(said["count"])
    if not 0 <= count <= MOST_FRUIT:
        raise ValueError(f"{count} fruit")
    visible, hidden = _visible(said, count), _total(said, count)
    standing = [fruit for fruit in fruits if fruit.counts]
    if reviewed:
        visible = None if visible is None else _apply_review(visible, fruits)
        hidden = None if hidden is None or visible is None else _shift_total(hidden, visible)
    return CountedTree(
        entry=entry,
        state=state,
        folder=folder,
        counted=count,
        reviewed=len(standing) if reviewed else None,
        visible=visible,
        total=hidden,
        diameters=tuple(fruit.diameter for fruit in standing),
        volume=float(sum(fruit.volume for fruit in standing)),
        metric=unit == "m",
        colors=tuple(fruit.color for fruit in standing),
        note=_note_on_kinds(int(said.get("other_fruit", 0)), count),
    )


def _note_on_kinds(other_fruit: int, count: int) -> str:
    """What to know about a count that is at most half of all fruit; empty if it is not."""
    if not other_fruit:
        return ""
    return (
        f"only {count} fruit were counted, and {other_fruit} that look like other kinds are in the interval. If these "
        "are meant, count with the word fruit"
    )


def _notes(*notes: str) -> str:
    """The notes that are not empty, in one line."""
    return "; ".join(filter(None, notes))


def _visible(said: Mapping[str, Any], count: int) -> Amount | None:
    """The number of visible fruit with its interval; None if either end or the most likely number is unknown. Of a 0
    that is an answer the most likely number is 0."""
    interval, likely = said.get("interval"), said.get("likely")
    if likely is None and count == 0:
        likely = 0.0
    return None if interval is None or likely is None else _amount(count, likely, *interval)


def _total(said: Mapping[str, Any], count: int) -> Amount | None:
    """The same with hidden fruit."""
    interval, total = said.get("total_interval"), said.get("total")
    return None if interval is None or total is None else _amount(count, total, *interval)


def _amount(count: int, likely: float, low: float, high: float) -> Amount:
    """
    Raises:
        TypeError, ValueError: one of them is not a number of fruit.
    """
    if not all(0 <= value <= MOST_FRUIT for value in (count, likely, low, high)):
        raise ValueError(f"{count} fruit, most likely {likely} ({low} to {high})")
    return Amount(count=count, likely=likely, low=low, high=high)


def _apply_review(before: Amount, review: Sequence[ReviewedFruit]) -> Amount:
    """Return the number of fruit after a review, with the interval that it leaves."""
    found = [fruit for fruit in review if fruit.standing != "added"]
    after = sum(fruit.counts for fruit in review)
    low, high = correct_interval(
        before.count,
        (int(before.low), int(before.high)),
        np.array([fruit.probability for fruit in found]),
        np.array([fruit.standing != "" for fruit in found], bool),
        sum(fruit.standing == "rejected" for fruit in found),
        after,
    )
    # The count and its most likely number differ by what it may have missed or taken for fruit.
    likely = after + np.clip(before.likely - before.count, low - after, high - after)
    return Amount(count=after, likely=float(likely), low=low, high=high)


def _shift_total(total: Amount, visible: Amount) -> Amount:
    """Return the number with hidden fruit after a review that changed the number of visible ones."""
    moved = [max(each + visible.count - total.count, visible.count) for each in (total.likely, total.low, total.high)]
    return Amount(count=visible.count, likely=moved[0], low=moved[1], high=moved[2])


def _tags(entry: TreeEntry, most: int) -> dict[str, GpsTag]:
    """{name of a photo: its GPS tag} of at most this many photos of a tree, evenly chosen; none if its source is no
    folder of photos."""
    folder = Source(path=entry.source).photos_folder() if entry.source.is_dir() else None
    photos = [] if folder is None else list_photos(folder)
    chosen = photos[:: max(math.ceil(len(photos) / most), 1)]
    return {photo.name: tag for photo in chosen if (tag := _tag(photo)) is not None}


def _add_place(entry: TreeEntry) -> TreeEntry:
    """Give the entry the mean place of its photos, if they have GPS tags and the manifest does not give a place."""
    if entry.latitude is not None:
        return entry
    tags = _tags(entry, TAGS).values()
    if not tags:
        return entry
    latitude, longitude = (float(np.mean([getattr(tag, name) for tag in tags])) for name in ("latitude", "longitude"))
    return replace(entry, latitude=round(latitude, 7), longitude=round(longitude, 7))


def _places_of_trees(entry: TreeEntry, folder: Path, feet: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """(T, 2) latitude and longitude of trees at feet (T, 3), by the GPS tags of the photos; None if these do not give
    them.

    Raises:
        OutputError, FormatError: the cameras of the result cannot be read.
    """
    tags = _tags(entry, TAGS_OF_ROW)
    if not tags:
        return None
    scene, names = read_cameras(folder / CAMERAS), camera_names(folder / CAMERAS)
    tagged = [(camera.center, tags[name]) for name, camera in zip(names, scene.cameras, strict=True) if name in tags]
    if not tagged:
        return None
    return degrees_of(feet, np.array([center for center, _ in tagged]), [tag for _, tag in tagged], scene.up)


def _tag(photo: Path) -> GpsTag | None:
    try:
        return read_gps(photo)
    except (FruitLangsError, OSError):
        return None
