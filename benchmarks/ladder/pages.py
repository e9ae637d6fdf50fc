"""Tables, plots and a page with the results of the ladder."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...engine.evaluation.metrics import CountMetrics
from ...engine.evaluation.summary import summarise
from ...engine.storage.files import write_text
from ..markdown import markdown
from ..plots import save_plot
from .ladder import StageResult
from .rows import number_cell, rows_csv
from .stages import COUNTING_ONLY, END_TO_END, STAGES, TRUE_MASKS, TRUE_POSES

LOSS_NAMES = ("counting", "Gaussians", "masks", "poses")
"""The parts of the pipeline that can lose fruit, in order."""


@dataclass(frozen=True)
class Loss:
    """F1 at half a diameter that each of LOSS_NAMES loses, NaN without the stage that shows it; largest: which loses
    most, empty if none does."""

    stages: tuple[float, ...]

    @property
    def largest(self) -> str:
        known = [(loss, name) for loss, name in zip(self.stages, LOSS_NAMES, strict=True) if loss > 0.0]
        return max(known, key=lambda pair: pair[0])[1] if known else ""


def measure_losses(f1_by_stage: dict[str, float]) -> Loss:
    """Measure the loss of each part: of counting the difference to 1, of the others the difference to the stage with
    their truth."""

    def of(stage: str) -> float:
        return f1_by_stage.get(stage, math.nan)

    return Loss(
        (
            1.0 - of(COUNTING_ONLY),
            of(COUNTING_ONLY) - of(TRUE_MASKS),
            of(TRUE_MASKS) - of(TRUE_POSES),
            of(TRUE_POSES) - of(END_TO_END),
        )
    )


def times_csv(rows: Sequence[StageResult]) -> str:
    """Seconds of every stage that trained; a separate table because they differ between runs."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["species", "seed", "ablation_stage", "scene", "stage", "seconds"])
    for row in rows:
        for stage, seconds in row.seconds.items():
            writer.writerow([row.species, number_cell(row.seed), row.stage, row.scene, stage, f"{seconds:.2f}"])
    return text.getvalue()


