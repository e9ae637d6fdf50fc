"""Whether a count of 0 is an answer: with Gaussians that match the prompt, or in a poor reconstruction, it may not be.

A known cause of the 0 is an error. Otherwise the 0 is an answer, and its interval admits what may be there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...errors import CountingError
from ..evidence.cluster import LINKS
from ..fruit import FruitCount
from ..geometry.cells import Cells, linked

FloatArray = NDArray[np.float64]

POOR = 0.4
"""Held-out SSIM below which Gaussians show little more than a blur; the paper's worst scan has .527."""
BLURRED_SSIM, BLURRED_PSNR = 0.5, 18.0
"""Held-out SSIM and PSNR (dB) below which fruit may be too blurred to have a shape. The ladder's scenes below either
lost a third of their fruit."""
LEAST_PIXELS = 8.0
"""Width in pixels below which fruit are too small to have a shape in Gaussians."""


@dataclass(frozen=True)
class Quality:
    """How well the Gaussians reproduce held-out photos; None if that is not measured. psnr: dB."""

    psnr: float | None = None
    ssim: float | None = None

    @staticmethod
    def of(training: Mapping[str, Any]) -> Quality:
        """The quality in the results of a training, as in the provenance."""
        return Quality(training.get("psnr"), training.get("ssim"))

    @property
    def poor(self) -> bool:
        """Whether nothing that is counted in these Gaussians can be trusted."""
        return self.ssim is not None and self.ssim < POOR

    @property
    def blurred(self) -> bool:
        """Whether fruit may have lost their shape."""
        return self.poor or (
            (self.ssim is not None and self.ssim < BLURRED_SSIM) or (self.psnr is not None and self.psnr < BLURRED_PSNR)
        )

    def __str__(self) -> str:
        parts = [
            "" if self.psnr is None else f"PSNR {self.psnr:.1f} dB",
            "" if self.ssim is None else f"SSIM {self.ssim:.2f}",
        ]
        return ", ".join(filter(None, parts))


UNKNOWN = Quality()


def require_answer(
    label: str, reason: str, quality: Quality, *, matching: int = 0, pixels: float | None = None
) -> None:
    """Refuse a 0 whose cause is the reconstruction.

    label: of the fruit; reason: of the 0; matching: number of Gaussians that match the prompt; pixels: width of a
    fruit in the photos, if known.

    Raises:
        CountingError: names the cause and what to do.
    """
    if quality.poor or (matching and quality.blurred):
        raise CountingError(
            f"The 0 for {label} is not a count: held-out photos are reproduced poorly ({quality}), and {reason}. Check "
            "the cameras, take sharper photos in smaller steps, or train for more steps"
        )
    if matching and pixels is not None and pixels < LEAST_PIXELS:
        raise CountingError(
            f"The 0 for {label} is not a count: a fruit is only about {pixels:.0f} pixels wide, and {reason}. Read the "
            "photos larger (--scene.max-side, --scene.downscale), or take them closer to the tree"
        )


def with_bounds(counted: FruitCount, most: int, matching: int, label: str, *, visible: bool = True) -> FruitCount:
    """A count of 0 with intervals up to `most` fruit, and a notice that gives the reason.

    matching: number of Gaussians that match the prompt; visible: whether the fruit that may be there would be visible.
    """
    if counted.interval is not None and counted.total_interval is not None:
        most = max(most, counted.interval[1])
    may = f"up to {most} {'' if visible else 'hidden '}fruit may be there. The audit has the reason"
    notice = f"no fruit was counted, but {matching} Gaussians match {label}: {may}"
    return replace(
        counted,
        interval=(0, most if visible else 0),
        total=counted.total or 0.0,
        total_interval=(0, max(most, counted.total_interval[1] if counted.total_interval else 0)),
        notices=[*counted.notices, notice],
    )


def most_fruit(positions: FloatArray, diameter: float) -> int:
    """The number of positions (M, 3), taken in their order, that are at least a diameter from those taken before: about
    one for each fruit of that size."""
    tree, free, number = cKDTree(positions), np.ones(len(positions), bool), 0
    for index in range(len(positions)):
        if free[index]:
            free[tree.query_ball_point(positions[index], diameter)] = False
            number += 1
    return number


def separate_groups(positions: FloatArray, link: float) -> int:
    """Number of groups of positions (M, 3) that are linked by distances below `link`, scene units."""
    if link <= 0.0 or len(positions) == 0:
        return len(positions)
    return len(np.unique(linked(Cells.of(positions, link).table, link, link / LINKS)))
