"""The table of methods on simulated crowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .markdown import markdown


@dataclass(frozen=True)
class Trial:
    """One crown counted by one method."""

    setting: str
    seed: int
    method: str
    f1: float


def counting_table(trials: Sequence[Trial]) -> str:
    """Markdown: mean F1 by method and setting, and in how many crowns no other method was better."""
    settings, methods = (list(dict.fromkeys(getattr(t, name) for t in trials)) for name in ("setting", "method"))
    by_crown = {(t.setting, t.seed, t.method): t.f1 for t in trials}
    crowns = list(dict.fromkeys((t.setting, t.seed) for t in trials))
    lines = [["method", *settings, "best in"]]
    for method in methods:
        means = [np.mean([by_crown[s, seed, method] for s, seed in crowns if s == setting]) for setting in settings]
        best = sum(by_crown[*crown, method] >= max(by_crown[*crown, other] for other in methods) for crown in crowns)
        lines.append([method, *(f"{mean:.3f}" for mean in means), f"{best} of {len(crowns)}"])
    return markdown(lines)
