"""The tables of methods on simulated crowns and on scenes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ...engine.evaluation.summary import summarise
from ..markdown import NONE, markdown
from .trials import Trial

_PER_FRUIT = ("doubles", "merges")


def counting_page(trials: Sequence[Trial]) -> str:
    """Markdown: all tables, each with its title."""
    parts = [
        "F1 at half a diameter, mean over crowns:",
        counting_table(trials),
        "All figures, mean over crowns; doubles and merges per 100 visible fruit, centre error in mean diameters:",
        figures_table(trials),
        "By how much of the fruit the best view shows, all crowns together; recall, centre error and diameter error:",
        visibility_table(trials),
    ]
    if len(_names(trials, "setting")) > 1:
        parts[4:4] = ["The same by setting:", figures_table(trials, by_setting=True)]
    if any(trial.touching.pairs for trial in trials):
        parts += ["Touching pairs of which the best views show 50 to 70 % of either fruit:", pairs_table(trials)]
    return "\n\n".join(parts)


def counting_table(trials: Sequence[Trial]) -> str:
    """Markdown: mean F1 by method and setting, and in how many crowns no other method was better."""
    settings, methods = _names(trials, "setting"), _names(trials, "method")
    by_crown = {(t.setting, t.seed, t.method): t.metrics.f1 for t in trials}
    crowns = list(dict.fromkeys((t.setting, t.seed) for t in trials))
    lines = [["method", *settings, "best in"]]
    for method in methods:
        means = [np.mean([by_crown[s, seed, method] for s, seed in crowns if s == setting]) for setting in settings]
        best = sum(by_crown[*crown, method] >= max(by_crown[*crown, other] for other in methods) for crown in crowns)
        lines.append([method, *(f"{mean:.3f}" for mean in means), f"{best} of {len(crowns)}"])
    return markdown(lines)


def figures_table(trials: Sequence[Trial], *, by_setting: bool = False) -> str:
    """Markdown: means over crowns by method, or by setting and method."""
    head = ["precision", "recall", "F1", "doubles", "merges", "MAPE", "centre error", "diameter error"]
    lines = [["setting, method" if by_setting else "method", *head]]
    for setting in _names(trials, "setting") if by_setting else [""]:
        for method in _names(trials, "method"):
            own = [t.metrics for t in trials if t.method == method and setting in ("", t.setting)]
            if not own:
                continue
            mean = summarise(own)
            per_fruit = [100.0 * _mean([getattr(m, name) / max(m.visible, 1) for m in own]) for name in _PER_FRUIT]
            errors = [_mean([getattr(m, name) for m in own]) for name in ("center_error", "diameter_error")]
            cells = [_cell(value) for value in (mean.precision, mean.recall, mean.f1)]
            cells += [*(_cell(value, ".1f") for value in per_fruit), _cell(mean.mape, ".1%")]
            cells += [_cell(errors[0]), _cell(errors[1], ".1%")]
            lines.append([f"{setting}, {method}" if setting else method, *cells])
    return markdown(lines)


def visibility_table(trials: Sequence[Trial]) -> str:
    """Markdown: recall, centre and diameter error by class of visible fraction and method, over all fruit."""
    parts = trials[0].classes
    lines = [["method", *(f"{part.low:.0%} to {part.high:.0%}" for part in parts)]]
    for method in _names(trials, "method"):
        cells = []
        for number in range(len(parts)):
            own = [t.classes[number] for t in trials if t.method == method and t.classes[number].visible]
            seen = sum(part.visible for part in own)
            found = [round(part.recall * part.visible) for part in own]
            shares = [sum(found) / seen if seen else math.nan]
            for name in ("center_error", "diameter_error"):
                values = [getattr(part, name) * n for part, n in zip(own, found, strict=True) if n]
                shares.append(sum(values) / sum(found) if sum(found) else math.nan)
            cells.append(f"{_cell(shares[0])}, {_cell(shares[1])}, {_cell(shares[2], '.1%')}")
        lines.append([method, *cells])
    any_method = [t for t in trials if t.method == trials[0].method]
    lines.append(["fruit", *(str(sum(t.classes[n].visible for t in any_method)) for n in range(len(parts)))])
    return markdown(lines)


def pairs_table(trials: Sequence[Trial]) -> str:
    """Markdown: of the pairs that are visible to about 60 %, the share of pairs whose fruit are each counted once."""
    lines = [["method", "pairs", "each fruit counted once"]]
    for method in _names(trials, "method"):
        pairs = sum(t.touching.pairs for t in trials if t.method == method)
        apart = sum(t.touching.apart for t in trials if t.method == method)
        lines.append([method, str(pairs), _cell(apart / pairs if pairs else math.nan, ".1%")])
    return markdown(lines)


def _names(trials: Sequence[Trial], name: str) -> list[str]:
    return list(dict.fromkeys(getattr(trial, name) for trial in trials))


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.mean(known)) if known else math.nan


def _cell(value: float, form: str = ".3f") -> str:
    return format(value, form) if math.isfinite(value) else NONE
