"""The results of the ladder as lines of a table, written and read."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

from ...engine.evaluation.camera_errors import CameraErrors
from ...engine.evaluation.metrics import VISIBILITY_EDGES, CountMetrics, VisibilityClass
from .ladder import StageResult

COUNTS = ("predicted", "visible", "total", "matched", "ignored")
RATIOS = ("precision", "recall", "f1")
ERRORS = (
    "doubles", "merges", "count_error", "relative_count_error", "relative_total_error", "center_error",
    "diameter_error", "diameter_bias",
)  # fmt: skip
OF_CAMERAS = ("placed", "photos", "center", "center_90", "rotation", "rotation_90")
"""Fields of `CameraErrors`."""
CLASSES = tuple(f"{name}_{100 * low:.0f}" for low in VISIBILITY_EDGES[:-1] for name in ("visible", "found"))
"""True fruit whose largest visible fraction starts at so many percent, and how many of them were found."""
COLUMNS = (
    "species", "seed", "ablation_stage", "scene", *COUNTS, *RATIOS, "f1_at_1", *ERRORS, "ece", "interval_low",
    "interval_high", "total_estimate", "total_low", "total_high", "psnr", "ssim", "views",
    *(f"cameras_{name}" for name in OF_CAMERAS), *CLASSES, "failed",
)  # fmt: skip
INTEGERS = {"radius", "predicted", "visible", "total", "matched", "ignored", "doubles", "merges", "count_error"}


def number_cell(value: float | int | str | None) -> str:
    """A value as a cell; empty if there is none."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.4f}" if isinstance(value, float) else str(value)


def cells_of(row: StageResult) -> dict[str, str]:
    """{column: cell} of a stage; ratios with four digits, lengths in mean true diameters, PSNR in dB; empty if not
    measured."""
    near, low_high, total = row.near, row.interval or (None, None), row.total_interval or (None, None)
    values: dict[str, float | int | str | None] = {
        "species": row.species, "seed": row.seed, "ablation_stage": row.stage, "scene": row.scene,
        "predicted": row.counted, "f1_at_1": row.far.f1 if row.far else None, "ece": row.ece,
        "interval_low": low_high[0], "interval_high": low_high[1], "total_estimate": row.total_estimate,
        "total_low": total[0], "total_high": total[1], "psnr": row.psnr, "ssim": row.ssim, "views": row.views,
        "failed": row.failed,
    }  # fmt: skip
    for name in (*COUNTS[1:], *RATIOS, *ERRORS):
        values[name] = getattr(near, name) if near else None
    for name in OF_CAMERAS:
        values[f"cameras_{name}"] = getattr(row.cameras, name) if row.cameras else None
    for part in row.classes:
        start = f"{100 * part.low:.0f}"
        values[f"visible_{start}"] = part.visible
        values[f"found_{start}"] = round(part.recall * part.visible) if part.visible else 0
    return {name: number_cell(values.get(name)) for name in COLUMNS}


def rows_csv(rows: Sequence[StageResult]) -> str:
    """One line per stage."""
    return table_csv([cells_of(row) for row in rows], COLUMNS)


def table_csv(lines: Sequence[Mapping[str, str]], columns: Sequence[str]) -> str:
    """Lines of cells as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def row_of(cells: Mapping[str, str]) -> StageResult:
    """The stage of a line; what the line does not hold (`far`, seconds) is missing."""

    def number(name: str) -> float:
        return float(cells[name]) if cells[name] else math.nan

    def pair(low: str, high: str) -> tuple[float, float] | None:
        return (number(low), number(high)) if cells[low] else None

    near = None
    if cells["f1"]:
        values = {name: number(name) for name in (*COUNTS, *RATIOS, *ERRORS)}
        whole = {name: int(value) for name, value in values.items() if name in INTEGERS}
        near = CountMetrics(radius=0.5, **{**values, **whole})  # type: ignore[arg-type]
    cameras = None
    if cells["cameras_placed"]:
        found = {name: number(f"cameras_{name}") for name in OF_CAMERAS[2:]}
        cameras = CameraErrors(placed=int(cells["cameras_placed"]), photos=int(cells["cameras_photos"]), **found)
    return StageResult(
        species=cells["species"],
        seed=int(cells["seed"]) if cells["seed"] else None,
        scene=cells["scene"],
        stage=cells["ablation_stage"],
        counted=int(cells["predicted"]) if cells["predicted"] else None,
        near=near,
        classes=_classes(cells),
        ece=number("ece"),
        interval=pair("interval_low", "interval_high"),
        total_interval=pair("total_low", "total_high"),
        total_estimate=number("total_estimate") if cells["total_estimate"] else None,
        psnr=number("psnr") if cells["psnr"] else None,
        ssim=number("ssim") if cells["ssim"] else None,
        views=int(cells["views"] or 0),
        cameras=cameras,
        failed=cells["failed"],
    )


def _classes(cells: Mapping[str, str]) -> list[VisibilityClass]:
    found = []
    for low, high in pairwise(VISIBILITY_EDGES):
        visible, matched = cells[f"visible_{100 * low:.0f}"], cells[f"found_{100 * low:.0f}"]
        if visible:
            recall = int(matched) / int(visible) if int(visible) else math.nan
            errors = {"center_error": math.nan, "diameter_error": math.nan}
            found.append(VisibilityClass(low=low, high=high, visible=int(visible), recall=recall, **errors))
    return found
