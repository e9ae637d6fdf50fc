"""How well each word is told from the word it is most easily taken for."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.colors import XKCD_COLORS, to_rgb
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score

from ...engine.language.colours import colour_words
from ...engine.language.vocabulary import COLOURS

FloatArray = NDArray[np.float64]

LEAST = 100
"""A word with fewer measured pixels than this is not judged, and no other is judged by it."""
LEAST_COLOURS = 10
"""The same, of named colours."""
_HALF_MEANT = re.compile(r"ish$|^(redd|orang|yellow|green|blue|purpl|pink|brown|grey|violet|teal|turquoise|tan|gold)")
"""Parts of a colour's name that pull it to another word."""


@dataclass(frozen=True)
class Distinction:
    """auc: chance that a pixel of the word answers higher to it than one of `against` does, its worst rival."""

    auc: float
    against: str


def distinctions(
    answers: Mapping[str, FloatArray],
    truth: NDArray[np.str_],
    *,
    general: Mapping[str, Sequence[str]] | None = None,
    least: int = LEAST,
) -> dict[str, Distinction]:
    """Each word's worst rival. answers: by word (M,) how much each pixel is it; truth: (M,) what each pixel is.

    general: the words that a general one stands for; none of them is its rival, and it is nobody's.
    """
    general = general or {}
    candidates = [word for word in answers if (truth == word).sum() >= least]
    found = {}
    for word, mine in answers.items():
        own = general.get(word, (word,))
        meant, others = np.isin(truth, own), [candidate for candidate in candidates if candidate not in own]
        if others and meant.sum() >= least:
            against = (Distinction(_auc(mine[meant], mine[truth == candidate]), candidate) for candidate in others)
            found[word] = min(against, key=lambda each: each.auc)
    return found


def colour_distinctions() -> dict[str, Distinction]:
    """Of colour words, on the 954 colours that 222,500 people named (Munroe 2010, public domain).

    A colour counts for the basic word that its name ends in, as "brick red"; "reddish brown" and the like are left out.
    """
    names = {name.removeprefix("xkcd:").replace("gray", "grey"): to_rgb(value) for name, value in XKCD_COLORS.items()}
    called = {name: word for name in names if (word := _basic(name)) is not None}
    shares = colour_words(torch.tensor([names[name] for name in called])).double().numpy()
    truth = np.array(list(called.values()))
    return distinctions({word: shares[:, i] for i, word in enumerate(COLOURS)}, truth, least=LEAST_COLOURS)


def _basic(name: str) -> str | None:
    *before, last = re.split(r"[\s/]+", name)
    return last if last in COLOURS and not any(map(_HALF_MEANT.search, before)) else None


def _auc(mine: FloatArray, others: FloatArray) -> float:
    truth = np.concatenate([np.ones(len(mine)), np.zeros(len(others))])
    return float(roc_auc_score(truth, np.concatenate([mine, others])))
