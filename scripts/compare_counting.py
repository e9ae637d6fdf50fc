"""Count simulated crowns by several methods, each with the same points and nothing set by hand.

    python scripts/compare_counting.py --seeds 10 --out results/counting
    python scripts/compare_counting.py --along clump --seeds 3 --out results/counting

Six settings (sparse, clumped, mixed sizes, heavy occlusion, half ring, drift between sides), or settings along which
one thing alone changes: how many fruit touch (clump), how much sizes differ (spread), fruit in touching pairs (pairs).
Fruit are matched at half a diameter, those whose best view shows at least 5 % of them. Prints tables in Markdown and
writes them to OUT/counting.md (or clump.md …); OUT/trials.csv holds every crown and method, and a second run with the
same code goes on with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import _checkout  # noqa: F401  puts the checkout on the path

from _terminal import import_tyro, run, terminal_progress
from fruitlangs.benchmarks.rivals import METHODS, surface_of
from fruitlangs.benchmarks.simulated import AXES, SETTINGS, simulate
from fruitlangs.benchmarks.simulated_page import counting_page
from fruitlangs.benchmarks.trials import Trial, code_key, read_trials, trials_csv, tried
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.files import require_writable, write_text

tyro = import_tyro()
TRIALS = "trials.csv"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Which crowns to count."""

    seeds: int = 10
    """Crowns of each setting."""
    first: int = 0
    """Seed of the first one; the product's constants were looked at on seeds from 1000 on."""
    along: Literal["clump", "spread", "pairs"] | None = None
    """What alone changes; without it, the six settings."""
    settings: tuple[str, ...] = ()
    """Names of settings; without any, all."""
    out: Path | None = None
    """Folder for the tables."""


def main(options: Options) -> None:
    if options.seeds < 1:
        raise ConfigError("--seeds must be at least 1")
    all_settings = AXES[options.along] if options.along else SETTINGS
    chosen = options.settings or tuple(all_settings)
    if unknown := [name for name in chosen if name not in all_settings]:
        raise ConfigError(f"there is no setting '{unknown[0]}'; there are {', '.join(all_settings)}")
    if options.out is not None:
        require_writable(options.out)
    kept = {_place(trial): trial for trial in (read_trials(options.out / TRIALS) if options.out else ())}
    progress, trials = terminal_progress(), list[Trial]()
    crowns = [(name, options.first + number) for number in range(options.seeds) for name in chosen]
    keys = {
        name: code_key(all_settings[name]) for name in chosen
    }  # of the code as it is now, not as it is edited later
    for place, (name, seed) in enumerate(crowns):
        own = [kept.get((name, seed, method)) for method in METHODS]
        known = [trial for trial in own if trial is not None and trial.key == keys[name]]
        if len(known) < len(METHODS):
            progress(place / len(crowns), f"{name}, seed {seed}")
            simulation = simulate(all_settings[name], seed)
            surface = surface_of(simulation.gaussians, simulation.probability, simulation.cameras)
            known = [
                tried(name, seed, method, keys[name], count(surface), simulation.truth)
                for method, count in METHODS.items()
            ]
            kept |= {_place(trial): trial for trial in known}
        trials += known
        if options.out is not None:
            write_text(options.out / TRIALS, trials_csv(list(kept.values())))
            write_text(options.out / f"{options.along or 'counting'}.md", counting_page(trials) + "\n")
    progress(1.0, "done")
    print(counting_page(trials))


def _place(trial: Trial) -> tuple[str, int, str]:
    return trial.setting, trial.seed, trial.method


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
