"""Count crowns by several methods, each with the same points and nothing set by hand.

    python scripts/developer/compare_counting.py --seeds 10 --out results/counting
    python scripts/developer/compare_counting.py --along clump --seeds 3 --out results/counting
    python scripts/developer/compare_counting.py --scenes apple-small:101 plum-small:101 --out results/counting

Simulated crowns of six settings (sparse, clumped, mixed sizes, heavy occlusion, half ring, drift between sides), or of
settings that vary one condition: how many fruit touch (clump), how much sizes differ (spread), fruit in
touching pairs (pairs). With --scenes, generated scenes by species, with true masks: true surfaces as seen, then trained
Gaussians. Fruit are matched at half a diameter; those count whose best view shows at least 5 % of them, on scenes those
that are visible in the truth. Prints tables in Markdown and writes them to OUT/counting.md, or clump.md, spread.md,
pairs.md, counting-only.md and true-masks.md; next to each a .csv has every crown and method, and a second run with the
same code continues it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401  puts the checkout on the path

from _terminal import import_tyro, report, run, terminal_progress
from fruitlangs.benchmarks.counting.baselines import METHODS
from fruitlangs.benchmarks.counting.crowns import Crown, Methods, make_scene_crown, simulate_crowns
from fruitlangs.benchmarks.counting.pages import counting_page
from fruitlangs.benchmarks.counting.simulated import AXES, SETTINGS
from fruitlangs.benchmarks.counting.trials import Trial, read_trials, trials_csv
from fruitlangs.benchmarks.ladder.stages import COUNTING_ONLY, TRUE_MASKS
from fruitlangs.benchmarks.orchards import scene_folder
from fruitlangs.engine.config import Config
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.storage.files import require_writable, write_text

tyro = import_tyro()


@dataclass(frozen=True, kw_only=True)
class Options:
    """Which crowns to count."""

    seeds: int = 10
    """Crowns of each setting."""
    first: int = 0
    """Seed of the first one; constants of the product were tuned on seeds from 1000 on."""
    along: Literal["clump", "spread", "pairs"] | None = None
    """The condition to vary; without it, the six settings."""
    settings: tuple[str, ...] = ()
    """Names of settings; without any, all."""
    methods: tuple[str, ...] = ()
    """Names of methods; without any, all."""
    scenes: tuple[str, ...] = ()
    """Instead of simulated crowns: folders of generated scenes, or presets with seeds such as apple-small:101."""
    out: Path | None = None
    """Folder of the tables and of trained scenes; that of evaluate.py reuses its training."""


def main(options: Options) -> None:
    if options.seeds < 1:
        raise ConfigError("--seeds must be at least 1")
    if options.scenes and (options.out is None or options.along or options.settings):
        raise ConfigError("--scenes needs --out, and goes without --along and --settings")
    all_settings = AXES[options.along] if options.along else SETTINGS
    if unknown := [name for name in options.settings if name not in all_settings]:
        raise ConfigError(f"Unknown setting '{unknown[0]}'. Use one of {', '.join(all_settings)}")
    if unknown := [name for name in options.methods if name not in METHODS]:
        raise ConfigError(f"Unknown method '{unknown[0]}'. Use one of {', '.join(METHODS)}")
    if options.out is not None:
        require_writable(options.out)
    if options.scenes:
        compare_on_scenes(options)
        return
    chosen = {name: all_settings[name] for name in options.settings or all_settings}
    crowns = list(simulate_crowns(chosen, range(options.first, options.first + options.seeds)))
    print(compare(crowns, choose_methods(options), options.out, options.along or "counting"))


def compare_on_scenes(options: Options) -> None:
    """Both ablation stages with true masks, one after the other."""
    assert options.out is not None
    folders = [scene_folder(name, options.out / "scenes", report=report).resolve() for name in options.scenes]
    for stage in (COUNTING_ONLY, TRUE_MASKS):
        crowns = [make_scene_crown(folder, options.out / folder.name, stage, Config()) for folder in folders]
        print(f"{stage}\n\n{compare(crowns, choose_methods(options), options.out, stage)}\n")


def choose_methods(options: Options) -> Methods:
    """Choose the named ones, in the order of all."""
    return {name: count for name, count in METHODS.items() if name in options.methods or not options.methods}


def compare(crowns: Sequence[Crown], methods: Methods, out: Path | None, name: str) -> str:
    """Return the page of the methods on the crowns; OUT/NAME.csv and OUT/NAME.md are written after each."""
    kept = {_key(trial): trial for trial in (read_trials(out / f"{name}.csv") if out else ())}
    progress, trials = terminal_progress(), list[Trial]()
    for number, crown in enumerate(crowns):
        own = [kept.get((crown.setting, crown.seed, method)) for method in methods]
        known = [trial for trial in own if trial is not None and trial.key == crown.key]
        if len(known) < len(methods):
            progress(number / len(crowns), f"{crown.setting}, seed {crown.seed}")
            known = crown.count(methods)
            kept |= {_key(trial): trial for trial in known}
        trials += known
        if out is not None:
            write_text(out / f"{name}.csv", trials_csv(list(kept.values())))
            write_text(out / f"{name}.md", counting_page(trials) + "\n")
    progress(1.0, "Done")
    return counting_page(trials)


def _key(trial: Trial) -> tuple[str, int, str]:
    return trial.setting, trial.seed, trial.method


if __name__ == "__main__":
    run(lambda: main(tyro.cli(Options, description=__doc__)))
