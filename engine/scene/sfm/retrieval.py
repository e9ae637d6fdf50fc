"""Photos of similar content: aggregated descriptors (VLAD) with a codebook learnt from the photos themselves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .features import Features

_WORDS = 64
"""Words of the codebook."""
_SAMPLE = 20_000
"""Descriptors from which the codebook is learnt."""
_EACH = 1000
"""Features per photo that are aggregated, the largest."""


def similarities(features: Sequence[Features], seed: int) -> NDArray[np.float32]:
    """(P, P) similarity of the content of photos, in -1…1 (Jégou et al. 2010, with the signed square root)."""
    codes = aggregate_descriptors(features, seed)
    return codes @ codes.T


def aggregate_descriptors(features: Sequence[Features], seed: int) -> NDArray[np.float32]:
    """Return (P, D) one unit vector per photo: sums of the differences of its descriptors to their words."""
    from sklearn.cluster import MiniBatchKMeans
    from threadpoolctl import threadpool_limits

    large = [each.select(each.largest(_EACH)).descriptors.astype(np.float32) / 512.0 for each in features]
    everything = np.concatenate(large) if large else np.zeros((0, 128), np.float32)
    if len(everything) < _WORDS:
        return np.zeros((len(features), 1), np.float32)
    generator = np.random.default_rng(seed)
    sample = everything[np.sort(generator.permutation(len(everything))[:_SAMPLE])]
    with threadpool_limits(1):  # several threads sum in another order each time
        words = MiniBatchKMeans(_WORDS, batch_size=2048, n_init=1, random_state=seed).fit(sample).cluster_centers_
    return np.stack([_aggregate(each, words) for each in large])


def _aggregate(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    nearest = np.argmax(descriptors @ words.T - 0.5 * (words**2).sum(1), axis=1)
    sums = np.zeros_like(words)
    np.add.at(sums, nearest, descriptors - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)  # a frequent word counts no more
    code = np.sign(sums).ravel() * np.sqrt(np.abs(sums)).ravel()
    return (code / max(float(np.linalg.norm(code)), 1e-12)).astype(np.float32)
