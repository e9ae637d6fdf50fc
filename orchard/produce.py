"""One scene from configuration to files, view by view, resumable."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .blender.render import Passes, picture_pixels, prepare, render_view
from .blender.stage import dress, set_stage
from .cameras.camera_path import plan_views
from .cameras.close_ups import plan_close_ups
from .cameras.poses import disturb
from .cameras.shake import sample_shake
from .cameras.viewpoint import Viewpoint
from .classes import CLASSES, FRUIT
from .config import GENERATOR_VERSION, OrchardConfig
from .errors import OrchardError
from .files import png, sparse, truth
from .files.nerfstudio import write_nerfstudio
from .planting import Orchard, plant

Report = Callable[[str], None]


LAYOUTS = ("colmap", "nerfstudio")


def produce(
    config: OrchardConfig, out: Path, *, classes: bool, preview: int = 0, layout: str = "colmap", report: Report
) -> None:
    """Generate, render and describe one orchard into `out`.

    Pictures of an earlier run with the same configuration are kept. With `preview`, only this many views, spread along
    the path, are made. `classes` adds classes/ and classes.json, and the layout nerfstudio its own files.

    Raises:
        OrchardError: `out` contains other files, or cannot be written.
    """
    _claim(config, out)
    if _is_complete(out, classes=classes):
        report(f"{out}: already complete")
    else:
        _make(config, out, classes=classes, preview=preview, report=report)
    if layout == "nerfstudio":
        write_nerfstudio(out)


def _make(config: OrchardConfig, out: Path, *, classes: bool, preview: int, report: Report) -> None:
    orchard = plant(config)
    views = plan_viewpoints(orchard)
    if preview:
        views = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, preview).astype(int))]
    passes = _render(orchard, views, out, classes=classes, report=report)
    _describe(orchard, views, passes, out)
    if classes:
        words = [config.species if word == FRUIT else word for word in CLASSES]
        _write_json(out / "classes.json", {str(i): word for i, word in enumerate(words)})
    _write_truth(orchard, views, passes, out)
    if not preview:
        shutil.rmtree(out / "cache", ignore_errors=True)
        _write_json(out / "orchard.json", {**_mark(out), "complete": True})
    report(f"{out}: complete")


def _is_complete(out: Path, *, classes: bool) -> bool:
    """Whether an earlier run of this configuration finished."""
    done = bool(_mark(out).get("complete"))
    return done and (not classes or (out / "classes.json").exists())


def _mark(out: Path) -> dict[str, Any]:
    """The content of orchard.json: the configuration of the folder, and whether its scene is complete."""
    try:
        return dict(json.loads((out / "orchard.json").read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise OrchardError(f"{out}/orchard.json is damaged ({error}): remove {out} or name another folder") from error


def _claim(config: OrchardConfig, out: Path) -> None:
    """Mark the folder as that of this configuration."""
    try:
        if (out / "orchard.json").exists():
            if _mark(out).get("digest") != config.digest():
                raise OrchardError(f"{out} holds a scene of other settings: name another folder or remove it")
            if _is_complete(out, classes=False):
                return
        elif out.exists() and any(out.iterdir()):
            raise OrchardError(f"{out} is not empty and holds no orchard: name another folder")
        for folder in ("images", "instances", "depth", "cache"):
            (out / folder).mkdir(parents=True, exist_ok=True)
        mark = {"digest": config.digest(), "generator": GENERATOR_VERSION, "config": asdict(config)}
        _write_json(out / "orchard.json", mark)
    except OSError as error:
        raise OrchardError(f"{out} cannot be used ({error.strerror}): name a folder that can be written") from error


def plan_viewpoints(orchard: Orchard) -> list[Viewpoint]:
    """Plan the cameras of the scene, generated from its seed."""
    rng = np.random.default_rng([orchard.config.seed, 20])
    if not orchard.config.close_ups:
        return plan_views(rng, orchard.config, orchard.species, orchard.place)
    bodies = [f.body for f in orchard.fruits if f.kind != "neighbour"]
    things = np.array([thing.mesh.vertices.mean(axis=0) for thing in orchard.things]).reshape(-1, 3)
    return plan_close_ups(rng, orchard.config, orchard.species, orchard.place.crown, bodies, things)


def _render(orchard: Orchard, views: Sequence[Viewpoint], out: Path, *, classes: bool, report: Report) -> list[Passes]:
    scratch = out / "cache"
    scratch.mkdir(exist_ok=True)
    missing = [v for v in views if not ((out / "images" / v.name).exists() and _name_cached(out, v).exists())]
    if missing:
        stage = set_stage(orchard)
        prepare(orchard.config, scratch, report)
    start = time.monotonic()
    for done, view in enumerate(missing, start=1):
        number = int(Path(view.name).stem)
        dress(stage, orchard, number)
        shake = _sample_shake(orchard.config, number)
        seed = orchard.config.seed * 1000 + number
        passes = render_view(view, out / "images" / view.name, scratch, orchard.ground, seed=seed, shake=shake)
        half_made = scratch / "half_made.npz"
        np.savez_compressed(half_made, fruit=passes.fruit, classes=passes.classes, depth=passes.depth)
        os.replace(half_made, _name_cached(out, view))
        pace = (time.monotonic() - start) / done
        report(f"{out.name}: view {done}/{len(missing)}, {pace:.1f} s a view")
    results = []
    for view in views:
        with np.load(_name_cached(out, view)) as file:
            results.append(Passes(fruit=file["fruit"], classes=file["classes"], depth=file["depth"]))
        stem = Path(view.name).stem
        png.write_grey(out / "instances" / f"{stem}.png", results[-1].fruit)
        (out / "depth").mkdir(exist_ok=True)
        png.write_grey(out / "depth" / f"{stem}.png", convert_to_millimetres(results[-1].depth))
        if classes:
            (out / "classes").mkdir(exist_ok=True)
            png.write_grey(out / "classes" / f"{stem}.png", results[-1].classes)
    return results


def convert_to_millimetres(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Convert depth (H, W) in metres to whole millimetres; 0 for nothing, and beyond the range of 16 bits (65.5 m)."""
    rounded = np.rint(depth * 1000.0)
    return np.where(rounded <= 65535, rounded, 0).astype(np.uint16)


