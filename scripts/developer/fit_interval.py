"""Fit the intervals of a count, and write engine/counting/accounts/interval.json.

    python scripts/developer/fit_interval.py --renders RENDERS
    python scripts/developer/fit_interval.py --stored    # only print the coverages on the stored examples

Simulated crowns of the six named settings and of random settings, and, with RENDERS, Gaussians trained on all and on
half of the photos of its rendered trees, are searched for fruit; the number of true fruit over the sum of the
candidates' probabilities is then predicted from what a scene shows. Prints in how many scenes the 90 % intervals cover
the truth, each by a ratio that was fitted and stretched without all scenes of its tree. Visible fruit are those that
three views show and others that were found. What each scene shows is kept in fitting/counting/interval_examples.csv.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401  puts the checkout on the path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from _terminal import import_tyro, run
from fruitlangs.benchmarks.counting.simulated import SETTINGS, sample_setting
from fruitlangs.benchmarks.evidence.tables import share_interval
from fruitlangs.benchmarks.markdown import markdown
from fruitlangs.engine.counting.accounts.interval import (
    ALONE,
    COVARIATES,
    QUANTILE,
    STORED,
    TRAINED,
    WITH_PHOTOS,
    Ratio,
    gather_evidence,
)
from fruitlangs.engine.counting.evidence.cluster import LIKELY
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.evaluation.metrics import count_metrics
from fruitlangs.engine.storage.files import write_text
from fruitlangs.fitting.counting.cases import (
    Case,
    check_seed,
    iterate_halved_cases,
    iterate_rendered_cases,
    search_case,
    simulate_cases,
)
from fruitlangs.fitting.counting.examples import (
    STORED_EXAMPLES,
    Example,
    merge_examples,
    read_examples,
    write_examples,
)
from fruitlangs.orchard.config import FIRST_TRAINING_SEED

tyro = import_tyro()
FloatArray = NDArray[np.float64]

HELD = 0.5
"""Weight of the squares of a ratio's weights and slopes relative to the likelihood."""
COVERAGE = 0.9
FEWEST = 10
"""Fewer scenes than this have no stretch of their own."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to fit on."""

    crowns: int = 3
    """Simulated crowns of each named setting."""
    drawn: int = 40
    """Simulated crowns of settings drawn at random."""
    first: int = FIRST_TRAINING_SEED
    """Seed of the first one; seeds below 1000 are for tests and tables."""
    test_seeds: int = 0
    """Crowns of random settings, of seeds from 0 on, to test the fitted intervals on."""
    renders: Path | None = None
    """Folder of rendered trees, written by `make_orchard.py --scenes`."""
    examples: Path = STORED_EXAMPLES
    """Table of what each scene shows; scenes that are searched replace its rows."""
    stored: bool = False
    """Search no scene and write nothing: print the coverages on the rows of the table."""
    out: Path = STORED
    """File to write."""


Truth = Callable[[Example], int]
TRUTHS: dict[str, Truth] = {"visible": lambda example: example.visible, "total": lambda example: example.total}


def main(options: Options) -> None:
    check_seed(options.first)
    earlier = read_examples(options.examples)
    if options.stored and not earlier:
        raise ConfigError(f"{options.examples} has no examples. Leave out --stored to search scenes")
    examples = earlier if options.stored else search_examples(options)
    fitted = {part: fit_part(examples, photos) for part, photos in ((ALONE, False), (WITH_PHOTOS, True))}
    if options.stored:
        return
    write_examples(merge_examples(earlier, examples), options.examples)
    document = json.loads(options.out.read_text(encoding="utf-8")) if options.out.is_file() else {}
    document.update({part: each for part, each in fitted.items() if each})
    write_text(options.out, json.dumps(document, indent=1) + "\n")
    unseen = [found for case in sample_cases(0, options.test_seeds) for found in make_example(case)]
    for name, truth in TRUTHS.items():
        if unseen:
            ratio = Ratio.read(document[ALONE][name])
            held = np.mean([holds(ratio, each, truth(each)) for each in unseen])
            print(f"{name}: the interval holds the truth in {held:.0%} of {len(unseen)} crowns of unseen settings")


