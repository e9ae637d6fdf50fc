"""Count apples in Gaussians that another program trained on the same photos and cameras.

python examples/count_gaussians.py PHOTOS_WITH_CAMERAS point_cloud.ply results/imported
"""

from __future__ import annotations

import sys
from pathlib import Path

import fruitlangs


def main(scene: Path, gaussians: Path, out: Path) -> None:
    result = fruitlangs.count_scene(scene, ["apple"], out, imported=gaussians)
    for notice in result.notices:
        print(f"note: {notice}")
    again = fruitlangs.open_result(out)  # what was counted, without computing anything
    print(f"{again.fruit_count.count} visible apples in {len(again.gaussians.means)} Gaussians")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
