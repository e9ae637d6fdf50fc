"""The tables of the documents, made from records."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import mean

import numpy as np

from ...engine.block.totals import SHARED_ALL, SHARED_VISIBLE
from ...engine.evaluation.camera_errors import CameraErrors
from ...engine.evaluation.metrics import CountMetrics
from ...engine.evaluation.summary import summarise
from ..ladder.ladder import StageResult
from ..ladder.pages import table_parts, visibility_rows
from ..ladder.stages import END_TO_END, TRUE_MASKS, TRUE_POSES
from ..markdown import markdown
from ..shared_errors import MeasuredTree, estimate_shared_error, measure_held_sums, measure_held_sums_left_out
from ..two_photos import TWO_PHOTOS
from .records import Record, Trial
from .studies import CONDITIONS, SEEDS, SPECIES, STUDIES, select_study

MIN_TREES = 10
"""The share of fewer trees is too uncertain to be given an interval."""
SUM_SIZE = 3
"""Trees of a species in a sum: as many as were measured of each."""
METHODS = {"voting": "ours", "template": "the paper's template", "fruitnerf": "FruitNeRF's clustering"}


def head(name: str, records: Sequence[Record], *, for_users: bool = False) -> str:
    """Where a study comes from, and whether it is stale or not complete; for users only when it was measured, and
    whether with an earlier version."""
    own, wanted = select_study(name, records), STUDIES[name].trials
    if not own:
        return "Not measured yet." if for_users else "Not measured yet: `make tables`."
    cells = [record.cells for record in own.values()]
    days = sorted({each["date"] for each in cells})
    measured = f"Measured {' to '.join(dict.fromkeys((days[0], days[-1])))}"
    stale = any(record.stale for record in own.values())
    if for_users:
        return f"{measured} with an earlier version." if stale else f"{measured}."
    commits = sorted({each["commit"] for each in cells})
    text = f"{measured} at commit {', '.join(commits)}, on "
    text += f"{'; '.join(sorted({each['machine'] for each in cells}))}."
    if stale:
        text += " **Stale**: measured with earlier code."
    if len(own) < len(wanted):
        text += f" {len(wanted) - len(own)} of {len(wanted)} rows are not measured yet with this code."
    return text


def tabulate_known_cameras(records: Sequence[Record]) -> str:
    """Tabulate F1 by species and seed with true cameras."""
    own = select_study("known-cameras", records)
    lines = [["species"]]
    for seed in SEEDS[1:]:
        lines[0] += [f"seed {seed}: visible, counted", "F1"]
    scores: dict[int, list[float]] = {seed: [] for seed in SEEDS[1:]}
    for species in SPECIES:
        line = [species]
        for seed in SEEDS[1:]:
            near = _find_near(own.get(Trial(scene=f"{species}-small-{seed}", stage=TRUE_POSES)))
            line += [f"{near.visible}, {near.predicted}", _score(near.f1)] if near else ["", ""]
            scores[seed] += [near.f1] if near else []
        lines.append(line)
    last = ["mean"]
    for seed in SEEDS[1:]:
        last += ["", _score(mean(scores[seed])) if scores[seed] else ""]
    return markdown([*lines, last])


def tabulate_photos_alone(records: Sequence[Record]) -> str:
    """Tabulate true cameras and photos alone, by species: the scenes that were measured with both."""
    lines = [["species", "scenes", "F1, true cameras", "F1, photos alone", "worst", "photos placed"]]
    lines[0] += ["centres / mm", "directions / °"]
    whole = list[_BothCameras]()
    for species in SPECIES:
        pairs = _select_both_cameras("ladder", [f"{species}-small-{seed}" for seed in SEEDS], records)
        whole += pairs
        if pairs:
            lines.append([species, *_means_of(pairs)])
    if whole:
        lines.append(["all", *_means_of(whole)])
    return markdown(lines)


@dataclass(frozen=True, kw_only=True)
class _BothCameras:
    """A scene counted with its true cameras and from photos alone. alone: None if nothing could be counted."""

    scene: str
    known: CountMetrics
    alone: CountMetrics | None
    cameras: CameraErrors | None


def _select_both_cameras(study: str, scenes: Sequence[str], records: Sequence[Record]) -> list[_BothCameras]:
    """Select the scenes of a study that have both rows."""
    own = select_study(study, records)
    found = []
    for scene in scenes:
        known = _find_near(own.get(Trial(scene=scene, stage=TRUE_POSES)))
        record = own.get(Trial(scene=scene, stage=END_TO_END))
        if known and record:
            found.append(
                _BothCameras(scene=scene, known=known, alone=_find_near(record), cameras=record.result.cameras)
            )
    return found


def _means_of(pairs: Sequence[_BothCameras]) -> list[str]:
    """Mean scores and camera errors of scenes; a scene that could not be counted from photos alone has F1 0."""
    alone = [each.alone.f1 if each.alone else 0.0 for each in pairs]
    cameras = [each.cameras for each in pairs if each.cameras]
    return [
        str(len(pairs)),
        _score(mean(each.known.f1 for each in pairs)),
        _score(mean(alone)),
        _score(min(alone)),
        f"{sum(each.placed for each in cameras)} of {sum(each.photos for each in cameras)}",
        *_camera_cells(cameras),
    ]


def _camera_cells(cameras: Sequence[CameraErrors]) -> list[str]:
    """Errors of centres and directions, median and 90th percentile, each the mean of the scenes."""
    if not cameras:
        return ["", ""]
    errors = [(each.center, each.center_90, each.rotation, each.rotation_90) for each in cameras]
    center, center_90, rotation, rotation_90 = map(mean, zip(*errors, strict=True))
    return [f"{1000.0 * center:.1f}, {1000.0 * center_90:.1f}", f"{rotation:.2f}, {rotation_90:.2f}"]


def tabulate_phone(records: Sequence[Record]) -> str:
    """Tabulate true cameras and photos alone by scene, for photos of a phone's size."""
    pairs = _select_both_cameras("phone", [scene.replace(":", "-") for scene in STUDIES["phone"].scenes], records)
    lines = [["scene", "visible", "counted", "F1", "counted, photos alone", "F1, photos alone", "photos placed"]]
    lines[0] += ["centres / mm", "directions / °"]
    for each in pairs:
        line = [each.scene, str(each.known.visible), str(each.known.predicted), _score(each.known.f1)]
        line += [str(each.alone.predicted), _score(each.alone.f1)] if each.alone else ["", "failed"]
        line.append(f"{each.cameras.placed} of {each.cameras.photos}" if each.cameras else "")
        lines.append([*line, *_camera_cells([each.cameras] if each.cameras else [])])
    return markdown(lines)


