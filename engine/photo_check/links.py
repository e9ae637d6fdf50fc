"""Which photos show the same content, and where the walk has gaps."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np

from ..progress import Progress, silent
from .features import Features, Link, find_link

NEAR = 6
"""Every photo is matched with this many of the following ones."""
SPREAD = 32
"""Number of photos, evenly spread, that are all matched with each other."""
MOST_ENDS = 16
"""Most photos next to a gap that are matched with all photos before the gap is reported."""
MOST_STEPS = 4
"""Two photos with a chain of at most this many links between them have no gap between them."""
LEAST_GROUP = 3, 0.1
"""Photos, and share of all photos, that a group has at least; smaller ones are photos without a place."""

Pair = tuple[int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class Links:
    """links: {(i, j), i < j: common content} of photos in order; count: number of photos."""

    count: int
    links: Mapping[Pair, Link]

    @property
    def graph(self) -> nx.Graph:
        graph = nx.Graph()
        graph.add_nodes_from(range(self.count))
        graph.add_edges_from(self.links)
        return graph

    @property
    def groups(self) -> list[list[int]]:
        """Photos that are linked, directly or by others: each group in order, the largest group first."""
        return sorted((sorted(group) for group in nx.connected_components(self.graph)), key=lambda g: (-len(g), g))

    @property
    def large_groups(self) -> list[list[int]]:
        """Groups with enough photos for a tree or a part of a walk."""
        least = max(LEAST_GROUP[0], LEAST_GROUP[1] * self.count)
        return [group for group in self.groups if len(group) >= least]

    @property
    def lone(self) -> list[int]:
        """Photos of small groups, in order."""
        return sorted(set(range(self.count)).difference(*self.large_groups))

    @property
    def gaps(self) -> list[Pair]:
        """Consecutive photos of large groups that no short chain of links joins; photos of small groups are skipped."""
        reached = dict(nx.all_pairs_shortest_path_length(self.graph, cutoff=MOST_STEPS))
        placed = sorted(set(range(self.count)) - set(self.lone))
        return [(i, j) for i, j in itertools.pairwise(placed) if j not in reached[i]]


def find_links(features: Sequence[Features], *, progress: Progress = silent) -> Links:
    """Match photos in order with the following ones, evenly spread photos with each other, and photos next to a gap
    or in a small group with all others.

    Raises:
        Cancelled: `progress` asked for it.
    """
    count = len(features)
    near = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + NEAR, count))}
    spread = np.unique(np.linspace(0, count - 1, min(count, SPREAD)).astype(int)).tolist() if count else []
    pairs = sorted(near | set(itertools.combinations(spread, 2)))
    links = _match(features, pairs, lambda share: progress(0.8 * share, "comparing photos"))
    found = Links(count=count, links=links)
    rest = sorted(_pair_with_all(_find_uncertain(found), count) - set(pairs))
    links |= _match(features, rest, lambda share: progress(0.8 + 0.2 * share, "comparing photos next to gaps"))
    return Links(count=count, links=links)


def _match(features: Sequence[Features], pairs: Sequence[Pair], report: Callable[[float], None]) -> dict[Pair, Link]:
    links = {}
    for done, (i, j) in enumerate(pairs):
        if done % 20 == 0:
            report(done / len(pairs))
        link = find_link(features[i], features[j])
        if link is not None:
            links[i, j] = link
    return links


def _find_uncertain(found: Links) -> list[int]:
    """Find photos next to a gap or in a small group."""
    ends = sorted(set(itertools.chain.from_iterable(found.gaps)))
    return [*ends, *found.lone][:MOST_ENDS]


def _pair_with_all(photos: Iterable[int], count: int) -> set[Pair]:
    return {(min(i, j), max(i, j)) for i in photos for j in range(count) if i != j}
