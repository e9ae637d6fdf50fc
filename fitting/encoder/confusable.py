"""How well each word is distinguished from the word it is most often confused with."""

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
"""A word with fewer measured pixels than this is not evaluated and not compared with."""
LEAST_COLOURS = 10
"""The same, for named colours."""
_HALF_MEANT = re.compile(r"ish$|^(redd|orang|yellow|green|blue|purpl|pink|brown|grey|violet|teal|turquoise|tan|gold)")
"""Parts of a colour's name that change its basic word."""


@dataclass(frozen=True)
class Distinction:
    """auc: probability that a pixel of the word scores higher for it than a pixel of `against`, its most confused
    word."""

    auc: float
    against: str


def find_distinctions(
    answers: Mapping[str, FloatArray],
    truth: NDArray[np.str_],
    *,
    general: Mapping[str, Sequence[str]] | None = None,
    least: int = LEAST,
) -> dict[str, Distinction]:
    """Find the most confused word of each word. answers: by word (M,) its probability for each pixel; truth: (M,) the
    word of each pixel.

    general: the words that a general one includes; they are not compared with it, and it is compared with no word.
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


def find_colour_distinctions() -> dict[str, Distinction]:
    """Do the same for colour words, on the 954 colours that 222,500 people named (Munroe 2010, public domain).

    A colour counts for the basic word at the end of its name, as in "brick red"; "reddish brown" and similar ones are
    left out.
    """
    names = {name.removeprefix("xkcd:").replace("gray", "grey"): to_rgb(value) for name, value in XKCD_COLORS.items()}
    called = {name: word for name in names if (word := _find_basic(name)) is not None}
    shares = colour_words(torch.tensor([names[name] for name in called])).double().numpy()
    truth = np.array(list(called.values()))
    return find_distinctions({word: shares[:, i] for i, word in enumerate(COLOURS)}, truth, least=LEAST_COLOURS)


def _find_basic(name: str) -> str | None:
    *before, last = re.split(r"[\s/]+", name)
    return last if last in COLOURS and not any(map(_HALF_MEANT.search, before)) else None


def _auc(mine: FloatArray, others: FloatArray) -> float:
    truth = np.concatenate([np.ones(len(mine)), np.zeros(len(others))])
    return float(roc_auc_score(truth, np.concatenate([mine, others])))