def visibility_csv(rows: Sequence[StageResult]) -> str:
    """Recall and errors of every stage by the largest visible fraction."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = ("low", "high", "visible", "recall", "center_error", "diameter_error")
    writer.writerow(
        ["species", "seed", "ablation_stage", "scene", *(f"fraction_{name}" for name in names[:2]), *names[2:]]
    )
    for row in rows:
        for part in row.classes:
            cells = [number_cell(getattr(part, name)) for name in names]
            writer.writerow([row.species, number_cell(row.seed), row.stage, row.scene, *cells])
    return text.getvalue()


def stage_rows(rows: Sequence[StageResult]) -> list[list[str]]:
    """F1 at half a diameter by scene and stage, and the part that loses most; then means over scenes.

    The mean loss is over the scenes that every stage measured.
    """
    names = _stages_of(rows)
    lines = [["scene", "visible", *names, "loses most"]]
    whole = []
    for scene in dict.fromkeys(row.scene for row in rows):
        own = {row.stage: row for row in rows if row.scene == scene}
        visible = next((str(row.near.visible) for row in own.values() if row.near), "")
        f1 = {name: row.near.f1 for name, row in own.items() if row.near}
        whole += [row for row in own.values() if len(f1) == len(names)]
        lines.append([scene, visible, *(_f1_cell(own.get(name)) for name in names), measure_losses(f1).largest])
    summaries = {name: summarise(_metrics(rows, name)) for name in names}
    last = measure_losses({name: summarise(_metrics(whole, name)).f1 for name in names if whole})
    lines.append(
        ["mean F1", "", *(_number(summaries[name].f1) + _note_some(rows, name) for name in names), last.largest]
    )
    lines.append(["mean precision", "", *(_number(summaries[name].precision) for name in names), ""])
    lines.append(["mean recall", "", *(_number(summaries[name].recall) for name in names), ""])
    lines.append(["bias of all counts", "", *(_percent(summaries[name].bias, sign=True) for name in names), ""])
    lines.append(["MAPE", "", *(_percent(summaries[name].mape) for name in names), ""])
    return lines


def loss_rows(rows: Sequence[StageResult]) -> list[list[str]]:
    """How much F1 each part loses on each scene."""
    lines = [["scene", *LOSS_NAMES]]
    for scene in dict.fromkeys(row.scene for row in rows):
        loss = measure_losses({row.stage: row.near.f1 for row in rows if row.scene == scene and row.near})
        lines.append([scene, *(_number(value, sign=True) for value in loss.stages)])
    return lines


def visibility_rows(rows: Sequence[StageResult]) -> list[list[str]]:
    """Recall by visible fraction and stage, all scenes together, with the number of fruit; empty without a truth."""
    names = [name for name in _stages_of(rows) if any(row.stage == name and row.classes for row in rows)]
    if not names:
        return []
    classes = next(row.classes for row in rows if row.classes)
    lines = [["best view shows", *names]]
    for number, part in enumerate(classes):
        cells = []
        for name in names:
            own = [row.classes[number] for row in rows if row.stage == name and row.classes]
            seen = sum(each.visible for each in own)
            found = sum(round(each.recall * each.visible) for each in own if each.visible)
            cells.append(f"{found / seen:.3f} of {seen}" if seen else "")
        lines.append([f"{part.low:.0%} to {part.high:.0%}", *cells])
    return lines


def camera_rows(rows: Sequence[StageResult]) -> list[list[str]]:
    """Errors of the cameras that were found from photos, by scene; empty if none were."""
    lines = [["scene", "placed", "centre, median", "centre, 90 %", "rotation, median", "rotation, 90 %"]]
    for row in rows:
        if row.cameras is not None:
            errors = row.cameras
            centers = [f"{1000.0 * value:.1f} mm" for value in (errors.center, errors.center_90)]
            rotations = [f"{value:.2f}°" for value in (errors.rotation, errors.rotation_90)]
            lines.append([row.scene, f"{errors.placed} of {errors.photos}", *centers, *rotations])
    return lines if len(lines) > 1 else []


def _stages_of(rows: Sequence[StageResult]) -> list[str]:
    return [name for name in STAGES if any(row.stage == name for row in rows)]


def draw_ladder(rows: Sequence[StageResult], path: Path) -> None:
    """F1 at half a diameter from stage to stage, one line per scene."""
    from matplotlib.figure import Figure

    names = _stages_of(rows)
    figure = Figure(figsize=(max(6.0, 1.4 * len(names)), 4.5), layout="constrained")
    axes = figure.add_subplot()
    for scene in dict.fromkeys(row.scene for row in rows):
        own = {row.stage: row.near.f1 for row in rows if row.scene == scene and row.near}
        axes.plot([own.get(name, math.nan) for name in names], marker="o", label=scene)
    axes.set_xticks(range(len(names)), names, fontsize=8)
    axes.set_ylabel("F1 at half a diameter")
    axes.grid(alpha=0.3)
    if rows:
        axes.legend(fontsize=8)
    save_plot(figure, path, dpi=120)


def write_pages(rows: Sequence[StageResult], out: Path, *, title: str) -> None:
    """Write ladder.csv, visibility.csv, times.csv, ladder.md, ladder.png and index.html into `out`."""
    from jinja2 import Environment

    for name, text in (("ladder", rows_csv(rows)), ("visibility", visibility_csv(rows)), ("times", times_csv(rows))):
        write_text(out / f"{name}.csv", text)
    failed = [f"- {row.scene}, {row.stage}: {row.failed}" for row in rows if row.failed]
    parts = [f"# {title}", *table_parts(rows)] + (["Failed:", "\n".join(failed)] if failed else [])
    write_text(out / "ladder.md", "\n\n".join(parts) + "\n")
    draw_ladder(rows, out / "ladder.png")
    template = Environment(autoescape=True).from_string(_PAGE)
    tables = [table for table in (stage_rows(rows), loss_rows(rows), visibility_rows(rows), camera_rows(rows)) if table]
    write_text(out / "index.html", template.render(title=title, tables=tables, rows=rows, stages=STAGES))


def table_parts(rows: Sequence[StageResult]) -> list[str]:
    """The tables in Markdown, each after its title."""
    parts = ["F1 at half a diameter against visible fruit:", markdown(stage_rows(rows))]
    parts += ["F1 that each stage loses:", markdown(loss_rows(rows))]
    by_visibility = visibility_rows(rows)
    if by_visibility:
        parts += ["Recall by visible fraction, all scenes together:", markdown(by_visibility)]
    cameras = camera_rows(rows)
    if cameras:
        parts += ["Errors of the cameras found from photos:", markdown(cameras)]
    return parts


def _metrics(rows: Sequence[StageResult], stage: str) -> list[CountMetrics]:
    return [row.near for row in rows if row.stage == stage and row.near]


def _note_some(rows: Sequence[StageResult], stage: str) -> str:
    """Return a note on how many scenes a mean includes, if a stage failed on some."""
    own = [row for row in rows if row.stage == stage]
    failed = sum(bool(row.failed) for row in own)
    return f" ({len(own) - failed} of {len(own)})" if failed else ""


def _f1_cell(row: StageResult | None) -> str:
    if row is None:
        return ""
    if row.failed:
        return "failed"
    return f"{row.counted} counted" if row.near is None else f"{row.near.f1:.3f}"


def _number(value: float, *, sign: bool = False) -> str:
    return "" if math.isnan(value) else f"{value:{'+' if sign else ''}.3f}"


def _percent(value: float, *, sign: bool = False) -> str:
    return "" if math.isnan(value) else f"{value:{'+' if sign else ''}.1%}"


_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{{ title }}</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1280px; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0 } td, th { padding: .2em .8em; border-bottom: 1px solid #ddd }
td + td, th + th { text-align: right } img { max-width: 100% } dt { font-weight: 600 }
</style>
<h1>{{ title }}</h1>
<dl>{% for name, text in stages.items() %}<dt>{{ name }}</dt><dd>{{ text }}</dd>{% endfor %}</dl>
{% for table in tables %}<table>
<tr>{% for cell in table[0] %}<th>{{ cell }}</th>{% endfor %}</tr>
{% for line in table[1:] %}<tr>{% for cell in line %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}
</table>{% endfor %}
<p><img src="ladder.png" alt="F1 by ablation stage"></p>
<h2>Worst mistakes</h2>
<p>True visible fruit are ringed in green, counted fruit in orange; the cross marks the subject.</p>
{% for row in rows if row.mistakes %}<h3>{{ row.scene }}, {{ row.stage }}</h3>
<img src="{{ row.scene }}/{{ row.mistakes }}" alt="mistakes of {{ row.scene }}, {{ row.stage }}">{% endfor %}
{% for row in rows if row.failed %}<p>{{ row.scene }}, {{ row.stage }}: {{ row.failed }}</p>{% endfor %}
</html>
"""
