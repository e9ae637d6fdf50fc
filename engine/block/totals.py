"""From the counts of trees to those of rows and of the block, with intervals; and from a sample to all trees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ..errors import ConfigError

SHARED_VISIBLE, SHARED_ALL = 0.47, 0.70
"""Share of the variance of a tree's count that is one error of all trees of a kind of fruit and does not average away,
for visible fruit and for all fruit. It is the intraclass correlation of log errors within species on 24 generated trees
counted from photos alone, three of each of eight species (`benchmarks/shared_errors.py`). With true cameras it is 0.10
and 0.44. Eight species determine it poorly, and errors by light, camera or orchard are not in it."""
LEAST_SAMPLE = 3
"""Photographed trees from which all trees are estimated."""


@dataclass(frozen=True, kw_only=True)
class Amount:
    """A number of fruit: counted, the most likely one, and its 90 % interval."""

    count: int
    likely: float
    low: float
    high: float


def sum_amounts(amounts: Sequence[Amount], kinds: Sequence[str], shared: float) -> Amount:
    """Sum the trees' numbers. kinds: of the fruit of each tree; shared: part of each variance that is one error of all
    trees of a kind, which adds up linearly. The rest, and the errors of different kinds, are independent."""
    likely = sum(amount.likely for amount in amounts)
    below = _combine([amount.likely - amount.low for amount in amounts], kinds, shared)
    above = _combine([amount.high - amount.likely for amount in amounts], kinds, shared)
    count = sum(amount.count for amount in amounts)
    return Amount(count=count, likely=likely, low=max(likely - below, 0.0), high=likely + above)


def _combine(widths: Sequence[float], kinds: Sequence[str], shared: float) -> float:
    by_kind = dict.fromkeys(kinds, 0.0)
    for width, kind in zip(widths, kinds, strict=True):
        by_kind[kind] += width
    alone, together = (sum(width * width for width in each) for each in (widths, by_kind.values()))
    return math.sqrt((1.0 - shared) * alone + shared * together)


def require_sample(sample: int, trees: int) -> None:
    """
    Raises:
        ConfigError: there are fewer trees in all than photographed ones, or too few to see how much trees differ.
    """
    if trees < sample:
        raise ConfigError(f"{sample} trees are given, which is more than the {trees} of the block (--all-trees)")
    if sample < LEAST_SAMPLE and trees > sample:
        raise ConfigError(f"All trees are estimated from {LEAST_SAMPLE} counted ones or more, and here are {sample}")


def estimate_all(amounts: Sequence[Amount], kinds: Sequence[str], trees: int) -> Amount:
    """Estimate the number of visible fruit on all trees of a block, of which these were photographed, drawn at random
    (Cochran 1977, eq. 2.21): N · mean, with the variance between trees, Student's t and the finite population's
    correction, and the errors of the counts themselves. kinds: of the fruit of each photographed tree.

    Raises:
        ConfigError: as `require_sample`.
    """
    sample = len(amounts)
    require_sample(sample, trees)
    whole = sum_amounts(amounts, kinds, SHARED_VISIBLE)
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
