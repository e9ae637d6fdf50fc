"""What the panel shows about a result: for the open file, and for a .blend that the command line writes.

The command line runs without the extension, so its properties do not exist there. `store_panel` puts the values into a
custom property of the Blender scene. The extension moves them into its properties when the file is opened.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy

from ...engine.report.words import count_text, explain_nothing_found, length_unit, location_text, training_text
from .source_mark import source_mark

if TYPE_CHECKING:
    from ...engine.publishing import Result
    from ...engine.scene.camera import Scene

STORED = "fruitlangs_panel"
"""Custom property of the Blender scene: a `PanelState` as JSON, until the extension has read it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneState:
    """The photos' cameras and the sparse points; the fields are properties of `scene.fruitlangs.result`."""

    cameras: int
    points: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class GaussiansState:
    """The Gaussians and their quality."""

    gaussians: int
    features: str
    quality: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class CountState:
    """A count; -1 and empty texts for what it does not have."""

    count: int
    low: int
    high: int
    total: float
    total_low: int
    total_high: int
    label: str
    unit: str
    mean_diameter: float
    zero_reason: str
    sureness: str
    whereabouts: str
    notices: str
    folder: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class PanelState:
    """Everything that the panel shows after an import of the result.

    chosen: the folder of the result; source, mark: of the photos it was made from; last_id: the highest id of a fruit.
    """

    scene: SceneState
    gaussians: GaussiansState
    count: CountState
    prompt: str
    negative: str
    threshold: float
    chosen: str
    source: str
    mark: str
    last_id: int


def scene_state(scene: Scene) -> SceneState:
    """The state of a scene."""
    return SceneState(cameras=len(scene.cameras), points=len(scene.points))


def gaussians_state(count: int, training: Mapping[str, Any], features: str) -> GaussiansState:
    """The state of `count` Gaussians. training: the entry of the provenance; features: path as stored."""
    psnr, ssim = training["psnr"], training["ssim"]
    quality = ""
    if psnr is not None:
        quality = f"held-out photos: PSNR {psnr:.1f} dB, SSIM {ssim:.2f}{training_text(training)}"
    return GaussiansState(gaussians=count, features=features, quality=quality)


def count_state(result: Result, prompt: str, folder: str) -> CountState:
    """The state of a count. prompt: the label of a count of 0; folder: the result folder as stored."""
    fruit_count, metres = result.fruit_count, result.scene.metres_per_unit
    low, high = fruit_count.interval or (-1, -1)
    total_low, total_high = fruit_count.total_interval or (-1, -1)
    unit, scale = length_unit(metres)
    found = bool(fruit_count.fruits)
    return CountState(
        count=fruit_count.count,
        low=low,
        high=high,
        total=-1.0 if fruit_count.total is None else fruit_count.total,
        total_low=total_low,
        total_high=total_high,
        label=", ".join(sorted({fruit.label for fruit in fruit_count.fruits})) or prompt,
        unit=unit,
        mean_diameter=(fruit_count.mean_diameter or 0.0) * scale,
        zero_reason="" if found else explain_nothing_found(fruit_count, result.config.count.threshold, metres),
        sureness=count_text(fruit_count) if found else "",
        whereabouts="; ".join(location_text(fruit_count)) if found else "",
        notices="; ".join(result.notices),
        folder=folder,
    )


def panel_state(result: Result, stored_path: Callable[[Path], str]) -> PanelState:
    """What the panel shows after an import of the result. stored_path: writes a path as the .blend stores it."""
    prompt, source = ", ".join(result.origin["prompts"]), Path(result.origin["source"])
    return PanelState(
        scene=scene_state(result.scene),
        gaussians=gaussians_state(
            len(result.gaussians), result.origin["training"], stored_path(result.out / "features.safetensors")
        ),
        count=count_state(result, prompt, stored_path(result.out)),
        prompt=prompt,
        negative=", ".join(result.origin.get("negatives", ())),
        threshold=result.config.count.threshold,
        chosen=stored_path(result.out),
        source=stored_path(source),
        mark=source_mark(source),
        last_id=result.fruit_count.last_id,
    )


def store_panel(bpy_scene: bpy.types.Scene, state: PanelState) -> None:
    """Store the state in a Blender scene whose properties do not exist."""
    bpy_scene[STORED] = json.dumps(dataclasses.asdict(state))


def read_stored_panel(bpy_scene: bpy.types.Scene) -> PanelState | None:
    """Read the stored state; None without one, or if another version wrote it."""
    with suppress(ValueError, TypeError, KeyError):
        values = json.loads(bpy_scene.get(STORED, "null"))
        parts = {"scene": SceneState, "gaussians": GaussiansState, "count": CountState}
        return PanelState(**{**values, **{name: kind(**values[name]) for name, kind in parts.items()}})
    return None


def show_state(group: bpy.types.PropertyGroup, state: SceneState | GaussiansState | CountState) -> None:
    """Set the properties of `scene.fruitlangs.result` that a state has."""
    for field in dataclasses.fields(state):
        setattr(group, field.name, getattr(state, field.name))
