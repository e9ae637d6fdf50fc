"""Whether a count of 0 is an answer: with Gaussians that match the prompt, or in a poor reconstruction, it may not be.
Other counts in a poor reconstruction have a notice.

A known cause of the 0 is an error. Otherwise the 0 is an answer, and its interval admits what may be there: what the
photos show, or without them what Gaussians match.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import CountingError
from ...language.prompts.photo_probability import PhotoMap
from ...scene.camera import Camera
from ...splatting.gaussians import Gaussians
from ..evidence.cluster import LINKS
from ..evidence.pixel_width import focal_length
from ..evidence.surface_points import SURFACE
from ..fruit import FruitCount
from ..geometry.cells import Cells, keep_apart, link_points
from .photo_regions import PhotoRegions

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

POOR = 0.4
"""Held-out SSIM below which Gaussians show little more than a blur; the paper's worst scan has .527."""
BLURRED_SSIM, BLURRED_PSNR = 0.5, 18.0
"""Held-out SSIM and PSNR (dB) below which fruit may be too blurred to have a shape. The ladder's scenes below either
lost a third of their fruit."""
LEAST_PIXELS, ENOUGH_PIXELS = 8.0, 14.0
"""Width in pixels below which fruit are too small to have a shape in Gaussians, and from which sharp ones have one: on
all 16 scenes of the ladder with fruit of 12 to 17 pixels, their surfaces gave the size."""

WEAK = 0.1
"""Probability from which a Gaussian may be on a surface that photos show as fruit: the mean over all views is lower
where some views show leaves."""


@dataclass(frozen=True)
class Quality:
    """How well the Gaussians reproduce held-out photos; None if that is not measured. psnr: dB.

    Both are measured on photos reduced to one size (`training.scores`), for which the limits hold.
    """

    psnr: float | None = None
    ssim: float | None = None

    @staticmethod
    def of(training: Mapping[str, Any]) -> Quality:
        """The quality in the results of a training, as in the provenance.

        Earlier versions measured in photos of full size only, which gives lower numbers: too careful, never too bold.
        """
        psnr, ssim = (training.get(f"reduced_{name}", training.get(name)) for name in ("psnr", "ssim"))
        return Quality(psnr, ssim)

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

    @property
    def notices(self) -> list[str]:
        """What the user should know about any count in these Gaussians."""
        if not self.blurred:
            return []
        return [
            f"held-out photos are reproduced poorly ({self}), so fruit may be missing or in wrong places. Check the "
            "cameras and the photos"
        ]

    def __str__(self) -> str:
        parts = [
            "" if self.psnr is None else f"PSNR {self.psnr:.1f} dB",
            "" if self.ssim is None else f"SSIM {self.ssim:.2f}",
        ]
        return ", ".join(filter(None, parts))


UNKNOWN = Quality()


