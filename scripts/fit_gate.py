"""Fit the gate that tells which spheres are fruit, and write engine/counting/gate.json.

    python scripts/fit_gate.py --renders RENDERS

Candidates are taken from simulated crowns of all settings and, with RENDERS, from Gaussians trained on its rendered
walks, once with true masks and once with the embedded encoder's probabilities of the walk's fruit. A candidate is a
fruit when it is matched one to one with a true one within half a mean diameter. Crowns and walks weigh alike. Prints
how well each kind of scene is told by a gate that was fitted without that scene.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import _checkout  # noqa: F401  puts the checkout on the path

import numpy as np
import torch
from encoder.lifted import trained, true_fruit, walks
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler

from _terminal import import_tyro, run, terminal_progress
from fruitlangs.benchmarks.markdown import markdown
from fruitlangs.benchmarks.rivals import surface_of
from fruitlangs.benchmarks.simulated import SETTINGS, simulate
from fruitlangs.engine.config import CountConfig, SceneConfig
from fruitlangs.engine.counting.cluster import LIKELY, search
from fruitlangs.engine.counting.gate import STORED, WEIGHED, Gate, standardised, weighed
from fruitlangs.engine.counting.visibility import draw
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.evaluation.judgement import judge
from fruitlangs.engine.evaluation.truth import Truth, read_truth
from fruitlangs.engine.files import write_text
from fruitlangs.engine.language.embedded import EmbeddedEncoder
from fruitlangs.engine.language.lift import encode_photos, lift_features
from fruitlangs.engine.language.relevancy import relevancy
from fruitlangs.engine.scene.camera import Camera
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.engine.splatting.gaussians import Gaussians
from orchard.config import FIRST_TRAINING_SEED

tyro = import_tyro()
FloatArray = NDArray[np.float64]

REGULARISATION = 0.1
"""Inverse strength of the penalty on the regression's weights."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to fit on."""

    crowns: int = 3
    """Simulated crowns of each setting."""
    first: int = FIRST_TRAINING_SEED
    """Seed of the first one; seeds below 1000 are for tests and tables."""
    renders: Path | None = None
    """Folder of rendered walks, as `make_orchard.py --scenes` writes them."""
    out: Path = STORED
    """File to write."""


@dataclass(frozen=True, eq=False)
class Example:
    """The candidates of one scene. features: (C, n) those WEIGHED; fruit, surest: (C,); visible: fruit that are to be
    found; kind: of scene; family: scenes of which none is judged by a gate fitted to another."""

    kind: str
    family: str
    features: FloatArray
    fruit: NDArray[np.bool_]
    surest: FloatArray
    visible: int


def main(options: Options) -> None:
    if options.first < FIRST_TRAINING_SEED:
        raise ConfigError(f"seeds below {FIRST_TRAINING_SEED} are for tests and tables; give a larger --first")
    examples = [*crown_examples(options), *(walk_examples(options.renders) if options.renders else ())]
    print(table(examples))
    document = {**fit(examples).document(), "fitted on": sorted({example.family for example in examples})}
    write_text(options.out, json.dumps(document, indent=1) + "\n")


def crown_examples(options: Options) -> Iterator[Example]:
    """Candidates in simulated crowns of every setting."""
    progress = terminal_progress()
    todo = [(name, options.first + number) for number in range(options.crowns) for name in SETTINGS]
    for place, (name, seed) in enumerate(todo):
        progress(place / len(todo), f"{name}, seed {seed}")
        crown = simulate(SETTINGS[name], seed)
        yield from example(name, f"crown {seed}", crown.gaussians, crown.probability, crown.cameras, crown.truth)
    progress(1.0, "crowns done")


