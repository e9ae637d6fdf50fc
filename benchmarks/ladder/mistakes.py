"""Pictures of the worst mistakes of a count: photos of missed, merged, double and false fruit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ...engine.evaluation.judgement import Judgement
from ...engine.evaluation.truth import Truth
from ...engine.scene.camera import Camera, Scene
from ...engine.storage.files import replace_file
from .stages import Counted

FloatArray = NDArray[np.float64]

EACH = 8
"""Number of mistakes per kind, the worst first."""
SIDE, TITLE = 150, 15
"""Pixels of the side of a crop and of the line above it."""
CROP_DIAMETERS = 4.0
TRUE, FOUND, SUBJECT = (60, 220, 90), (255, 140, 0), (255, 255, 255)


@dataclass(frozen=True, eq=False)
class _Mistake:
    """kind: of mistake; text: its measure; center (3,), diameter: of the fruit that is shown; id: of a true one, else
    0."""

    kind: str
    text: str
    center: FloatArray
    diameter: float
    id: int = 0


@dataclass(frozen=True)
class _Disc:
    """The picture of a sphere: its centre and radius in pixels."""

    u: float
    v: float
    radius: float

    def is_inside(self, camera: Camera) -> bool:
        """Whether all of it is in the frame of the camera."""
        r = self.radius
        return r <= self.u <= camera.width - r and r <= self.v <= camera.height - r


def draw_mistakes(
    path: Path,
    scene: Scene,
    truth: Truth,
    counted: Counted,
    judgement: Judgement,
    instances: Sequence[NDArray[np.uint16]] = (),
) -> None:
    """Write crops of the photos in rows: missed, merged, double and false, each in its best view.

    True visible fruit have a green circle, counted fruit an orange one. Without mistakes there is only a line of text.
    instances: (H, W) fruit ids of each view, if known: they define the best view of a true fruit.
    """
    mistakes = list(_iterate_worst(truth, counted, judgement))
    kinds = list(dict.fromkeys(mistake.kind for mistake in mistakes))
    height = max(1, len(kinds)) * (SIDE + TITLE)
    sheet = Image.new("RGB", (EACH * (SIDE + 2), height if kinds else TITLE), (20, 20, 20))
    canvas = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=11)
    if not mistakes:
        canvas.text((3, 1), "no mistakes", fill=SUBJECT, font=font)
    for row, kind in enumerate(kinds):
        for column, mistake in enumerate(mistake for mistake in mistakes if mistake.kind == kind):
            left, top = column * (SIDE + 2), row * (SIDE + TITLE)
            crop = _crop(scene, truth, counted, mistake, instances)
            title = f"{kind} {mistake.text}"
            if crop is None:
                title += ", in no view"
            else:
                sheet.paste(crop, (left, top + TITLE))
            canvas.text((left + 3, top + 1), title, fill=SUBJECT, font=font)
    with replace_file(path) as temporary:
        sheet.save(temporary)


def _iterate_worst(truth: Truth, counted: Counted, judgement: Judgement) -> Iterator[_Mistake]:
    """Yield missed and merged fruit, the most visible first; doubles and false ones, the most probable first."""
    for kind, fruits in (("missed", judgement.missed), ("merged", judgement.merged)):
        for fruit in _sort_largest(fruits, truth.visible_fractions):
            text = f"{truth.visible_fractions[fruit]:.0%} seen"
            number = 0 if truth.ids is None else int(truth.ids[fruit])
            yield _Mistake(kind, text, truth.centers[fruit], float(truth.diameters[fruit]), number)
    for kind, found in (("double", judgement.doubles), ("false", judgement.false)):
        for index in _sort_largest(found, counted.probabilities):
            text = f"p {counted.probabilities[index]:.2f}"
            yield _Mistake(kind, text, counted.centers[index], float(counted.diameters[index]))


def _sort_largest(index: NDArray[np.int64], values: FloatArray) -> NDArray[np.int64]:
    return index[np.argsort(-values[index], kind="stable")][:EACH]


def _crop(
    scene: Scene, truth: Truth, counted: Counted, mistake: _Mistake, instances: Sequence[NDArray[np.uint16]]
) -> Image.Image | None:
    """The photo around a fruit in its best view; None if no view shows it."""
    best = _find_best_view(scene.cameras, mistake, instances)
    if best is None:
        return None
    camera = scene.cameras[best]
    subject = _project_disc(camera, mistake.center, mistake.diameter)
    if subject is None:
        return None
    half = min(CROP_DIAMETERS * subject.radius, camera.width / 2, camera.height / 2)
    zoom = SIDE / (2.0 * half)
    left = float(np.clip(subject.u - half, 0.0, camera.width - 2.0 * half))
    top = float(np.clip(subject.v - half, 0.0, camera.height - 2.0 * half))
    box = (left, top, left + 2.0 * half, top + 2.0 * half)
    photo = Image.fromarray(scene.images[best].pixels())
    crop = photo.transform((SIDE, SIDE), Image.Transform.EXTENT, box, Image.Resampling.BICUBIC)
    canvas = ImageDraw.Draw(crop)
    visible = truth.visible
    rings = [
        (center, size, TRUE) for center, size in _find_near(truth.centers[visible], truth.diameters[visible], mistake)
    ]
    rings += [(center, size, FOUND) for center, size in _find_near(counted.centers, counted.diameters, mistake)]
    for center, size, color in rings:
        disc = _project_disc(camera, center, size)
        if disc is None:
            continue
        x, y, r = (disc.u - left) * zoom, (disc.v - top) * zoom, disc.radius * zoom
        canvas.ellipse([x - r, y - r, x + r, y + r], outline=color, width=2)
    x, y = (subject.u - left) * zoom, (subject.v - top) * zoom
    canvas.line([x - 4, y, x + 4, y], fill=SUBJECT)
    canvas.line([x, y - 4, x, y + 4], fill=SUBJECT)
    return crop


def _find_near(centers: FloatArray, diameters: FloatArray, mistake: _Mistake) -> list[tuple[FloatArray, float]]:
    """Find fruit within a few diameters of the mistake, so that no circle of the far side is drawn."""
    close = np.linalg.norm(centers - mistake.center, axis=1) < 3.0 * mistake.diameter
    return [(center, float(size)) for center, size in zip(centers[close], diameters[close], strict=True)]


def _find_best_view(
    cameras: Sequence[Camera], mistake: _Mistake, instances: Sequence[NDArray[np.uint16]]
) -> int | None:
    """Find the view with most pixels of a true fruit, else the one in which the disc of the fruit is largest and in
    frame."""
    if mistake.id and instances:
        pixels = [int((mask == mistake.id).sum()) for mask in instances]
        return int(np.argmax(pixels)) if max(pixels) else None
    best, largest = None, 0.0
    for view, camera in enumerate(cameras):
        disc = _project_disc(camera, mistake.center, mistake.diameter)
        if disc is not None and disc.is_inside(camera) and disc.radius > largest:
            best, largest = view, disc.radius
    return best


def _project_disc(camera: Camera, center: FloatArray, diameter: float) -> _Disc | None:
    """Project a sphere; None if it is not completely in front of the camera."""
    (u, v), z = camera.project(center)
    focal = max(camera.K[0, 0], camera.K[1, 1])
    return _Disc(float(u), float(v), float(focal * 0.5 * diameter / z)) if z > diameter else None
