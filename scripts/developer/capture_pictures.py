"""Draw the pictures of docs/capture.md with the orchard generator: a good and a bad way to take the photos.

    python scripts/developer/capture_pictures.py --out docs/images/capture

Each picture shows the camera positions from above, with the numbered photos next to them. Needs bpy and about two
minutes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent)]

import _checkout  # noqa: F401

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from _terminal import arguments_of, report, run
from fruitlangs.orchard.blender.render import prepare, render_view
from fruitlangs.orchard.blender.stage import set_stage
from fruitlangs.orchard.cameras.camera_path import distance_from_row
from fruitlangs.orchard.cameras.shake import apply_shake
from fruitlangs.orchard.cameras.viewpoint import Viewpoint, look_at
from fruitlangs.orchard.config import OrchardConfig
from fruitlangs.orchard.planting import Orchard, plant
from fruitlangs.orchard.srgb import from_linear, to_linear

CONFIG = OrchardConfig(species="apple", variant="red", seed=7, samples=8)
PHOTO, PLAN, SCALE = (240, 180), 400, 2
"""Pixels of a photo and of the view from above on the page; they are rendered larger by this factor."""
STEP = 8.0
"""Degrees between the photos of a good walk."""
GREEN, RED, INK, PAPER = (20, 120, 60), (200, 30, 30), (30, 30, 30), (255, 255, 255)
MARGIN, TEXT = 12, 22
_QUALITY = 84

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Shot:
    """A photo of a walk: its angle around the tree in degrees, its distance as a share of the usual one, and what is
    wrong with it, in words and as a change of its pixels."""

    angle: float
    distance: float = 1.0
    fault: str = ""
    change: Callable[[Pixels], Pixels] | None = None


def darken(pixels: Pixels) -> Pixels:
    """Keep a third of the light."""
    return np.rint(255 * from_linear(to_linear(pixels / 255.0) / 3.0)).astype(np.uint8)


def shake(pixels: Pixels) -> Pixels:
    return apply_shake(pixels, np.array([14.0, 5.0]))


GOOD = [Shot(angle=STEP * number) for number in range(6)]
BAD = [
    Shot(angle=0.0),
    Shot(angle=STEP, fault="blurred", change=shake),
    Shot(angle=2 * STEP),
    Shot(angle=2 * STEP + 75.0, fault="after a gap"),
    Shot(angle=3 * STEP + 75.0, fault="exposure jump", change=darken),
    Shot(angle=4 * STEP + 75.0, fault="too close", distance=0.5),
]
GAPS = {"good": [], "bad": [(2 * STEP, 2 * STEP + 75.0)]}


def viewpoint(orchard: Orchard, shot: Shot) -> Viewpoint:
    """The camera of a shot, at eye height."""
    low, high = orchard.place.crown
    middle = (low + high) / 2
    usual = 1.15 * distance_from_row(orchard.species, orchard.place)
    turn = np.radians(shot.angle - 90.0)
    position = middle + shot.distance * usual * np.array([np.cos(turn), np.sin(turn), 0.0])
    width, height = SCALE * PHOTO[0], SCALE * PHOTO[1]
    focal = 0.68 * height * usual / (high - low)[2]
    return Viewpoint(name="shot", focal=focal, width=width, height=height, world_to_camera=look_at(position, middle))


def look_from_above(orchard: Orchard) -> Viewpoint:
    """Return a view straight down that contains all positions."""
    middle, usual = orchard.place.crown.mean(axis=0), 1.15 * distance_from_row(orchard.species, orchard.place)
    height, side = 8.0 * usual, SCALE * PLAN
    above = middle + [0.0, -1e-3, height]  # a little to the south: north is up
    focal = side / 2 / (1.3 * usual) * height
    return Viewpoint(name="plan", focal=focal, width=side, height=side, world_to_camera=look_at(above, middle))


def draw_walk(
    name: str, orchard: Orchard, shots: Sequence[Shot], render: Callable[[Viewpoint], Image.Image]
) -> Image.Image:
    """The positions from above, and the photos with their numbers."""
    page = Image.new("RGB", (PLAN + 3 * (PHOTO[0] + MARGIN) + 2 * MARGIN, PLAN + 2 * MARGIN + TEXT), PAPER)
    plan = look_from_above(orchard)
    page.paste(_draw_positions(render(plan), plan, orchard, name, shots), (MARGIN, MARGIN))
    canvas, font = ImageDraw.Draw(page), ImageFont.load_default(size=15)
    for number, shot in enumerate(shots):
        row, column = divmod(number, 3)
        left = 2 * MARGIN + PLAN + column * (PHOTO[0] + MARGIN)
        top = MARGIN + row * (PHOTO[1] + TEXT + MARGIN)
        pixels = np.asarray(render(viewpoint(orchard, shot)))
        picture = Image.fromarray(pixels if shot.change is None else shot.change(pixels))
        page.paste(picture.resize(PHOTO, Image.Resampling.LANCZOS), (left, top))
        if shot.fault:
            canvas.rectangle([left, top, left + PHOTO[0] - 1, top + PHOTO[1] - 1], outline=RED, width=4)
        text = f"{number + 1} {shot.fault}".strip()
        canvas.text((left, top + PHOTO[1] + 3), text, fill=RED if shot.fault else INK, font=font)
    return page


def _draw_positions(
    ground: Image.Image, plan: Viewpoint, orchard: Orchard, name: str, shots: Sequence[Shot]
) -> Image.Image:
    """Draw the view from above with a dot per photo of the walk; those shown are numbered."""
    canvas, font = ImageDraw.Draw(ground), ImageFont.load_default(size=13 * SCALE)

    def place(shot: Shot) -> tuple[float, float]:
        x, y = plan.project(viewpoint(orchard, shot).position[None])[0][0]
        return float(x), float(y)

    def dot(shot: Shot, radius: float, colour: tuple[int, int, int], text: str = "") -> None:
        x, y = place(shot)
        box = [x - radius, y - radius, x + radius, y + radius]
        canvas.ellipse(box, fill=colour, outline=PAPER, width=SCALE)
        canvas.text((x, y), text, fill=PAPER, font=font, anchor="mm")

    angles = np.arange(0.0, 360.0, STEP)
    for start, end in GAPS[name]:
        angles = angles[(angles < start) | (angles > end)]
        middle = place(Shot(angle=(start + end) / 2))
        canvas.text(middle, "gap", fill=PAPER, stroke_fill=RED, stroke_width=3 * SCALE, font=font, anchor="mm")
    shown = [shot.angle for shot in shots]
    for angle in angles[[min(abs(angle - each) for each in shown) > 0.6 * STEP for angle in angles]]:
        dot(Shot(angle=float(angle)), 5 * SCALE, GREEN)
    for number, shot in enumerate(shots, start=1):
        dot(shot, 9 * SCALE, RED if shot.fault else GREEN, str(number))
    return ground.resize((PLAN, PLAN), Image.Resampling.LANCZOS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images/capture"), help="folder of the pictures")
    out = parser.parse_args(arguments_of(__file__)).out
    out.mkdir(parents=True, exist_ok=True)
    orchard = plant(CONFIG)
    with tempfile.TemporaryDirectory() as folder:
        set_stage(orchard)
        prepare(CONFIG, Path(folder), report)

        def render(view: Viewpoint) -> Image.Image:
            import bpy

            scene = bpy.context.scene
            scene.render.resolution_x, scene.render.resolution_y = view.width, view.height
            path = Path(folder) / "view.jpg"
            render_view(view, path, Path(folder), orchard.ground, seed=CONFIG.seed)
            return Image.open(path).convert("RGB")

        for name, shots in (("good", GOOD), ("bad", BAD)):
            draw_walk(name, orchard, shots, render).save(out / f"{name}.jpg", quality=_QUALITY, optimize=True)
            report(f"{out / name}.jpg")


if __name__ == "__main__":
    run(main)
