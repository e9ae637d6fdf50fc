"""Measure the speed of training, stage by stage, beside a rasteriser in plain PyTorch.

    python scripts/benchmark.py --quick
    python scripts/benchmark.py --out results/benchmark --json results/benchmark/stages.json
    python scripts/benchmark.py --out results/benchmark --curve examples/orchard_tree results/orchard2

Prints a table of seconds, and of how many times longer the peer takes in the same run; with --out it also writes
benchmark.md and a plot. `--curve` trains on scenes and plots held-out PSNR over seconds of training. Close other
programs first.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import _checkout  # noqa: F401  puts the checkout on the path

from _terminal import run, terminal_progress
from fruitlangs.benchmarks.curve import Curve, training_curve
from fruitlangs.benchmarks.pages import curve_table, draw_curves, draw_stages, stage_table
from fruitlangs.benchmarks.stages import Setting, measure
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.progress import part

SIZES = ((400, 300), (800, 600), (1500, 1000))
COUNTS = (20_000, 50_000, 200_000, 1_000_000)
QUICK = (
    Setting(20_000, 400, 300, 2),
    Setting(50_000, 400, 300, 2),
    Setting(50_000, 400, 300, 1),
    Setting(200_000, 800, 600, 2),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="four settings in under three minutes")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="threads to measure with (default 1 2)")
    parser.add_argument("--gaussians", type=int, nargs="+", default=list(COUNTS), help="numbers of Gaussians")
    parser.add_argument("--repeats", type=int, default=7, help="runs of each setting, of which the median (default 7)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows there")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write tables and plots there")
    parser.add_argument("--curve", type=Path, nargs="*", default=[], metavar="SCENE", help="scenes to train on")
    parser.add_argument("--only-curve", action="store_true", help="leave the stages out")
    options = parser.parse_args()
    if min([*options.threads, *options.gaussians, options.repeats]) < 1:
        raise ConfigError("--threads, --gaussians and --repeats must be at least 1")
    settings = [
        Setting(n, width, height, threads)
        for n in options.gaussians
        for width, height in SIZES
        for threads in options.threads
    ]
    progress = terminal_progress()
    rows = []
    if not options.only_curve:
        stages_end = 0.5 if options.curve else 1.0
        rows = measure(
            QUICK if options.quick else settings, repeats=options.repeats, progress=part(progress, 0.0, stages_end)
        )
    curves: list[Curve] = []
    for k, scene in enumerate(options.curve):
        begin, end = (0.5 + 0.5 * (k + i) / len(options.curve) for i in range(2))
        curves.append(training_curve(scene, progress=part(progress, begin, end)))
    progress(1.0, "done")
    pages = [page for page in (stage_table(rows) if rows else "", curve_table(curves) if curves else "") if page]
    print("\n\n".join(pages))
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n", encoding="utf-8")
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "benchmark.md").write_text("\n\n".join(pages) + "\n", encoding="utf-8")
        if rows:
            draw_stages(rows, options.out / "stages.png")
        if curves:
            draw_curves(curves, options.out / "curves.png")


if __name__ == "__main__":
    run(main)
