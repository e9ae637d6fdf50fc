"""The true fruit of a generated orchard, as listed in `truth.json`."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..counting.fruit import NO_TREE
from ..errors import FormatError, VocabularyError
from ..language.vocabulary import describes, parse, singulars, split


@dataclass(frozen=True, eq=False)
class Truth:
    """M true fruit in the frame of the COLMAP model.

    centers: (M, 3); diameters: (M,) scene units; visible: (M,) at least 3 views show 10 % and 12 pixels of it;
    visible_fractions: (M,) largest over views of its unoccluded share; ids: (M,) their values in the instance masks,
    trees: (M,) the number of the tree of each, from 1, or NO_TREE; both None if the truth does not record it;
    neighbours: (M,) which of them belong to neighbouring rows and to no count, None if there are none.
    """

    centers: NDArray[np.float64]
    diameters: NDArray[np.float64]
    visible: NDArray[np.bool_]
    visible_fractions: NDArray[np.float64]
    ids: NDArray[np.int64] | None = None
    trees: NDArray[np.int64] | None = None
    neighbours: NDArray[np.bool_] | None = None

    def select(self, index: NDArray[np.bool_]) -> Truth:
        """The true fruit at index (M,)."""
        names = ("centers", "diameters", "visible", "visible_fractions", "ids", "trees", "neighbours")
        chosen = {name: values[index] for name in names if (values := getattr(self, name)) is not None}
        return replace(self, **chosen)

    @property
    def total(self) -> int:
        """All true fruit of the scene, visible or not."""
        return len(self.diameters) - (0 if self.neighbours is None else int(self.neighbours.sum()))

    @property
    def mean_diameter(self) -> float:
        """Mean over visible fruit (over all if none is visible), scene units; NaN without any fruit."""
        chosen = self.diameters[self.visible] if self.visible.any() else self.diameters
        return float(chosen.mean()) if len(chosen) else float("nan")


def read_truth(path: Path, labels: Collection[str] | None = None) -> Truth:
    """Read `truth.json`; with `labels`, only fruit with these labels.

    Raises:
        FormatError: the file is missing, is not JSON, a fruit lacks a field or holds a number that is not finite, or
            its fruit have none of `labels`; a diameter is not above 0 or two fruit have one id.
    """
    try:
        listed = json.loads(Path(path).read_text(encoding="utf-8"))["fruits"]
        found = {fruit["label"] for fruit in listed}
        fruits = [fruit for fruit in listed if labels is None or fruit["label"] in labels]
        truth = Truth(
            centers=np.array([fruit["center"] for fruit in fruits], dtype=np.float64).reshape(-1, 3),
            diameters=np.array([fruit["diameter"] for fruit in fruits], dtype=np.float64),
            visible=np.array([fruit["visible"] for fruit in fruits], dtype=bool),
            visible_fractions=np.array([fruit["visible_fraction"] for fruit in fruits], dtype=np.float64),
            ids=_ids(fruits),
            trees=_trees(fruits),
            neighbours=np.array([fruit.get("kind") == "neighbour" for fruit in fruits], dtype=bool),
        )
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror}). Give the truth.json of the scene") from error
    except KeyError as error:
        raise FormatError(f"{path}: field {error} is missing. Make the scene again") from error
    except (ValueError, TypeError) as error:
        raise FormatError(f"{path}: not a truth.json ({error}). Make the scene again") from error
    if labels is not None and found and found.isdisjoint(labels):
        raise FormatError(
            f"{path}: the truth has no {' or '.join(sorted(labels))}, only {', '.join(sorted(found))}. "
            "Give the truth of the scene that was counted"
        )
    if not (np.isfinite(truth.centers).all() and np.isfinite(truth.diameters).all()):
        raise FormatError(f"{path}: a centre or a diameter is not a finite number. Make the scene again")
    if not (truth.diameters > 0.0).all():
        raise FormatError(f"{path}: a diameter is not above 0. Make the scene again")
    if truth.ids is not None and len(np.unique(truth.ids)) < len(truth.ids):
        raise FormatError(f"{path}: two fruit have the same id. Make the scene again")
    return truth


def true_labels(prompts: Sequence[str]) -> set[str]:
    """Labels of true fruit that match any of the prompts, whatever their colour: "red apple" counts apples. A word that
    is not built in was taught, and is its own label.

    Raises:
        VocabularyError: a prompt has no noun.
    """
    labels = set[str]()
    for prompt in prompts:
        try:
            named = parse(prompt).concepts
        except VocabularyError:
            named = singulars(" ".join(word for word in split(prompt) if not describes(word)))
        if not any(named):
            raise VocabularyError(f"The prompt '{prompt}' names no fruit to measure against. Give --label")
        labels.update(named)
    return labels


def _ids(fruits: Sequence[Mapping[str, Any]]) -> NDArray[np.int64] | None:
    if not all("id" in fruit for fruit in fruits):
        return None
    return np.array([fruit["id"] for fruit in fruits], dtype=np.int64)


def _trees(fruits: Sequence[Mapping[str, Any]]) -> NDArray[np.int64] | None:
    """Tree numbers; null for a fruit of no tree, such as one on the ground or of a row behind."""
    if not any("tree" in fruit for fruit in fruits):
        return None
    trees = [fruit.get("tree") for fruit in fruits]
    return np.array([NO_TREE if tree is None else tree for tree in trees], dtype=np.int64)


@dataclass(frozen=True, eq=False)
class TrueView:
    """True camera of a picture: name of its file, world_to_camera (4, 4) in scene units."""

    name: str
    world_to_camera: NDArray[np.float64]


def read_views(path: Path) -> list[TrueView]:
    """The true cameras of `truth.json`, if the model's are inaccurate; empty if it lists none.

    Raises:
        FormatError: as `read_truth`.
    """
    try:
        listed = json.loads(Path(path).read_text(encoding="utf-8")).get("views", [])
        views = []
        for view in listed:
            pose = np.eye(4)
            pose[:3] = np.array(view["world_to_camera"], dtype=np.float64).reshape(-1, 4)[:3]
            views.append(TrueView(str(view["name"]), pose))
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror}). Give the truth.json of the scene") from error
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise FormatError(f"{path}: its list of views is damaged ({error}). Make the scene again") from error
    if not all(np.isfinite(view.world_to_camera).all() for view in views):
        raise FormatError(f"{path}: a camera is not finite. Make the scene again")
    return views