def tabulate_whole(records: Sequence[Record]) -> str:
    """Tabulate whole trees with true cameras and from photos alone, where they were measured."""
    own = select_study("whole", records)
    measured = ["counted", "F1", "diameter bias"]
    lines = [["tree", "visible", *measured, *(f"{name}, photos alone" for name in measured)]]
    known, alone = list[float](), list[float]()
    for name in (scene.replace(":", "-") for scene in STUDIES["whole"].scenes):
        both = [own.get(Trial(scene=name, stage=stage)) for stage in (TRUE_POSES, END_TO_END)]
        visible = [str(near.visible) for near in map(_find_near, both) if near]
        if any(both):
            lines.append([name, *(visible[:1] or [""]), *_count_cells(both[0]), *_count_cells(both[1])])
        for record, scores in zip(both, (known, alone), strict=True):
            scores += [near.f1 if (near := _find_near(record)) else 0.0] if record else []
    if len(lines) > 1:
        means = [_score(mean(scores)) if scores else "" for scores in (known, alone)]
        lines.append(["**mean**", "", "", means[0], "", "", means[1], ""])
    return markdown(lines)


def _count_cells(record: Record | None) -> list[str]:
    """Return number, F1 and bias of the diameters of a count; empty where it was not measured."""
    near = _find_near(record)
    if near is None:
        return ["", "failed" if record else "", ""]
    return [str(near.predicted), _score(near.f1), f"{near.diameter_bias:+.1%}"]


def tabulate_ladder(records: Sequence[Record]) -> str:
    """Tabulate the ablation ladder with all its tables."""
    own = [record.result for record in select_study("ladder", records).values()]
    return "\n\n".join(table_parts(own))


