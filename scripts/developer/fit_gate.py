"""Fit the classifier of spheres, and write engine/counting/evidence/gate.json.

    python scripts/developer/fit_gate.py --renders RENDERS

Candidates come from simulated crowns of all settings and, with RENDERS, from its rendered trees: from Gaussians trained
on them, once with true masks and once with the embedded encoder's probabilities of their fruit, and from their true
surfaces with true masks. A candidate is a fruit if it is matched one to one with a true one within half a mean
diameter. Crowns and rendered trees have the same weight. Prints the accuracy on each kind of scene of a classifier
that was fitted without that scene.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401  puts the checkout on the path

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler

from _terminal import import_tyro, run
from fruitlangs.benchmarks.counting.simulated import SETTINGS
from fruitlangs.benchmarks.markdown import markdown
from fruitlangs.engine.counting.evidence.cluster import LIKELY
from fruitlangs.engine.counting.evidence.gate import STORED, WEIGHED, Gate, stack_features
from fruitlangs.engine.evaluation.judgement import judge
from fruitlangs.engine.storage.files import write_text
from fruitlangs.fitting.counting.cases import (
    Case,
    check_seed,
    iterate_rendered_cases,
    iterate_surface_cases,
    search_case,
    simulate_cases,
)
from fruitlangs.orchard.config import FIRST_TRAINING_SEED

tyro = import_tyro()
FloatArray = NDArray[np.float64]

EDGE = 0.01
"""Share of the candidates at either end of a feature whose values are clipped."""
REGULARISATION = 0.1
"""Inverse strength of the penalty on the regression's weights."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to fit on."""

    crowns: int = 13
    """Simulated crowns of each setting."""
    first: int = FIRST_TRAINING_SEED
    """Seed of the first one; seeds below 1000 are for tests and tables."""
    renders: Path | None = None
    """Folder of rendered trees, written by `make_orchard.py --scenes`."""
    out: Path = STORED
    """File to write."""


@dataclass(frozen=True, eq=False)
class Example:
    """The candidates of one scene. features: (C, n) those in WEIGHED; fruit, surest: (C,); visible: number of fruit to
    find; kind: of scene; family: scenes that are never judged by a classifier fitted to another of them."""

    kind: str
    family: str
    features: FloatArray
    fruit: NDArray[np.bool_]
    surest: FloatArray
    visible: int


def main(options: Options) -> None:
    check_seed(options.first)
    crowns = simulate_cases(SETTINGS, range(options.first, options.first + options.crowns))
    rendered = (
        (iterate_rendered_cases(options.renders), iterate_surface_cases(options.renders)) if options.renders else ()
    )
    cases = itertools.chain(crowns, *rendered)
    examples = [found for case in cases for found in make_example(case)]
    print(table(examples))
    document = {**fit(examples).document(), "fitted on": sorted({example.family for example in examples})}
    write_text(options.out, json.dumps(document, indent=1) + "\n")


def make_example(case: Case) -> Iterator[Example]:
    """Return the candidates of a scene; none if no part of it is round."""
    result = search_case(case)
    if result is None:
        return
    found, _ = result
    judged = judge(found.found.spheres.centers, 2.0 * found.found.spheres.radii, case.truth)
    own = np.setdiff1d(np.arange(len(found.probabilities)), judged.ignored)  # on fruit that does not count
    fruit, surest = np.isin(own, judged.pairs.predicted), found.features["surest"][own]
    visible = int(case.truth.visible.sum())
    yield Example(case.kind, case.family, stack_features(found.features)[own], fruit, surest, visible)


def fit(examples: Sequence[Example]) -> Gate:
    """The logistic regression of all candidates on their features and products of features.

    Crowns and rendered trees have the same weight, and so have the kinds of scene within each.
    """
    features = np.concatenate([example.features for example in examples])
    fruit = np.concatenate([example.fruit for example in examples])
    low, high = np.quantile(features, [EDGE, 1.0 - EDGE], axis=0)
    cut = np.clip(features, low, high)
    scaler, n = StandardScaler().fit(cut), features.shape[1]
    rows, columns = np.triu_indices(n)
    x = scaler.transform(cut)
    products = np.concatenate([x, x[:, rows] * x[:, columns]], axis=1)
    model = LogisticRegression(C=REGULARISATION, max_iter=5000).fit(
        products, fruit, sample_weight=_weigh_examples(examples)
    )
    quadratic = np.zeros((n, n))
    quadratic[rows, columns] = model.coef_[0, n:]
    return Gate(low, high, scaler.mean_, scaler.scale_, model.coef_[0, :n], quadratic, float(model.intercept_[0]))


def _weigh_examples(examples: Sequence[Example]) -> FloatArray:
    """Return the weights (C,) of all candidates, with a mean of 1."""
    sizes, families = dict[str, int](), dict[bool, set[str]]()
    for example in examples:
        sizes[example.kind] = sizes.get(example.kind, 0) + len(example.fruit)
        families.setdefault(example.kind.startswith("walk"), set()).add(example.kind)
    shares = [np.full(len(e.fruit), 1.0 / sizes[e.kind] / len(families[e.kind.startswith("walk")])) for e in examples]
    together = np.concatenate(shares)
    return together / together.mean()


def table(examples: Sequence[Example]) -> str:
    """Markdown: means by kind of scene, each judged by a classifier fitted without the scenes of its family."""
    families = {example.family for example in examples}
    gates = {family: fit([example for example in examples if example.family != family]) for family in families}
    lines = [["scene", "scenes", "precision", "recall", "F1", "sum of probabilities / fruit"]]
    for kind in dict.fromkeys(example.kind for example in examples):
        rows = [judge_example(example, gates[example.family]) for example in examples if example.kind == kind]
        lines.append([kind, str(len(rows)), *(f"{value:.3f}" for value in np.mean(rows, axis=0))])
    return markdown(lines)


def judge_example(example: Example, gate: Gate) -> tuple[float, float, float, float]:
    """Return precision, recall, F1, and the sum of probabilities per fruit among the candidates."""
    probabilities = gate.probabilities(
        {**dict(zip(WEIGHED, example.features.T, strict=True)), "surest": example.surest}
    )
    kept = probabilities > LIKELY
    right = int((kept & example.fruit).sum())
    precision, recall = right / max(int(kept.sum()), 1), right / example.visible
    return (
        precision,
        recall,
        2.0 * right / (int(kept.sum()) + example.visible),
        probabilities.sum() / example.fruit.sum(),
    )


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
