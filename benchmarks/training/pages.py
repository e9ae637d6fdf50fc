"""Tables and plots of the measurements of training."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from ..markdown import markdown
from ..stopwatch import Stage
from .ablation import Ablation
from .curve import Curve
from .published_3dgs import Trained
from .step_times import FORWARD_AND_BACKWARD, STAGES, STEP, Row


def stage_table(rows: Sequence[Row]) -> str:
    """Markdown: one line per setting, milliseconds by stage, and how many times longer the baseline takes for the
    sums."""
    columns = (*STAGES, FORWARD_AND_BACKWARD, STEP)
    head = ["Gaussians", "image", "threads", *columns, f"peer {FORWARD_AND_BACKWARD}", "ratio", f"peer {STEP}", "ratio"]
    lines = []
    for (n, width, height, threads), group in groupby(
        rows, lambda row: (row.gaussians, row.width, row.height, row.threads)
    ):
        by_stage = {row.stage: row for row in group}
        cells = [
            f"{n:,}",
            f"{width}×{height}",
            str(threads),
            *(_milliseconds(by_stage[name].seconds) for name in columns),
        ]
        for name in (FORWARD_AND_BACKWARD, STEP):
            row = by_stage[name]
            ratio = "" if row.baseline_ratio is None else f"{row.baseline_ratio:.1f}"
            cells += [_milliseconds(row.baseline), ratio]
        lines.append(cells)
    return _table("Milliseconds a stage, medians.", head, lines, named=False)


def curve_table(curves: Sequence[Curve]) -> str:
    """Markdown: time and quality of each training."""
    head = ["scene", "steps", "Gaussians", "seconds", "held-out PSNR / dB"]
    lines = []
    for curve in curves:
        cells = [curve.scene, str(curve.steps), f"{curve.gaussians:,}", f"{curve.seconds[-1]:.0f}"]
        lines.append([*cells, f"{curve.psnr[-1]:.2f}"])
    return _table("Training.", head, lines)


def ablation_table(rows: Sequence[Ablation]) -> str:
    """Markdown: seconds and held-out quality of each variant; the others are compared with the first row."""
    head = ["changed", "seconds", "CPU seconds", "CPU speed", "held-out PSNR / dB", "gain / dB", "SSIM", "Gaussians"]
    head += ["ℓ", "std(ℓ) / ℓ"]
    lines = []
    for row in rows:
        speed = rows[0].cpu_seconds / row.cpu_seconds
        cells = [row.name, f"{row.seconds:.1f}", f"{row.cpu_seconds:.1f}", f"{speed:.2f}×", f"{row.psnr:.2f}"]
        cells += [f"{row.psnr - rows[0].psnr:+.2f}", f"{row.ssim:.3f}", f"{row.gaussians:,}"]
        lines.append([*cells, f"{row.load:.1f}", f"{row.unevenness:.2f}"])
    return _table("Training with one part changed.", head, lines)


def published_table(rows: Sequence[Trained]) -> str:
    """Markdown: 3DGS as published compared with ours, on a scene small enough for the plain rasteriser."""
    head = ["training", "steps", "seconds", "Gaussians", "held-out PSNR / dB", "SSIM"]
    lines = []
    for row in rows:
        cells = [row.name, f"{row.steps:,}", f"{row.seconds:.0f}", f"{row.gaussians:,}"]
        lines.append([*cells, f"{row.psnr:.2f}", f"{row.ssim:.3f}"])
    return _table("A tiny scene, as published and ours.", head, lines)


def watched_table(title: str, rows: Sequence[Stage]) -> str:
    """Markdown: one line per stage of each pipeline, in the order in which they start."""
    head = ["of", "stage", "times", "seconds", "seconds each", "memory at most / MB"]
    lines = []
    for row in rows:
        each = row.seconds / max(row.times, 1)
        cells = [row.pipeline, row.name, str(row.times), f"{row.seconds:.2f}", f"{each:.3f}", f"{row.peak / 2**20:.0f}"]
        lines.append(cells)
    return _table(title, head, lines)


def _table(title: str, head: Sequence[str], lines: Sequence[Sequence[str]], *, named: bool = True) -> str:
    """Markdown: a sentence and a table."""
    return f"{title}\n\n{markdown([head, *lines], named=named)}"


def _milliseconds(seconds: float | None) -> str:
    return "" if seconds is None else f"{1000 * seconds:.1f}"


def draw_stages(rows: Sequence[Row], path: Path) -> None:
    """Bars of the stages of a step by setting, with the baseline's ratio above each."""
    from matplotlib.figure import Figure

    settings = list(dict.fromkeys((row.gaussians, row.width, row.height, row.threads) for row in rows))
    table = {(row.gaussians, row.width, row.height, row.threads, row.stage): row for row in rows}
    figure = Figure(figsize=(max(6.0, 0.6 * len(settings) + 2), 5), layout="constrained")
    axes = figure.add_subplot()
    bottom = [0.0] * len(settings)
    for stage in STAGES:
        heights = [1000 * table[(*setting, stage)].seconds for setting in settings]
        axes.bar(range(len(settings)), heights, bottom=bottom, label=stage)
        bottom = [low + height for low, height in zip(bottom, heights, strict=True)]
    for place, setting in enumerate(settings):
        ratio = table[(*setting, STEP)].baseline_ratio
        if ratio is not None:
            axes.text(place, bottom[place], f"{ratio:.0f}×", ha="center", va="bottom", fontsize=8)
    names = [f"{n // 1000}k\n{width}×{height}\n{threads} thr." for n, width, height, threads in settings]
    axes.set_xticks(range(len(settings)), names, fontsize=7)
    axes.set_ylabel("milliseconds a step")
    axes.set_yscale("log" if max(bottom) > 20 * min(bottom) else "linear")
    axes.set_title("A step by stage, and how many times longer plain PyTorch takes", fontsize=10)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def draw_curves(curves: Sequence[Curve], path: Path) -> None:
    """Held-out PSNR over seconds of training."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for curve in curves:
        axes.plot(curve.seconds, curve.psnr, marker=".", label=f"{curve.scene}, {curve.steps} steps")
    axes.set_xlabel("seconds of training")
    axes.set_ylabel("held-out PSNR / dB")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=120)