def fit_part(examples: Sequence[Example], photos: bool) -> dict[str, Any]:
    """Fit the part of interval.json for scenes whose fruit were searched in photos, or not; empty without examples.
    Prints the coverages."""
    chosen = [each for each in examples if each.evidence.photos == photos]
    if not chosen:
        return {}
    fitted = {name: fit(chosen, truth) for name, truth in TRUTHS.items()}
    print(table(chosen, {name: without for name, (_, without) in fitted.items()}))
    ratios = {name: ratio.document() for name, (ratio, _) in fitted.items()}
    return {**ratios, "fitted on": sorted({each.family for each in chosen})}


def search_examples(options: Options) -> list[Example]:
    """Search simulated crowns and rendered trees for fruit."""
    named = simulate_cases(SETTINGS, range(options.first, options.first + options.crowns))
    drawn = sample_cases(options.first + 1000, options.drawn)
    rendered = (
        (iterate_rendered_cases(options.renders), iterate_halved_cases(options.renders)) if options.renders else ()
    )
    cases = itertools.chain(named, drawn, *rendered)
    return [found for case in cases for found in make_example(case)]


def sample_cases(first: int, number: int) -> itertools.chain[Case]:
    """Generate one crown for each of this many random settings."""
    seeds = range(first, first + number)
    return itertools.chain.from_iterable(simulate_cases({"drawn": sample_setting(seed)}, [seed]) for seed in seeds)


def make_example(case: Case) -> list[Example]:
    """Return the evidence of a scene; none if no part of it is round."""
    result = search_case(case)
    if result is None:
        return []
    found, pictures = result
    spheres = found.found.spheres
    kept = found.probabilities > LIKELY
    measured = count_metrics(spheres.centers[kept], 2.0 * spheres.radii[kept], replace(case.truth, visible=case.shown))
    evidence = gather_evidence(found, np.ones(len(spheres)), pictures, seed=0)
    visible = int(case.shown.sum()) + measured.ignored
    return [Example(case.kind, case.family, evidence, visible, case.truth.total)] if evidence.expected > 0 else []


def fit(examples: Sequence[Example], truth: Truth) -> tuple[Ratio, dict[str, Ratio]]:
    """The ratio, and by family the ratio that was fitted and stretched without it."""
    families = sorted({example.family for example in examples})
    without = {family: fit_stretched(_select_others(examples, family), truth) for family in families}
    return fit_stretched(examples, truth), without


def fit_stretched(examples: Sequence[Example], truth: Truth) -> Ratio:
    """Fit the ratio of maximum likelihood; crowns and rendered trees have the same weight.

    It is stretched until nine tenths of the examples are covered, each by a ratio fitted without its family, with
    separate stretches for true surfaces and trained scenes.
    """
    families = sorted({example.family for example in examples})
    without = {family: _fit(_select_others(examples, family), truth) for family in families}
    needed = np.array([_find_needed_stretch(without[e.family], e, truth(e)) for e in examples])
    trained = np.array([e.evidence.faint > TRAINED / 2.0 for e in examples])
    parts = [needed[part] if part.sum() >= FEWEST else needed for part in (~trained, trained)]
    stretches = np.array([np.quantile(part, COVERAGE, method="higher") for part in parts])
    return replace(_fit(examples, truth), stretches=stretches)


def _select_others(examples: Sequence[Example], family: str) -> list[Example]:
    return [example for example in examples if example.family != family]


def _fit(examples: Sequence[Example], truth: Truth) -> Ratio:
    n = len(COVARIATES)
    loss = Loss.of(examples, truth)
    bounds = [(-0.5, 0.5), *[(0.0, 2.0)] * n, (-5.0, 0.0), *[(0.0, 3.0)] * n]
    starts = [np.array([0.0, *[0.1] * n, np.log(0.03), *[slope] * n]) for slope in (0.03, 0.2)]
    found = [minimize(loss.compute_with_gradient, start, jac=True, bounds=bounds) for start in starts]
    x = min(found, key=lambda each: each.fun).x
    return Ratio(float(x[0]), x[1 : n + 1], float(np.exp(x[n + 1])), x[n + 2 :], np.ones(2))


