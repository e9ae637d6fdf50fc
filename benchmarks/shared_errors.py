"""How much of the error of a count is common to trees of a species, and how often intervals of sums hold.

The middle of an interval, on a logarithmic scale, stands for the most likely number.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

from scipy import stats

from ..engine.block.totals import Amount, sum_amounts

LEAST_FRUIT = 0.5
"""Lower end of an interval that starts at 0, where its logarithm is needed."""


@dataclass(frozen=True, kw_only=True)
class MeasuredTree:
    """A tree whose true number of fruit is known. low, high: 90 % interval of the number."""

    true: int
    low: float
    high: float

    @property
    def amount(self) -> Amount:
        """Its number as a block has it."""
        likely = math.sqrt(max(self.low, LEAST_FRUIT) * self.high)
        return Amount(count=round(likely), likely=likely, low=self.low, high=self.high)

    @property
    def log_error(self) -> float:
        """Logarithm of the ratio of the most likely number to the true one."""
        return math.log(self.amount.likely / self.true)


@dataclass(frozen=True, kw_only=True)
class IntraclassCorrelation:
    """Share of the variance that members of a group have in common. low, high: 95 % interval, if errors are normal."""

    value: float
    low: float
    high: float


def intraclass_correlation(groups: Sequence[Sequence[float]]) -> IntraclassCorrelation:
    """The correlation by the one-way random effects model: from the mean squares between and within groups (Shrout &
    Fleiss 1979, ICC(1,1), with the mean group size of unbalanced designs). At least 0.

    Raises:
        ValueError: there is one group, or no group with two members.
    """
    count, members = len(groups), sum(map(len, groups))
    if count < 2 or members <= count:
        raise ValueError(f"{members} members in {count} groups")
    size = (members - sum(len(group) ** 2 for group in groups) / members) / (count - 1)
    grand = mean(itertools.chain(*groups))
    between = sum(len(group) * (mean(group) - grand) ** 2 for group in groups) / (count - 1)
    within = sum((value - mean(group)) ** 2 for group in groups for value in group) / (members - count)
    ratio = between / within if within > 0.0 else math.inf
    ends = [ratio / stats.f.ppf(tail, count - 1, members - count) for tail in (0.975, 0.025)]
    low, value, high = (max(1.0 - size / (each + size - 1.0), 0.0) for each in (ends[0], ratio, ends[1]))
    return IntraclassCorrelation(value=value, low=low, high=high)


def estimate_shared_error(trees: Mapping[str, Sequence[MeasuredTree]]) -> IntraclassCorrelation:
    """Estimate the correlation of log errors within species. trees: by species."""
    return intraclass_correlation([[tree.log_error for tree in own] for own in trees.values()])


def measure_held_sums(trees: Sequence[MeasuredTree], shared: float, size: int) -> float:
    """Measure the share of the sums of `size` of these trees of a species, drawn with replacement, whose intervals
    hold."""
    return mean(_holds(chosen, shared) for chosen in itertools.product(trees, repeat=size))


def measure_held_sums_left_out(trees: Mapping[str, Sequence[MeasuredTree]], size: int) -> float:
    """Do the same over all species, each with the shared part that the other species have."""
    found = []
    for species, own in trees.items():
        others = {name: each for name, each in trees.items() if name != species}
        found.append(measure_held_sums(own, estimate_shared_error(others).value, size))
    return mean(found)


def _holds(trees: Sequence[MeasuredTree], shared: float) -> bool:
    whole = sum_amounts([tree.amount for tree in trees], ["one kind"] * len(trees), shared)
    return whole.low <= sum(tree.true for tree in trees) <= whole.high
