"""Measure the trainer, the language and the counting: seconds by stage, memory, curves, what each part gains.

    python scripts/benchmark.py --quick
    python scripts/benchmark.py --out results/benchmark --json results/benchmark/stages.json
    python scripts/benchmark.py --out results/benchmark --curve examples/orchard_tree results/orchard2
    python scripts/benchmark.py --ablation examples/orchard_tree --steps 750
    python scripts/benchmark.py --memory 200000 100 800 600
    python scripts/benchmark.py --published examples/orchard_tree
    python scripts/benchmark.py --counting 1000000 10000000
    python scripts/benchmark.py --cameras PHOTOS 40 80 160
    python scripts/benchmark.py --language examples/orchard_tree results/tree/gaussians.ply --clip CHECKPOINT
    python scripts/benchmark.py --widths results/apple-whole-402 results/apple/gaussians.ply

--widths counts a rendered tree in its photos read smaller and smaller, and keeps the rows in benchmarks/widths.json.

Prints tables in Markdown; with --out it also writes them to benchmark.md, and plots. Close other programs first: times
vary between runs, so compare within one.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import _checkout  # noqa: F401  puts the checkout on the path

from _terminal import run, terminal_progress
from fruitlangs.benchmarks.cameras import camera_table, measure_cameras
from fruitlangs.benchmarks.counting.speed import measure_counting
from fruitlangs.benchmarks.language import measure_language
from fruitlangs.benchmarks.training.ablation import ablate
from fruitlangs.benchmarks.training.curve import training_curve
from fruitlangs.benchmarks.training.memory import training_peak
from fruitlangs.benchmarks.training.pages import (
    ablation_table,
    curve_table,
    draw_curves,
    draw_stages,
    published_table,
    stage_table,
    watched_table,
)
from fruitlangs.benchmarks.training.published_3dgs import compare_with_published
from fruitlangs.benchmarks.training.step_times import MOST_THREADS, Setting, measure
from fruitlangs.benchmarks.widths import draw_widths, measure_widths, read_widths, width_table, write_widths
from fruitlangs.engine.config import EmbedConfig, TrainConfig
from fruitlangs.engine.errors import ConfigError

WIDTHS_PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "widths.png"
SIZES = ((400, 300), (800, 600), (1500, 1000))
COUNTS = (20_000, 50_000, 200_000, 1_000_000)
TWO = min(2, MOST_THREADS)
QUICK = (
    Setting(20_000, 400, 300, TWO),
    Setting(50_000, 400, 300, TWO),
    Setting(50_000, 400, 300, 1),
    Setting(200_000, 800, 600, TWO),
)


def main() -> None:
    options = parse()
    progress = terminal_progress()
    config = TrainConfig() if options.steps is None else TrainConfig(steps=options.steps)
    pages = []
    if options.memory is not None:  # first: the peak is that of the process
        peak, estimate = training_peak(*options.memory)
        pages.append(f"Peak memory {peak / 2**20:.0f} MB, estimated {estimate / 2**20:.0f} MB.")
    others = (
        options.curve,
        options.ablation,
        options.memory,
        options.published,
        options.language,
        options.counting,
        options.cameras,
        options.widths,
    )
    rows = []
    if options.quick or not any(others):
        rows = measure(QUICK if options.quick else grid(options), repeats=options.repeats, progress=progress)
        pages.append(stage_table(rows))
    curves = [training_curve(scene, config, progress=progress) for scene in options.curve]
    if curves:
        pages.append(curve_table(curves))
    if options.ablation is not None:
        pages.append(ablation_table(ablate(options.ablation, config, progress=progress)))
    if options.published is not None:
        pages.append(published_table(compare_with_published(options.published, steps=options.steps, progress=progress)))
    if options.language is not None:
        scene, ply = options.language
        language = measure_language(scene, ply, pipelines(options), views=options.views, progress=progress)
        pages.append(watched_table("From photos to probabilities.", language))
    if options.counting:
        counting = measure_counting(options.counting, progress=progress)
        pages.append(watched_table("Counting, views drawn already.", counting))
    if options.cameras:
        folder, *numbers = options.cameras
        if not numbers or not all(number.isdecimal() for number in numbers):
            raise ConfigError("--cameras needs a folder and numbers of photos, for example --cameras PHOTOS 40 80")
        searches = measure_cameras(Path(folder), [int(number) for number in numbers], progress=progress)
        pages.append("Finding cameras.\n\n" + camera_table(searches))
    if options.widths is not None:
        tree, ply = options.widths
        write_widths(measure_widths(tree, ply, progress))
        draw_widths(read_widths(), WIDTHS_PICTURE)
        pages.append(width_table(read_widths()))
    progress(1.0, "Done")
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


def pipelines(options: argparse.Namespace) -> list[EmbedConfig]:
    """The embedded encoder; with --clip also its checkpoint on classical masks, and on those of --sam."""
    if options.sam and not options.clip:
        raise ConfigError("--sam finds masks for --clip. Name a CLIP checkpoint too")
    configs = [EmbedConfig()]
    if options.clip:
        configs.append(EmbedConfig(encoder="clip", clip=options.clip))
    if options.sam:
        configs.append(EmbedConfig(encoder="clip", clip=options.clip, masks="sam", sam=options.sam))
    return configs


def grid(options: argparse.Namespace) -> list[Setting]:
    """Every number of Gaussians at every size with every number of threads."""
    return [
        Setting(n, width, height, threads)
        for n in options.gaussians
        for width, height in SIZES
        for threads in options.threads
    ]


def parse() -> argparse.Namespace:
    """The arguments, or exit 2 with a usage message.

    Raises:
        ConfigError: a number is below 1.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="four settings in under three minutes")
    parser.add_argument("--threads", type=int, nargs="+", default=sorted({1, TWO}), help="threads (default 1 2)")
    parser.add_argument("--gaussians", type=int, nargs="+", default=list(COUNTS), help="numbers of Gaussians")
    parser.add_argument("--repeats", type=int, default=7, help="runs of each setting, of which the median (default 7)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows of the stages there")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write tables and plots there")
    parser.add_argument(
        "--curve", type=Path, nargs="+", default=[], metavar="SCENE", help="train, and measure during training"
    )
    parser.add_argument("--ablation", type=Path, metavar="SCENE", help="train with one part changed at a time")
    parser.add_argument("--steps", type=int, help="steps of each training (default: the standard's)")
    parser.add_argument(
        "--memory", type=int, nargs=4, metavar=("N", "VIEWS", "W", "H"), help="peak memory of training N Gaussians"
    )
    parser.add_argument(
        "--published",
        type=Path,
        metavar="SCENE",
        help="train a small copy as 3DGS was published, and with ours",
    )
    parser.add_argument(
        "--language", type=Path, nargs=2, metavar=("SCENE", "PLY"), help="features for its Gaussians, and prompts"
    )
    parser.add_argument(
        "--counting",
        type=int,
        nargs="+",
        default=[],
        metavar="POINTS",
        help="count simulated crowns of this many points",
    )
    parser.add_argument(
        "--cameras", nargs="+", default=[], metavar="", help="PHOTOS N…: find cameras for its first N photos"
    )
    parser.add_argument(
        "--widths",
        type=Path,
        nargs=2,
        metavar=("TREE", "PLY"),
        help="count a tree in photos of smaller and smaller fruit",
    )
    parser.add_argument("--clip", metavar="CHECKPOINT", help="also by masks and this CLIP or SigLIP checkpoint")
    parser.add_argument("--sam", metavar="CHECKPOINT", help="with --clip: also by the masks of this SAM checkpoint")
    parser.add_argument("--views", type=int, default=0, help="photos that --language uses (default: all)")
    options = parser.parse_args()
    if min([*options.threads, *options.gaussians, options.repeats, *(options.memory or [])]) < 1:
        raise ConfigError("--threads, --gaussians, --repeats and --memory must be at least 1")
    return options


if __name__ == "__main__":
    run(main)
