"""A larger network initialised from a smaller one, with the same output."""

from __future__ import annotations

from torch import Tensor

from ...engine.language.encoders.embedded import StoredWeights
from ...engine.language.encoders.network import Network
from ...engine.language.vocabulary import CONCEPTS


def widen(stored: StoredWeights, network: Network) -> dict[str, Tensor]:
    """Return the state of `network` that gives the same output as `stored` for the words that both know; new words
    start at random.

    Old channels get no input from new ones, which start at random, and new layers with a skip start as the identity
    (Chen, Goodfellow and Shlens 2016, "Net2Net", use copies instead).

    Raises:
        ValueError: `stored` is of a larger network.
    """
    if len(stored.widths) != len(network.down):
        raise ValueError("the stored network has other stages")
    state = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    if not stored.tensors.keys() <= state.keys():
        raise ValueError("the stored network is the deeper one")
    for name, mine in state.items():
        old = stored.tensors.get(name)
        if name.startswith("head."):
            _take_words(mine, stored, name)
        elif old is None and name.endswith("norm.weight"):
            mine.zero_()  # a new layer adds nothing to its skip
        elif old is not None:
            _take(mine, old)
    return state


def _take(mine: Tensor, old: Tensor) -> None:
    """Put the old channels first, with input from each other only."""
    if any(theirs > ours for theirs, ours in zip(old.shape, mine.shape, strict=True)):
        raise ValueError("the stored network is the wider one")
    if mine.dim() > 1:
        mine[: len(old)] = 0.0
    mine[tuple(slice(side) for side in old.shape)] = old


def _take_words(mine: Tensor, stored: StoredWeights, name: str) -> None:
    old = stored.tensors[name]
    for row, word in enumerate(CONCEPTS):
        if word in stored.concepts:
            mine[row] = 0.0
            mine[row][tuple(slice(side) for side in old.shape[1:])] = old[stored.concepts.index(word)]
