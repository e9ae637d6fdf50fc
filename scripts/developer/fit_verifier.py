"""Train the network that verifies fruit in photos, and write engine/counting/photos/verifier.safetensors.

    python scripts/developer/fit_verifier.py --renders RENDERS

Learns from places in rendered trees, with Gaussians that are trained on each once and kept in its folder, and with the
package's encoder. After a first training the network searches every tree itself, and what it found, right or wrong, is
learnt too. With --add, the networks of a file stay, and the new one is added: their answers are averaged, because each
errs in other places. Trees that --check names are left out: the log odds and the errors of radii are calibrated on
them, and they are measured: F1 of surfaces alone, and of the photos at several log odds, and how far radii are off.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401  puts the checkout on the path

import numpy as np

from _terminal import import_tyro, run, say
from fruitlangs.benchmarks.markdown import markdown
from fruitlangs.engine.counting.photos.places import Places
from fruitlangs.engine.counting.photos.search import search_photos
from fruitlangs.engine.counting.photos.verifier import (
    STORED,
    Network,
    Networks,
    StoredNetworks,
    read_networks,
    require_trained_for,
    write_networks,
)
from fruitlangs.engine.evaluation.judgement import judge
from fruitlangs.engine.evaluation.metrics import count_metrics
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.fitting.counting.verifying import (
    Samples,
    Tree,
    calibrate,
    fit,
    measure_radius_errors,
    mine_samples,
    prepare_trees,
    sample_around_truth,
)

tyro = import_tyro()

ODDS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Log odds from which a place is measured as a fruit."""
COPIES = 2
"""Times that places around the true fruit of a tree are drawn."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to learn from, and how long."""

    renders: Path
    """Folder of rendered trees, written by `make_orchard.py`."""
    out: Path = STORED
    """File to write."""
    add: Path | None = None
    """A file of networks to which the new one is added."""
    check: tuple[str, ...] = ()
    """Folders of trees that are calibrated on and measured, and not learnt from, such as plum-3003."""
    rounds: int = 2
    """Times that mistakes are added and the network is trained again."""
    epochs: int = 6
    """Passes over all places in each training; the last one takes twice as many."""
    seed: int = 0
    """Seed of all random numbers."""


def main(options: Options) -> None:
    rng, trees = np.random.default_rng(options.seed), list(prepare_trees(options.renders))
    checked = [tree for tree in trees if tree.name in options.check]
    learnt = [tree for tree in trees if tree not in checked]
    encoder_id = EmbeddedEncoder.open().fruit_identity
    earlier = StoredNetworks(Networks([]), (), encoder_id)
    if options.add is not None:
        require_trained_for(encoder_id, options.add)
        earlier = read_networks(options.add)
    samples = [sample_around_truth(tree, rng) for tree in learnt for _ in range(COPIES)]
    network: Network | Networks = earlier.networks
    for number in range(options.rounds + 1):
        if number or earlier.notes:
            samples += [mine_samples(tree, network, rng) for tree in learnt]
        together = Samples.join(samples)
        say(f"training {number + 1} of {options.rounds + 1}: {len(together)} places of {len(learnt)} trees")
        epochs = options.epochs * (2 if number == options.rounds else 1)
        network = fit(together, epochs=epochs, seed=options.seed, report=say)
        if checked:
            calibrate(network, checked)
            say(table(checked, network))
        used = {"trees": [tree.name for tree in learnt], "calibrated on": [tree.name for tree in checked]}
        networks = Networks([*earlier.networks.networks, network])
        write_networks(options.out, networks, [*earlier.notes, used], encoder_id)
    if earlier.notes and checked:
        say(f"all {len(networks.networks)} networks together:\n{table(checked, networks)}")


def table(trees: list[Tree], network: Network | Networks) -> str:
    """Markdown: F1 of each tree, of the fruit on surfaces and of the places in photos."""
    lines = [["tree", "surfaces", *(f"log odds > {odds:g}" for odds in ODDS), "bias of radii", "their deviation"]]
    rows = []
    for tree in trees:
        found = search_photos(tree.verifier(network), tree.diameter, tree.frame)
        on_surfaces = Places.alike(tree.surroundings.fruit, tree.diameter)
        chosen = [on_surfaces, *(found.places.select(found.log_odds > odds) for odds in ODDS)]
        likely = found.places.select(found.log_odds > 0.0)
        errors = measure_radius_errors(tree, likely, judge(likely.centers, 2.0 * likely.radii, tree.truth))
        rows.append([*(f1(tree, places) for places in chosen), errors.mean(), errors.std()])
        lines.append([tree.name, *(f"{value:.3f}" for value in rows[-1])])
    return markdown([*lines, ["mean", *(f"{value:.3f}" for value in np.mean(rows, axis=0))]])


def f1(tree: Tree, places: Places) -> float:
    """F1 at half a diameter of fruit at these places."""
    return count_metrics(places.centers, 2.0 * places.radii, tree.truth).f1


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
