"""Compare the CPU rasteriser with its float64 reference and print the largest relative errors.

    python scripts/checks/check_rasterizer.py

Every row is one degree of spherical harmonics, the last (a) drawn antialiased; columns are the rendered values and the
gradient of each parameter.
Exits with 1 when any error exceeds 1e-3.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401

import numpy as np

from fruitlangs.engine.scene.camera import Camera
from fruitlangs.engine.splatting.gaussians import Gaussians
from fruitlangs.engine.splatting.rendering.agreement import compare_with_reference

LIMIT = 1e-3


def make_random_gaussians(n: int, degree: int, seed: int) -> Gaussians:
    """Make Gaussians of many sizes, shapes and opacities around the origin."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=generator),
        log_scales=torch.randn(n, 3, generator=generator) * 0.6 - 2.7,
        quats=torch.randn(n, 4, generator=generator),
        opacity_logits=torch.randn(n, generator=generator) * 2.0,
        sh=torch.randn(n, (degree + 1) ** 2, 3, generator=generator) * 0.3,
    )


def make_camera() -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = [[math.cos(0.3), 0, math.sin(0.3)], [0, 1, 0], [-math.sin(0.3), 0, math.cos(0.3)]]
    pose[:3, 3] = [0.1, -0.2, 4.0]
    return Camera(
        K=np.array([[90.0, 0.0, 49.3], [0.0, 99.0, 36.1], [0.0, 0.0, 1.0]]),
        world_to_camera=pose,
        width=97,
        height=73,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=300, help="Gaussians in the scene (default 300)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the scene (default 0)")
    options = parser.parse_args()
    worst = 0.0
    for degree, antialiased in ((0, False), (1, False), (2, False), (3, False), (3, True)):
        scene = replace(make_random_gaussians(options.gaussians, degree, options.seed), antialiased=antialiased)
        errors = compare_with_reference(scene, make_camera(), seed=options.seed)
        if degree == 0:
            print("SH  " + "".join(f"{name:>18}" for name in errors))
        print(f"{degree:2}{'a ' if antialiased else '  '}" + "".join(f"{error:18.1e}" for error in errors.values()))
        worst = max(worst, *errors.values())
    print(f"largest relative error {worst:.1e}, allowed {LIMIT:.0e}")
    return 0 if worst <= LIMIT else 1


if __name__ == "__main__":
    sys.exit(main())
