"""Count five prompts in one reconstruction, which is trained once, and plot the counts with their intervals.

python examples/query_prompts.py examples/orchard_tree results/prompts
"""

from __future__ import annotations

import sys
from pathlib import Path

from matplotlib.figure import Figure

import fruitlangs

PROMPTS = ("apple", "red apple", "green apple", "orange", "fruit")


def main(scene: Path, out: Path) -> None:
    figure = Figure(layout="constrained")
    axes = figure.add_subplot(ylabel="visible fruit")
    for prompt in PROMPTS:
        try:
            result = fruitlangs.count_scene(scene, [prompt], out / prompt.replace(" ", "-"))
        except fruitlangs.FruitLangsError as error:  # such as a 0 that the quality of the photos does not support
            print(f"{prompt}: {error}")
            continue
        scene = result.out  # the next prompt reuses its Gaussians and features
        count = result.fruit_count.count
        low, high = result.fruit_count.interval or (count, count)
        axes.bar(prompt, count, color="tab:red")
        axes.vlines(prompt, low, high, color="black")
        print(f"{prompt}: {count} ({low}–{high})")
    figure.savefig(out / "prompts.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