@dataclass(frozen=True, eq=False)
class Matching:
    """The M Gaussians in the counted part of the scene that match the prompt, and what may be the cause of a 0.

    label: of the fruit; positions: (M, 3) scene units, by descending probability; weak_positions: (W, 3) of Gaussians
    that match at least weakly, likewise; outline: typical width of a Gaussian, scene units; cameras, quality: of the
    reconstruction; maps: what each camera's photo shows of the prompt, None without photos; threshold: of the
    probability; whole: whether all of the scene is counted.
    """

    label: str
    positions: FloatArray
    weak_positions: FloatArray
    outline: float
    cameras: Sequence[Camera]
    quality: Quality
    maps: Sequence[PhotoMap] | None
    threshold: float
    whole: bool

    @classmethod
    def of(
        cls, gaussians: Gaussians, probabilities: FloatArray, inside: NDArray[np.bool_], cameras: Sequence[Camera],
        label: str, quality: Quality, maps: Sequence[PhotoMap] | None, threshold: float,
    ) -> Matching:  # fmt: skip
        """The Gaussians that are inside (N,) the counted part, of all with probabilities (N,)."""
        weak = np.flatnonzero(inside & (probabilities >= min(WEAK, threshold)))
        weak = weak[np.argsort(-probabilities[weak], kind="stable")]
        positions = gaussians.means.detach().double().cpu().numpy()[weak]
        count = int((probabilities[weak] >= threshold).sum())
        widths = gaussians.scales.detach().double().cpu().numpy()[weak[:count]].max(axis=1)
        outline = 2.0 * SURFACE * float(np.median(widths)) if count else 0.0
        whole = bool(inside.all())
        return cls(label, positions[:count], positions, outline, cameras, quality, maps, threshold, whole)

    def __len__(self) -> int:
        return len(self.positions)

    def require_answer(self, reason: str, diameter: float | None = None) -> None:
        """Refuse a 0 whose cause is the reconstruction. reason: of the 0; diameter: of the fruit that was searched for.

        Raises:
            CountingError: names the cause and what to do.
        """
        if self.quality.poor or (len(self) and self.quality.blurred):
            raise CountingError(
                f"The 0 for {self.label} is not a count: held-out photos are reproduced poorly ({self.quality}), and "
                f"{reason}. Check the cameras, take sharper photos in smaller steps, or train for more steps"
            )
        pixels = None if diameter is None else self.pixels(diameter)
        if pixels is not None and pixels < LEAST_PIXELS:
            raise CountingError(
                f"The 0 for {self.label} is not a count: a fruit is only about {pixels:.0f} pixels wide, and {reason}. "
                "Read the photos larger (--scene.max-side, --scene.downscale), or take them closer to the tree"
            )

    def is_sharp(self, diameter: float) -> bool:
        """Whether fruit of this diameter would have a shape: Gaussians that have none are then not fruit."""
        known = self.quality.ssim is not None and not self.quality.blurred
        return known and (self.pixels(diameter) or 0.0) >= ENOUGH_PIXELS

    def add_bounds(
        self,
        counted: FruitCount,
        diameter: float | None = None,
        *,
        visible: bool = True,
        searched: bool = False,
        refused: int = 0,
    ) -> FruitCount:
        """Give a count of 0 intervals up to the fruit that may be there, and a notice that says so.

        visible: whether these fruit would be visible; searched: the count has intervals from candidates in the photos,
        which the photos can only narrow; refused: number of fruit on surfaces of the Gaussians that no photo shows.
        Without photos, an unchanged count if no Gaussian matches.
        """
        if self.maps is not None and visible:
            return self._add_photo_bounds(counted, diameter, searched=searched, refused=refused)
        if len(self) == 0:
            return counted
        most = max(self.count_possible(diameter), counted.interval[1] if counted.interval else 0)
        may = f"up to {most} {'' if visible else 'hidden '}fruit may be there. The audit has the reason"
        total = max(most, counted.total_interval[1] if counted.total_interval else 0)
        bounded = _bound_intervals(counted, most if visible else 0, total)
        return _add_notice(bounded, f"no fruit was counted, but {len(self)} Gaussians match {self.label}: {may}")

    def _add_photo_bounds(
        self, counted: FruitCount, diameter: float | None, *, searched: bool, refused: int
    ) -> FruitCount:
        """Give a count of 0 intervals up to what the photos show, or up to what they refuse if that is more, and a
        notice if that is anything."""
        shown = self.count_shown(diameter)
        high, highest = shown, shown
        if searched and counted.interval and counted.total_interval:
            high, highest = min(shown, counted.interval[1]), min(shown, counted.total_interval[1])
        bounded = _bound_intervals(counted, max(high, refused), max(highest, refused))
        if refused > shown:
            return _add_notice(
                bounded,
                f"no fruit was counted: surfaces of the Gaussians look like {self.label} in {refused} places, but "
                f"photos show {shown or 'none'}. Check that photos, masks and cameras belong together",
            )
        if shown == 0:
            return bounded
        places = "1 place that matches" if shown == 1 else f"{shown} places that match"
        return _add_notice(
            bounded,
            f"no fruit was counted, but photos show {places} {self.label} (probability about "
            f"{self._regions.probability:.2f}, about {self._regions.width:.0f} pixels wide). The audit has the reason",
        )

    def count_shown(self, diameter: float | None) -> int:
        """Count how many fruit the photos may show: places that several of them show, or regions that one shows at
        once."""
        places = self._regions.count_places(self.weak_positions, diameter)
        return max(places, self._regions.at_once) if self.whole else places

    @cached_property
    def _regions(self) -> PhotoRegions:
        assert self.maps is not None
        return PhotoRegions.of(self.maps, self.cameras, self.threshold)

    def count_possible(self, diameter: float | None) -> int:
        """Count how many fruit these Gaussians may be: the number of places a diameter apart; without a diameter, the
        number of their groups that do not touch."""
        if diameter is None:
            return count_groups(self.positions, self.outline)
        return count_apart(self.positions, diameter)

    def pixels(self, diameter: float) -> float | None:
        """The width in pixels of a fruit in the middle of these Gaussians, the median over the cameras; None without
        Gaussians in front of a camera."""
        if len(self) == 0:
            return None
        middle = np.median(self.positions, axis=0)
        depths = np.array([camera.project(middle)[1] for camera in self.cameras])
        focal = np.array([focal_length(camera) for camera in self.cameras])
        front = depths > 0.0
        return float(np.median(diameter * focal[front] / depths[front])) if front.any() else None


def _bound_intervals(counted: FruitCount, high: int, highest: int) -> FruitCount:
    """Give a count of 0 intervals from 0 up to the number of visible fruit and of all fruit."""
    likely = None if counted.likely is None else min(counted.likely, float(high))
    total = min(counted.total or 0.0, float(highest))
    return replace(counted, likely=likely, interval=(0, high), total=total, total_interval=(0, highest))


def _add_notice(counted: FruitCount, notice: str) -> FruitCount:
    return replace(counted, notices=[*counted.notices, notice])


def count_apart(positions: FloatArray, diameter: float) -> int:
    """Count the positions (M, 3), taken in their order, that are at least a diameter from those taken before: about one
    for each fruit of that size."""
    return len(keep_apart(positions, np.arange(len(positions)), diameter))


def count_groups(positions: FloatArray, link: float) -> int:
    """Count the groups of positions (M, 3) that are linked by distances below `link`, scene units."""
    if link <= 0.0 or len(positions) == 0:
        return len(positions)
    return len(np.unique(link_points(Cells.of(positions, link).table, link, link / LINKS)))