@dataclass(frozen=True, eq=False)
class Loss:
    """Negative log likelihood of a ratio's bias, weights, logarithm of the floor and slopes (8,), and the squares of
    weights and slopes. covariates: (E, 3); of the others one per example (E,)."""

    covariates: FloatArray
    variance_share: FloatArray
    log_ratios: FloatArray
    importance: FloatArray

    @classmethod
    def of(cls, examples: Sequence[Example], truth: Truth) -> Loss:
        return cls(
            covariates=np.array([e.evidence.covariates for e in examples]),
            variance_share=np.array([e.evidence.variance / max(e.evidence.expected, 1.0) ** 2 for e in examples]),
            log_ratios=np.array([_log_ratio(e, truth(e)) for e in examples]),
            importance=_weigh_examples(examples),
        )

    def compute_with_gradient(self, x: FloatArray) -> tuple[float, FloatArray]:
        n = len(COVARIATES)
        weights, log_floor, slopes = x[1 : n + 1], x[n + 1], x[n + 2 :]
        errors = self.log_ratios - x[0] - self.covariates @ weights
        squares = np.exp(2.0 * log_floor) + self.variance_share + self.covariates**2 @ slopes**2
        terms = 0.5 * np.log(squares) + 0.5 * errors**2 / squares
        by_errors = self.importance * errors / squares
        by_squares = self.importance * 0.5 * (1.0 - errors**2 / squares) / squares
        gradient = np.concatenate(
            [
                [-by_errors.sum()],
                -self.covariates.T @ by_errors + 2.0 * HELD * weights,
                [2.0 * np.exp(2.0 * log_floor) * by_squares.sum()],
                2.0 * slopes * (self.covariates.T**2 @ by_squares + HELD),
            ]
        )
        return float(self.importance @ terms + HELD * (weights**2).sum() + HELD * (slopes**2).sum()), gradient


def _log_ratio(example: Example, truth: int) -> float:
    return float(np.log(max(truth, 0.5) / example.evidence.expected))


def _find_needed_stretch(ratio: Ratio, example: Example, truth: int) -> float:
    """Find the stretch at which the interval, half a fruit wider at either end, just covers the truth."""
    number = ratio.likeliest(example.evidence)
    beyond = max(number / (truth + 0.5), (truth - 0.5) / number, 1.0)
    return float(np.log(beyond)) / (QUANTILE * ratio.deviation(example.evidence))


def _weigh_examples(examples: Sequence[Example]) -> FloatArray:
    """Return weights (E,) with equal sums for crowns and rendered trees, with a mean of 1."""
    rendered_scene = np.array([example.kind.startswith("walk") for example in examples])
    shares = np.where(rendered_scene, 1.0 / max(rendered_scene.sum(), 1), 1.0 / max((~rendered_scene).sum(), 1))
    return shares / shares.mean()


def holds(ratio: Ratio, example: Example, truth: int) -> bool:
    """Whether the interval covers the truth."""
    low, high = ratio.interval(example.evidence)
    return low <= truth <= high


def table(examples: Sequence[Example], without: Mapping[str, Mapping[str, Ratio]]) -> str:
    """Markdown by kind of scene: the coverage of the intervals with its 95 % interval, in which a tree counts once, and
    the widths of the intervals relative to the truth.

    without: by target and by family, the ratio fitted without that family.
    """
    lines = [["scene", "scenes", "different trees", "visible held", "width", "all held", "width"]]
    groups = {kind: [e for e in examples if e.kind == kind] for kind in dict.fromkeys(e.kind for e in examples)}
    for kind, own in {**groups, "all": list(examples)}.items():
        cells = [kind, str(len(own)), str(len({example.family for example in own}))]
        for name, truth in TRUTHS.items():
            cells += _coverage(own, without[name], truth)
        lines.append(cells)
    return markdown(lines)


def _coverage(examples: Sequence[Example], without: Mapping[str, Ratio], truth: Truth) -> list[str]:
    """Share of the examples that their intervals cover, and the mean width of these."""
    held: dict[str, list[bool]] = {}
    widths = []
    for each in examples:
        low, high = without[each.family].interval(each.evidence)
        held.setdefault(each.family, []).append(low <= truth(each) <= high)
        widths.append((high - low) / max(truth(each), 1))
    share = sum(map(sum, held.values())) / len(examples)
    least, most = share_interval([float(np.mean(of_tree)) for of_tree in held.values()])
    return [f"{share:.2f} ({least:.2f}–{most:.2f})", f"{np.mean(widths):.2f}"]


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
