"""Count many times in one process, and in several processes with one cache of kernels.

    python scripts/checks/soak.py --counts 200 --processes 4 --out results/soak

The sample is trained for a moment on small photos, and then counted again and again, with two prompts in turn: memory
may not grow, and each prompt must give the same fruit each time. Then several processes, whose common cache of kernels
is empty, train and count it at the same time: all must give the same fruit. Exit code 1 if not.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401  puts the checkout on the path

import numpy as np
import psutil

from _terminal import report, run
from fruitlangs.engine.config import Config, SceneConfig, TrainConfig
from fruitlangs.engine.errors import CountingError
from fruitlangs.engine.pipeline import count_scene

SAMPLE = Path(__file__).resolve().parents[2] / "examples" / "orchard_tree"
COUNT_FRUIT = Path(__file__).resolve().parents[1] / "count_fruit.py"
PROMPTS = ("apple", "fruit")
SHORT = Config(scene=SceneConfig(max_side=320), train=TrainConfig(steps=40, max_gaussians=3000))
FLAGS = (
    "--prompt", "apple", "--no-blend", "--scene.max-side", "320",
    "--train.steps", "40", "--train.max-gaussians", "3000",
)  # fmt: skip
WARM = 0.25
"""Share of the counts after which memory may not grow any more."""
GROWTH = 10.0
"""Megabytes by which memory may grow in a hundred counts."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--counts", type=int, default=200)
    parser.add_argument("--processes", type=int, default=4)
    arguments = parser.parse_args()
    growth = soak(arguments.out, arguments.counts)
    print(f"{arguments.counts} counts in one process: memory grew by {growth:.1f} MB per 100 counts")
    if growth > GROWTH:
        raise CountingError(f"Memory grew by {growth:.1f} MB per 100 counts; at most {GROWTH:.0f} MB is allowed")
    fruits = count_together(arguments.out, arguments.processes)
    print(f"{len(fruits)} processes at once with an empty cache: {len(fruits[0])} fruit in each")
    if any(each != fruits[0] for each in fruits):
        raise CountingError(f"Processes at once gave different fruit. See {arguments.out}/at-once-*")


def soak(out: Path, counts: int) -> float:
    """Megabytes by which memory grows in a hundred counts, after the first quarter.

    Raises:
        CountingError: a count differs from an earlier one of the same prompt.
    """
    count_scene(SAMPLE, PROMPTS[:1], out / "first", config=SHORT)
    process, used, first = psutil.Process(), list[float](), dict[str, int]()
    for number in range(counts):
        prompt = PROMPTS[number % len(PROMPTS)]
        found = count_scene(out / "first", [prompt], out / "again").fruit_count
        identity = hash(found.centers.tobytes() + found.diameters.tobytes())
        if first.setdefault(prompt, identity) != identity:
            raise CountingError(f"Count {number} of {prompt} differs from an earlier one")
        used.append(process.memory_info().rss / 2**20)
        if number % 20 == 0:
            report(f"{number + 1} of {counts} counts, {used[-1]:.0f} MB")
    warm = used[int(WARM * counts) :]
    return 100.0 * float(np.polyfit(np.arange(len(warm)), warm, 1)[0])


def count_together(out: Path, processes: int) -> list[Sequence[object]]:
    """Return the fruit that each of several processes counts at the same time."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(out / "kernels")}
    folders = [out / f"at-once-{number}" for number in range(processes)]
    running = [
        subprocess.Popen(
            [sys.executable, str(COUNT_FRUIT), str(SAMPLE), *FLAGS, "--out", str(folder)],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for folder in folders
    ]
    for each in running:
        errors = each.communicate()[1]
        if each.returncode:
            raise CountingError(f"A process ended with {each.returncode}: {errors.strip().splitlines()[-1]}")
    return [json.loads((folder / "fruits.json").read_text(encoding="utf-8"))["fruits"] for folder in folders]


if __name__ == "__main__":
    run(main)