def tabulate_missed(records: Sequence[Record]) -> str:
    """Tabulate the share of the fruit that are found, by their largest visible part, on trained Gaussians of the
    ladder."""
    own = [record.result for record in select_study("ladder", records).values()]
    lines = visibility_rows([each for each in own if each.stage in (TRUE_MASKS, TRUE_POSES)])
    return markdown(lines) if lines else ""


def tabulate_conditions(records: Sequence[Record]) -> str:
    """Tabulate the scores with one condition changed at a time."""
    own = select_study("conditions", records)
    lines = [["condition", "visible", "counted", "F1", "precision", "recall"]]
    for words, result in condition_results(own):
        near = result.near
        if near is None:
            lines.append([words, "", "", "failed", "", ""])
        else:
            scores = (near.f1, near.precision, near.recall)
            lines.append([words, str(near.visible), str(near.predicted), *map(_score, scores)])
    return markdown(lines)


def condition_results(own: Mapping[Trial, Record]) -> list[tuple[str, StageResult]]:
    """(condition in words, its result) of those that were measured."""
    found = []
    for name, words in CONDITIONS.items():
        scene = "-".join(filter(None, ("apple-small", name, "101")))
        record = own.get(Trial(scene=scene, stage=TRUE_POSES))
        if record:
            found.append((words, record.result))
    return found


def tabulate_methods(records: Sequence[Record]) -> str:
    """Tabulate other ways of counting in the same Gaussians with the same masks."""
    own = select_study("methods", records)
    lines = [["scene", *METHODS.values()]]
    scores: dict[str, list[float]] = {name: [] for name in METHODS}
    for scene in dict.fromkeys(trial.scene for trial in STUDIES["methods"].trials):
        near = {name: _find_near(own.get(Trial(scene=scene, stage=TRUE_POSES, method=name))) for name in METHODS}
        if all(near.values()):
            for name, each in near.items():
                scores[name] += [each.f1] if each else []
            lines.append([scene, *(_score(each.f1) if each else "" for each in near.values())])
    lines.append(["mean", *(_score(mean(values)) if values else "" for values in scores.values())])
    return markdown(lines)


def tabulate_two_photos(records: Sequence[Record]) -> str:
    """Tabulate errors of the number of all fruit on trees that bear different numbers, and how much of the differences
    between trees of a species each method shows."""
    trees = _list_two_ways(records)
    errors = [["trees", "fruit", "mean of the other trees", "two photos × factor", "our count × factor"]]
    errors[0] += ["our estimate of all fruit"]
    shares = [["trees", "two photos", "our count", "our estimate of all fruit"]]
    groups = {name: [tree for tree in trees if tree.species == name] for name in SPECIES}
    groups = {name: own for name, own in groups.items() if len(own) > 1}
    whole = list[list[float]]()
    for name, own in groups.items():
        errors_of_species = [tree.errors([other for other in own if other is not tree]) for tree in own]
        whole += errors_of_species
        totals = [tree.total for tree in own]
        errors.append([f"{len(own)} {name}", f"{min(totals)}–{max(totals)}", *_mean_and_worst(errors_of_species)])
        if len(own) > 2:
            shares.append([f"{len(own)} {name}", *map(_score, _measure_explained([own]))])
    if not whole:
        return markdown(errors)
    errors.append([f"**all {len(whole)}**", "", *_mean_and_worst(whole)])
    shares.append([f"**all {len(whole)}**", *map(_score, _measure_explained(list(groups.values())))])
    return f"{markdown(errors)}\n\n{markdown(shares)}"


