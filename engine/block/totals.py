"""From the counts of trees to those of rows and of the block, with intervals; and from a sample to all trees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ..errors import ConfigError

SHARED = 0.5
"""Share of the variance of a tree's count that all trees of a block have in common, because they have one kind of
fruit, one camera and one light. It does not average away. The intervals were calibrated on generated trees, where no
common part was found; in an orchard it is unknown, so half is assumed."""
LEAST_SAMPLE = 3
"""Photographed trees from which all trees are estimated."""


@dataclass(frozen=True, kw_only=True)
class Amount:
    """A number of fruit: counted, the most likely one, and its 90 % interval."""

    count: int
    likely: float
    low: float
    high: float


def summed(amounts: Sequence[Amount]) -> Amount:
    """The sum of trees' numbers. Half of each variance (`SHARED`) is one error that all trees have, which adds up
    linearly; the other half is independent."""
    likely = sum(amount.likely for amount in amounts)
    below = _combined([amount.likely - amount.low for amount in amounts])
    above = _combined([amount.high - amount.likely for amount in amounts])
    count = sum(amount.count for amount in amounts)
    return Amount(count=count, likely=likely, low=max(likely - below, 0.0), high=likely + above)


def _combined(widths: Sequence[float]) -> float:
    alone, together = sum(width * width for width in widths), sum(widths) ** 2
    return math.sqrt((1.0 - SHARED) * alone + SHARED * together)


def require_sample(sample: int, trees: int) -> None:
    """
    Raises:
        ConfigError: there are fewer trees in all than photographed ones, or too few to see how much trees differ.
    """
    if trees < sample:
        raise ConfigError(f"{sample} trees are given, which is more than the {trees} of the block (--all-trees)")
    if sample < LEAST_SAMPLE and trees > sample:
        raise ConfigError(f"All trees are estimated from {LEAST_SAMPLE} counted ones or more, and here are {sample}")


def of_all(amounts: Sequence[Amount], trees: int) -> Amount:
    """The number on all trees of a block, of which these were photographed, drawn at random (Cochran 1977, eq. 2.21):
    N · mean, with the variance between trees, Student's t and the finite population's correction, and the errors of
    the counts themselves.

    Raises:
        ConfigError: as `require_sample`.
    """
    sample = len(amounts)
    require_sample(sample, trees)
    whole = summed(amounts)
    if trees == sample:
        return whole
    scale = trees / sample
    spread = float(np.std([amount.likely for amount in amounts], ddof=1))
    chosen = trees * spread / math.sqrt(sample) * math.sqrt(1.0 - sample / trees)
    chosen *= float(stats.t.ppf(0.95, sample - 1))
    likely = scale * whole.likely
    below = math.hypot(chosen, scale * (whole.likely - whole.low))
    above = math.hypot(chosen, scale * (whole.high - whole.likely))
    # At least what was found on the sample, but an interval holds its most likely number.
    low = min(max(likely - below, whole.low), likely)
    return Amount(count=whole.count, likely=likely, low=low, high=likely + above)