def _sample_shake(config: OrchardConfig, number: int) -> NDArray[np.float64] | None:
    """Sample the camera shake in the view with this number."""
    rng = np.random.default_rng([config.seed, 22, number])
    return sample_shake(rng, config.motion_blur) if config.motion_blur > 0 else None


def _name_cached(out: Path, view: Viewpoint) -> Path:
    return out / "cache" / f"{Path(view.name).stem}.npz"


def _describe(orchard: Orchard, views: Sequence[Viewpoint], passes: Sequence[Passes], out: Path) -> None:
    """Write the COLMAP model from pictures and depths."""
    config = orchard.config
    rng = np.random.default_rng([config.seed, 30])
    pictures: list[NDArray[np.uint8]] = [picture_pixels(out / "images" / v.name) for v in views]
    cloud = sparse.sample_cloud(rng, views, [p.depth for p in passes], pictures, config.points)
    written: Sequence[Viewpoint] = views
    if config.pose_noise > 0:
        noise = np.random.default_rng([config.seed, 31])
        away = views[0].focal * orchard.species.diameter / config.fruit_pixels
        written = disturb(noise, views, degrees=config.pose_noise, distance=away)
    sparse.write_model(out / "sparse" / "0", views, cloud, written)


def _write_truth(orchard: Orchard, views: Sequence[Viewpoint], passes: Sequence[Passes], out: Path) -> None:
    config = orchard.config
    names = [v.name for v in views]
    ids = [f.id for f in orchard.fruits]
    shown = truth.measure_visibilities(views, [p.fruit for p in passes], ids, orchard.world_meshes)
    document = {
        "generator": GENERATOR_VERSION,
        "seed": config.seed,
        "species": config.species,
        "variant": orchard.variant.name,
        "metres_per_unit": 1.0,
        "views": [truth.view_record(view) for view in views],
        "fruits": [truth.fruit_record(f, config.species, v, names) for f, v in zip(orchard.fruits, shown, strict=True)],
    }
    _write_json(out / "truth.json", document)


def write_scene_list(out: Path) -> None:
    """scenes.json of a training set: the seeds of the finished scenes, so that tests never use them."""
    seeds = sorted(int(p.parent.name) for p in out.glob("*/truth.json"))
    _write_json(out / "scenes.json", {"generator": GENERATOR_VERSION, "seeds": seeds})


def _write_json(path: Path, document: object) -> None:
    half_made = path.with_name(path.name + ".part")
    half_made.write_text(json.dumps(document, indent=1) + "\n")
    os.replace(half_made, path)
