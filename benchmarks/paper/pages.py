"""The paper's tables in its layout, with the printed figures for scenes of the same name."""

from __future__ import annotations

from collections.abc import Sequence

from ..markdown import markdown
from .figures import ABLATIONS, COUNTERS, METHODS, PRINTED
from .tables import VARIANTS, SceneTables, Tally

NO_LPIPS = "not measured: its network's weights are not at hand"
NO_GPU = "GPU not measured: no GPU"


def reconstruction_table(scenes: Sequence[SceneTables]) -> str:
    """Markdown: four lines per scene, as in the paper's table of reconstruction; its own columns follow in brackets."""
    printed = [scene for scene in scenes if scene.name in PRINTED]
    head = ["scene", "metric", *VARIANTS, *((f"[{method}]" for method in METHODS) if printed else ())]
    lines = [head]
    for scene in scenes:
        paper = PRINTED.get(scene.name)
        rows = [scene.reconstruction[name] for name in VARIANTS]
        cells = {
            "SSIM ↑": [_format(row.ssim, 3) for row in rows],
            "PSNR / dB ↑": [_format(row.psnr, 2) for row in rows],
            "LPIPS ↓": [NO_LPIPS, *[""] * (len(rows) - 1)],
            "FPS ↑ (CPU)": [_format(row.fps, 1) for row in rows],
            "FPS ↑ (GPU)": [NO_GPU, *[""] * (len(rows) - 1)],
        }
        own: dict[str, Sequence[object]] = {}
        if paper is not None:
            own = {"SSIM ↑": paper.ssim, "PSNR / dB ↑": paper.psnr, "LPIPS ↓": paper.lpips, "FPS ↑ (GPU)": paper.fps}
        for metric, values in cells.items():
            beside = [str(value) for value in own.get(metric, [""] * len(METHODS))] if printed else []
            lines.append([scene.name, metric, *values, *beside])
    return markdown(lines)


def count_table(scenes: Sequence[SceneTables]) -> str:
    """Markdown: counted (share of the true number, F1 at half a diameter), one line per scene."""
    return _tabulate_counts(scenes, "counts", COUNTERS)


def ablation_table(scenes: Sequence[SceneTables]) -> str:
    """Markdown: counts with language, without, and with FruitNeRF's field instead."""
    return _tabulate_counts(scenes, "ablation", ABLATIONS)


def _tabulate_counts(scenes: Sequence[SceneTables], part: str, paper_columns: Sequence[str]) -> str:
    printed = [scene for scene in scenes if scene.name in PRINTED]
    columns = list(dict.fromkeys(name for scene in scenes for name in getattr(scene, part)))
    head = ["scene", *columns, "visible truth"]
    lines = [[*head, *((f"[{name}]" for name in paper_columns) if printed else ()), *(["[truth]"] if printed else ())]]
    notes: list[str] = []
    for scene in scenes:
        tallies: dict[str, Tally] = getattr(scene, part)
        true = next((tally.true for tally in tallies.values() if tally.true is not None), None)
        line = [scene.name, *(_cell(tallies[name]) for name in columns), "" if true is None else str(true)]
        if printed:
            paper = PRINTED.get(scene.name)
            own = () if paper is None else getattr(paper, part)
            line += [str(value) for value in own] or [""] * len(paper_columns)
            line.append("" if paper is None or paper.true is None else str(paper.true))
        lines.append(line)
        notes += [f"- {scene.name}, {name}: {tally.note}" for name, tally in tallies.items()
                  if tally.note and tally.counted is not None]  # fmt: skip
    return "\n\n".join([markdown(lines), *(["\n".join(notes)] if notes else [])])


def _cell(tally: Tally) -> str:
    if tally.counted is None:
        return tally.note
    if not tally.true:
        return str(tally.counted)
    share = f"{tally.counted} ({tally.counted / tally.true:.1%})"
    return share if tally.f1 is None else f"{share}, F1 {tally.f1:.3f}"


def _format(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
