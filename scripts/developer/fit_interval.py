"""Fit the intervals of a count, and write engine/counting/accounts/interval.json.

    python scripts/developer/fit_interval.py --renders RENDERS

Simulated crowns of the six named settings and of random settings, and, with RENDERS, Gaussians trained on all and on
half of the photos of its rendered trees, are searched for fruit; the number of true fruit over the sum of the
candidates' probabilities is then predicted from what a scene shows. Prints in how many scenes the 90 % intervals cover
the truth, each by ratios that were fitted without it. Visible fruit are those that three views show and others that
were found.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401  puts the checkout on the path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from _terminal import import_tyro, run
from fruitlangs.benchmarks.counting.simulated import SETTINGS, any_setting
from fruitlangs.benchmarks.markdown import markdown
from fruitlangs.engine.counting.accounts.interval import (
    ALONE,
    COVARIATES,
    QUANTILE,
    STORED,
    TRAINED,
    WITH_PHOTOS,
    Evidence,
    Ratio,
    evidence_of,
)
from fruitlangs.engine.counting.evidence.cluster import LIKELY
from fruitlangs.engine.evaluation.metrics import count_metrics
from fruitlangs.engine.storage.files import write_text
from fruitlangs.fitting.counting.cases import Case, check_seed, crown_cases, halved_cases, rendered_cases, searched
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
    out: Path = STORED
    """File to write."""


@dataclass(frozen=True, eq=False)
class Example:
    """One scene. kind, family: as in `Case`; visible: true fruit that views show, and others that were found; total:
    all true fruit."""

    kind: str
    family: str
    evidence: Evidence
    visible: int
    total: int


Truth = Callable[[Example], int]
TRUTHS: dict[str, Truth] = {"visible": lambda example: example.visible, "total": lambda example: example.total}


def main(options: Options) -> None:
    check_seed(options.first)
    named = crown_cases(SETTINGS, range(options.first, options.first + options.crowns))
    drawn = drawn_cases(options.first + 1000, options.drawn)
    rendered = (rendered_cases(options.renders), halved_cases(options.renders)) if options.renders else ()
    cases = itertools.chain(named, drawn, *rendered)
    examples = [found for case in cases for found in example(case)]
    document = json.loads(options.out.read_text(encoding="utf-8")) if options.out.is_file() else {}
    for part, own in ((ALONE, False), (WITH_PHOTOS, True)):
        if chosen := [each for each in examples if each.evidence.photos == own]:
            fitted = {name: fit(chosen, truth) for name, truth in TRUTHS.items()}
            print(table(chosen, {name: without for name, (_, without) in fitted.items()}))
            families = sorted({each.family for each in chosen})
            ratios = {name: ratio.document() for name, (ratio, _) in fitted.items()}
            document[part] = {**ratios, "fitted on": families}
    write_text(options.out, json.dumps(document, indent=1) + "\n")
    unseen = [found for case in drawn_cases(0, options.test_seeds) for found in example(case)]
    for name, truth in TRUTHS.items():
        if unseen:
            ratio = Ratio.read(document[ALONE][name])
            held = np.mean([holds(ratio, each, truth(each)) for each in unseen])
            print(f"{name}: the interval holds the truth in {held:.0%} of {len(unseen)} crowns of unseen settings")


def drawn_cases(first: int, number: int) -> itertools.chain[Case]:
    """One crown for each of this many random settings."""
    seeds = range(first, first + number)
    return itertools.chain.from_iterable(crown_cases({"drawn": any_setting(seed)}, [seed]) for seed in seeds)


def example(case: Case) -> list[Example]:
    """The evidence of a scene; none if no part of it is round."""
    result = searched(case)
    if result is None:
        return []
    found, pictures = result
    spheres = found.found.spheres
    kept = found.probabilities > LIKELY
    measured = count_metrics(spheres.centers[kept], 2.0 * spheres.radii[kept], replace(case.truth, visible=case.shown))
    evidence = evidence_of(found, np.ones(len(spheres)), pictures, seed=0)
    visible = int(case.shown.sum()) + measured.ignored
    return [Example(case.kind, case.family, evidence, visible, case.truth.total)] if evidence.expected > 0 else []


def fit(examples: Sequence[Example], truth: Truth) -> tuple[Ratio, dict[str, Ratio]]:
    """The ratio of maximum likelihood, and by family those fitted without it; crowns and rendered trees have the same
    weight.

    All are stretched until nine tenths of the scenes are covered, each by a ratio fitted without its family, with
    separate stretches for true surfaces and trained scenes.
    """
    families = sorted({example.family for example in examples})
    without = {family: _fit([e for e in examples if e.family != family], truth) for family in families}
    needed = np.array([_needed(without[e.family], e, truth(e)) for e in examples])
    trained = np.array([e.evidence.faint > TRAINED / 2.0 for e in examples])
    parts = [needed[part] if part.sum() >= FEWEST else needed for part in (~trained, trained)]
    stretches = np.array([np.quantile(part, COVERAGE, method="higher") for part in parts])
    stretched = {family: replace(ratio, stretches=stretches) for family, ratio in without.items()}
    return replace(_fit(examples, truth), stretches=stretches), stretched


def _fit(examples: Sequence[Example], truth: Truth) -> Ratio:
    n, weights = len(COVARIATES), _weights(examples)
    covariates = np.array([e.evidence.covariates for e in examples])
    variance_share = np.array([e.evidence.variance / max(e.evidence.expected, 1.0) ** 2 for e in examples])
    ratios = np.array([_log_ratio(e, truth(e)) for e in examples])

    def loss(x: FloatArray) -> float:
        errors = ratios - x[0] - covariates @ x[1 : n + 1]
        squares = np.exp(2.0 * x[n + 1]) + variance_share + ((x[n + 2 :] * covariates) ** 2).sum(axis=1)
        terms = 0.5 * np.log(squares) + 0.5 * errors**2 / squares
        return float(weights @ terms + HELD * ((x[1 : n + 1] ** 2).sum() + (x[n + 2 :] ** 2).sum()))

    bounds = [(-0.5, 0.5), *[(0.0, 2.0)] * n, (-5.0, 0.0), *[(0.0, 3.0)] * n]
    starts = [np.array([0.0, *[0.1] * n, np.log(0.03), *[slope] * n]) for slope in (0.03, 0.2)]
    x = min((minimize(loss, start, bounds=bounds) for start in starts), key=lambda found: found.fun).x
    return Ratio(float(x[0]), x[1 : n + 1], float(np.exp(x[n + 1])), x[n + 2 :], np.ones(2))


def _log_ratio(example: Example, truth: int) -> float:
    return float(np.log(max(truth, 0.5) / example.evidence.expected))


def _needed(ratio: Ratio, example: Example, truth: int) -> float:
    """The stretch at which the interval, half a fruit wider at either end, just covers the truth."""
    number = ratio.likeliest(example.evidence)
    beyond = max(number / (truth + 0.5), (truth - 0.5) / number, 1.0)
    return float(np.log(beyond)) / (QUANTILE * ratio.deviation(example.evidence))


def _weights(examples: Sequence[Example]) -> FloatArray:
    """(E,) weights with equal sums for crowns and rendered trees, with a mean of 1."""
    rendered_scene = np.array([example.kind.startswith("walk") for example in examples])
    shares = np.where(rendered_scene, 1.0 / max(rendered_scene.sum(), 1), 1.0 / max((~rendered_scene).sum(), 1))
    return shares / shares.mean()


def holds(ratio: Ratio, example: Example, truth: int) -> bool:
    """Whether the interval covers the truth."""
    low, high = ratio.interval(example.evidence)
    return low <= truth <= high


def table(examples: Sequence[Example], without: Mapping[str, Mapping[str, Ratio]]) -> str:
    """Markdown: by kind of scene, the coverage of the intervals and their widths relative to the truth.

    without: by target and by family, the ratio fitted without that family.
    """
    lines = [["scene", "scenes", "visible held", "width", "all held", "width"]]
    for kind in dict.fromkeys(example.kind for example in examples):
        own = [example for example in examples if example.kind == kind]
        figures = []
        for name, truth in TRUTHS.items():
            ratios = [without[name][each.family] for each in own]
            figures.append(np.mean([holds(ratio, e, truth(e)) for ratio, e in zip(ratios, own, strict=True)]))
            ends = [ratio.interval(e.evidence) for ratio, e in zip(ratios, own, strict=True)]
            figures.append(np.mean([(high - low) / max(truth(e), 1) for (low, high), e in zip(ends, own, strict=True)]))
        lines.append([kind, str(len(own)), *(f"{figure:.2f}" for figure in figures)])
    return markdown(lines)


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