def walk_examples(renders: Path) -> Iterator[Example]:
    """Candidates in Gaussians trained on rendered walks, by true masks and by the encoder of the package."""
    progress, encoder, folders = terminal_progress(), EmbeddedEncoder.open(), walks(renders)
    for place, folder in enumerate(folders):
        progress(place / len(folders), f"walk {folder.name}")
        scene, gaussians = read_scene(folder, SceneConfig()), trained(folder)
        species = json.loads((folder / "orchard.json").read_text(encoding="utf-8"))["config"]["species"]
        truth = read_truth(folder / "truth.json", {species})
        features = lift_features(gaussians, scene.cameras, encode_photos(scene, encoder), encoder_id=encoder.identity)
        by_kind = {
            "walk, true masks": true_fruit(folder, scene, gaussians),
            "walk, encoder": relevancy(features, encoder, [species]),
        }
        for kind, probability in by_kind.items():
            yield from example(kind, f"walk {folder.name}", gaussians, probability, scene.cameras, truth)
    progress(1.0, "walks done")


def example(
    kind: str,
    family: str,
    gaussians: Gaussians,
    probability: torch.Tensor,
    cameras: Sequence[Camera],
    truth: Truth,
) -> Iterator[Example]:
    """The candidates of a scene; none where nothing in it looks round."""
    surface = surface_of(gaussians, probability, cameras)
    if surface.sample is None:
        return
    points, size = surface.sample
    pictures = draw(gaussians, probability.double().numpy(), cameras)
    found = search(points, size, pictures, CountConfig().threshold)
    judged = judge(found.found.spheres.centers, 2.0 * found.found.spheres.radii, truth)
    told = np.setdiff1d(np.arange(len(found.chances)), judged.ignored)  # on fruit that is not to be counted
    fruit = np.isin(told, judged.pairs.predicted)
    yield Example(
        kind, family, weighed(found.features)[told], fruit, found.features["surest"][told], int(truth.visible.sum())
    )


def fit(examples: Sequence[Example]) -> Gate:
    """The logistic regression of all candidates on their features and the products of these.

    Crowns and walks weigh alike, and of each the kinds of scene.
    """
    features = np.concatenate([example.features for example in examples])
    fruit = np.concatenate([example.fruit for example in examples])
    scaler, n = StandardScaler().fit(features), features.shape[1]
    rows, columns = np.triu_indices(n)
    x = standardised(features, scaler.mean_, scaler.scale_)
    products = np.concatenate([x, x[:, rows] * x[:, columns]], axis=1)
    model = LogisticRegression(C=REGULARISATION, max_iter=5000).fit(products, fruit, sample_weight=_shares(examples))
    quadratic = np.zeros((n, n))
    quadratic[rows, columns] = model.coef_[0, n:]
    return Gate(scaler.mean_, scaler.scale_, model.coef_[0, :n], quadratic, float(model.intercept_[0]))


def _shares(examples: Sequence[Example]) -> FloatArray:
    """(C,) weights of all candidates, 1 on the mean."""
    sizes, families = dict[str, int](), dict[bool, set[str]]()
    for example in examples:
        sizes[example.kind] = sizes.get(example.kind, 0) + len(example.fruit)
        families.setdefault(example.kind.startswith("walk"), set()).add(example.kind)
    shares = [np.full(len(e.fruit), 1.0 / sizes[e.kind] / len(families[e.kind.startswith("walk")])) for e in examples]
    together = np.concatenate(shares)
    return together / together.mean()


def table(examples: Sequence[Example]) -> str:
    """Markdown: means by kind of scene, each judged by a gate fitted without the scenes of its family."""
    families = {example.family for example in examples}
    gates = {family: fit([example for example in examples if example.family != family]) for family in families}
    lines = [["scene", "scenes", "precision", "recall", "F1", "sum of probabilities / fruit"]]
    for kind in dict.fromkeys(example.kind for example in examples):
        rows = [judged(example, gates[example.family]) for example in examples if example.kind == kind]
        lines.append([kind, str(len(rows)), *(f"{value:.3f}" for value in np.mean(rows, axis=0))])
    return markdown(lines)


def judged(example: Example, gate: Gate) -> tuple[float, float, float, float]:
    """Precision, recall, F1, and how many fruit the probabilities promise for each one among the candidates."""
    chances = gate.chances({**dict(zip(WEIGHED, example.features.T, strict=True)), "surest": example.surest})
    kept = chances > LIKELY
    right = int((kept & example.fruit).sum())
    precision, recall = right / max(int(kept.sum()), 1), right / example.visible
    return precision, recall, 2.0 * right / (int(kept.sum()) + example.visible), chances.sum() / example.fruit.sum()


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