@dataclass(frozen=True, kw_only=True)
class _TwoWays:
    """A tree counted in two photos and by us. total: all its fruit; estimate: ours of all fruit."""

    species: str
    seen: int
    counted: int
    estimate: float
    total: int

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Seen in two photos, counted by us, and our estimate of all fruit."""
        return self.seen, self.counted, self.estimate

    def errors(self, others: Sequence[_TwoWays]) -> list[float]:
        """Relative errors of the total: of the mean of other trees, by two photos and by our count with factors from
        these, and of our estimate."""
        total = sum(tree.total for tree in others)
        by_photos = self.seen * total / max(sum(tree.seen for tree in others), 1)
        by_count = self.counted * total / max(sum(tree.counted for tree in others), 1)
        numbers = (total / len(others), by_photos, by_count, self.estimate)
        return [abs(number / self.total - 1.0) for number in numbers]


def _measure_explained(species: Sequence[Sequence[_TwoWays]]) -> list[float]:
    """Measure R², the squared correlation with the true total between trees of a species, of each method's numbers.
    Numbers of different species are compared after division by the species' mean."""
    parts = [np.array([(tree.total, *tree.numbers) for tree in own], np.float64) for own in species]
    relative = np.vstack([part / np.maximum(part.mean(axis=0), 1e-9) - 1.0 for part in parts])
    with np.errstate(invalid="ignore"):
        return [float(value) for value in np.corrcoef(relative.T)[0, 1:] ** 2]


def _list_two_ways(records: Sequence[Record]) -> list[_TwoWays]:
    """List the trees that were counted in both ways, with our estimate of all fruit."""
    own = select_study(TWO_PHOTOS, records)
    found = []
    for trial, record in own.items():
        ours = own.get(replace(trial, method="voting"))
        near = _find_near(ours)
        if trial.method != TWO_PHOTOS or ours is None or near is None or record.result.counted is None:
            continue
        if ours.result.total_estimate is None:
            continue
        tree = _TwoWays(
            species=record.result.species,
            seen=record.result.counted,
            counted=near.predicted,
            estimate=ours.result.total_estimate,
            total=near.total,
        )
        found.append(tree)
    return found


def _mean_and_worst(errors: Sequence[Sequence[float]]) -> list[str]:
    """Mean and largest of each column of errors, in per cent."""
    return [f"{100 * mean(column):.0f} %, {100 * max(column):.0f} %" for column in zip(*errors, strict=True)]


def tabulate_intervals(records: Sequence[Record]) -> str:
    """Tabulate how often the 90 % intervals hold, by species and by the origin of the cameras: of rows of the present
    code or, if there are none, of earlier code."""
    own = [each for each in records if each.trial.method == "voting" and each.trial.stage in (TRUE_POSES, END_TO_END)]
    current = [record.result for record in own if not record.stale]
    results = current or [record.result for record in own]
    groups = {name: [each for each in results if each.species == name] for name in SPECIES}
    groups["true cameras"] = [each for each in results if each.stage == TRUE_POSES]
    groups["photos alone"] = [each for each in results if each.stage == END_TO_END]
    groups["all"] = results
    lines = [["counts of", "counts", "different trees", "visible covered", "width / fruit"]]
    lines[0] += ["all covered", "width / fruit"]
    for name, members in groups.items():
        whole = [each for each in members if each.interval and each.total_interval and each.near]
        if whole:
            trees = {_tree(each) for each in whole}
            lines.append([name, str(len(whole)), str(len(trees)), *_count_held(whole, of_all=False)])
            lines[-1] += _count_held(whole, of_all=True)
    table = markdown(lines)
    return table if current or not results else f"**Stale**: measured with earlier code.\n\n{table}"


def _tree(result: StageResult) -> tuple[str, int | None]:
    """Counts of the same species and seed are of one tree, whatever the condition, the cameras or the photos' size."""
    return result.species, result.seed


def _count_held(results: Sequence[StageResult], *, of_all: bool) -> list[str]:
    """Say how many numbers lie in their intervals, of enough trees with the 95 % interval of that share, and the
    intervals' mean width."""
    by_tree: dict[tuple[str, int | None], list[bool]] = {}
    widths = []
    for each in results:
        interval = each.total_interval if of_all else each.interval
        assert each.near
        assert interval
        number = each.near.total if of_all else each.near.visible
        by_tree.setdefault(_tree(each), []).append(interval[0] <= number <= interval[1])
        widths.append((interval[1] - interval[0]) / max(number, 1))
    text = f"{sum(map(sum, by_tree.values()))} of {len(results)}"
    if len(by_tree) >= MIN_TREES:
        low, high = share_interval([mean(held) for held in by_tree.values()])
        text += f" ({100 * low:.0f}–{100 * high:.0f} %)"
    return [text, _score(mean(widths))]


