"""Count the apples of one tree and read them as NumPy arrays.

python examples/count_tree.py examples/orchard_tree results/example
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import fruitlangs


def main(scene: Path, out: Path) -> None:
    result = fruitlangs.count_scene(scene, ["apple"], out)
    counted = result.fruit_count
    print(f"{counted.count} visible apples, 90 % interval {counted.interval}")

    centers, diameters = counted.centers, counted.diameters  # (F, 3) and (F,), in scene units
    reds = np.array([fruit.color[0] for fruit in counted.fruits])  # (F,) the red of their mean sRGB color
    largest = np.argsort(-diameters)[:5]
    for center, diameter, red in zip(centers[largest], diameters[largest], reds[largest], strict=True):
        print(f"at {np.round(center, 2)}: diameter {diameter:.3f} scene units, red {red} of 255")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
