"""Count simulated crowns by several methods, each with the same points and nothing set by hand.

    python scripts/compare_counting.py --seeds 10 --out results/counting

Six settings (sparse, clumped, mixed sizes, heavy occlusion, half ring, drift between sides), F1 at half a diameter
against fruit whose best view shows at least 5 % of them. Prints a table in Markdown and writes it to OUT/counting.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import _checkout  # noqa: F401  puts the checkout on the path

from _terminal import import_tyro, run, terminal_progress
from fruitlangs.benchmarks.rivals import METHODS, surface_of
from fruitlangs.benchmarks.simulated import SETTINGS, simulate
from fruitlangs.benchmarks.simulated_page import Trial, counting_table
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.evaluation.metrics import count_metrics
from fruitlangs.engine.files import write_text

tyro = import_tyro()


@dataclass(frozen=True, kw_only=True)
class Options:
    """Which crowns to count."""

    seeds: int = 10
    """Crowns of each setting."""
    first: int = 0
    """Seed of the first one; the product's constants were looked at on seeds from 1000 on."""
    settings: tuple[str, ...] = ()
    """Names of settings; without any, all six."""
    out: Path | None = None
    """Folder for the table."""


def main(options: Options) -> None:
    if options.seeds < 1:
        raise ConfigError("--seeds must be at least 1")
    chosen = options.settings or tuple(SETTINGS)
    if unknown := [name for name in chosen if name not in SETTINGS]:
        raise ConfigError(f"there is no setting '{unknown[0]}'; there are {', '.join(SETTINGS)}")
    progress, trials = terminal_progress(), list[Trial]()
    for place, (name, seed) in enumerate((n, options.first + s) for n in chosen for s in range(options.seeds)):
        progress(place / (len(chosen) * options.seeds), f"{name}, seed {seed}")
        simulation = simulate(SETTINGS[name], seed)
        surface = surface_of(simulation.gaussians, simulation.probability, simulation.cameras)
        for method, count in METHODS.items():
            trials.append(Trial(name, seed, method, count_metrics(*count(simulation, surface), simulation.truth).f1))
    progress(1.0, "done")
    page = counting_table(trials)
    print(page)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        write_text(options.out / "counting.md", page + "\n")


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