def share_interval(shares: Sequence[float]) -> tuple[float, float]:
    """Wilson's 95 % interval of a share, from the share of each independent tree: counts of one tree err together, so a
    tree counts once."""
    n, share, z = len(shares), mean(shares), 1.96
    middle = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def tabulate_shared_errors(records: Sequence[Record]) -> str:
    """Tabulate the correlation of errors within species, and how often the intervals of sums of three trees of a
    species hold, by the share of the variance that is taken as common to them."""
    lines = [["number", "correlation within species", "one tree", "sums: independent", "half shared", "as used"]]
    lines[0] += ["from the other species"]
    for stage, cameras in ((END_TO_END, "photos alone"), (TRUE_POSES, "true cameras")):
        for name, shared in (("visible", SHARED_VISIBLE), ("total", SHARED_ALL)):
            trees = _select_measured_trees(records, stage, name)
            if len(trees) < 3 or min(map(len, trees.values())) < 2:
                continue
            found = estimate_shared_error(trees)
            held = [mean(measure_held_sums(own, 0.0, 1) for own in trees.values())]
            held += [
                mean(measure_held_sums(own, each, SUM_SIZE) for own in trees.values()) for each in (0.0, 0.5, shared)
            ]
            held.append(measure_held_sums_left_out(trees, SUM_SIZE))
            correlation = f"{found.value:.2f} ({found.low:.2f}–{found.high:.2f})"
            fruit = {"visible": "visible", "total": "all"}[name]
            lines.append([f"{fruit}, {cameras}", correlation, *(f"{100 * each:.0f} %" for each in held)])
    return markdown(lines) if len(lines) > 1 else ""


def _select_measured_trees(records: Sequence[Record], stage: str, number: str) -> dict[str, list[MeasuredTree]]:
    """Select {species: its trees in a stage of the ladder}. number: of the fruit that are counted, visible or total."""
    found: dict[str, list[MeasuredTree]] = {}
    for record in select_study("ladder", records).values():
        result = record.result
        interval = result.interval if number == "visible" else result.total_interval
        if record.trial.stage == stage and interval is not None and result.near is not None:
            tree = MeasuredTree(true=getattr(result.near, number), low=interval[0], high=interval[1])
            found.setdefault(result.species, []).append(tree)
    return found


def summary_line(name: str, records: Sequence[Record]) -> str:
    """Mean F1, precision and recall with true cameras of a study of all species, and its worst scene."""
    own = [each.result for each in select_study(name, records).values() if each.trial.stage == TRUE_POSES]
    near = [each.near for each in own if each.near]
    if not near or name not in ("known-cameras", "ladder"):
        return ""
    whole = summarise(near)
    worst = min((each for each in own if each.near), key=lambda each: each.near.f1 if each.near else math.inf)
    assert worst.near is not None
    return (
        f"Mean F1 {_score(whole.f1)}, precision {_score(whole.precision)}, recall {_score(whole.recall)}; worst scene "
        f"{worst.scene}, F1 {_score(worst.near.f1)}."
    )


def _find_near(record: Record | None) -> CountMetrics | None:
    return record.result.near if record else None


def _score(value: float) -> str:
    return f"{value:.3f}" if not math.isnan(value) else ""


TABLES: Mapping[str, Callable[[Sequence[Record]], str]] = {
    "known-cameras": tabulate_known_cameras,
    "ladder": tabulate_ladder,
    "photos-alone": tabulate_photos_alone,
    "missed": tabulate_missed,
    "phone": tabulate_phone,
    "whole": tabulate_whole,
    "conditions": tabulate_conditions,
    "methods": tabulate_methods,
    TWO_PHOTOS: tabulate_two_photos,
    "intervals": tabulate_intervals,
    "shared-errors": tabulate_shared_errors,
}
"""{name of a block of a document: its table}."""
STUDY_OF: Mapping[str, str] = {name: name for name in STUDIES} | {"photos-alone": "ladder", "missed": "ladder"}
"""{table: the study that it is made from}; others have no head."""
