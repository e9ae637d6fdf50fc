"""The contact sheet: all photos in order, with those of the findings framed and labelled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from ..errors import OutputError
from ..storage.files import replace_file, require_writable
from .finding import LABELS, CheckedPhoto, PhotoCheck, Severity, photos_text

COLUMNS = 8
MARGIN, FRAME, LINE = 10, 6, 20
"""Pixels between cells, of a frame, and per line of text."""
COLOURS: dict[Severity, tuple[int, int, int]] = {"problem": (200, 30, 30), "warning": (230, 140, 0)}
_PAPER, _INK, _MISSING = (255, 255, 255), (30, 30, 30), (205, 205, 205)
_QUALITY = 85

Marks = Mapping[str, Sequence[tuple[str, Severity]]]


def write_sheet(path: Path, check: PhotoCheck) -> None:
    """Write the contact sheet as JPEG or PNG, by the file's suffix, atomically.

    Raises:
        OutputError: it cannot be written.
    """
    require_writable(path.parent)
    sheet = contact_sheet(check)
    with replace_file(path) as temporary:
        sheet.save(temporary, "PNG" if path.suffix.lower() == ".png" else "JPEG", quality=_QUALITY)


def sheet_folder(source: Path, out: Path | None = None) -> Path:
    """The folder of the contact sheet: `out`, or SOURCE-check next to the source.

    Raises:
        OutputError: it is inside the folder of the photos, where a later run would take the sheet for a photo, or the
            source is a whole drive, next to which there is nothing.
    """
    scene = source.resolve()
    if scene.suffix.lower() == ".json":
        scene = scene.parent
    if out is None and not scene.name:
        raise OutputError(f"{scene} is a whole drive. Use --out with a folder for the contact sheet")
    name = scene.stem if scene.is_file() else scene.name
    folder = scene.parent / f"{name}-check" if out is None else out.resolve()
    if scene.is_dir() and folder.is_relative_to(scene):
        raise OutputError(f"{folder} is inside the folder of the photos. Use --out with another folder")
    return folder


def contact_sheet(check: PhotoCheck) -> Image.Image:
    """All photos in name order, eight in a row: red frames for problems, orange ones for warnings."""
    marks = marks_of(check)
    columns = max(min(COLUMNS, len(check.photos)), 2)
    side = max((max(photo.thumbnail.size) for photo in check.photos if photo.thumbnail), default=160)
    height = max((photo.thumbnail.height for photo in check.photos if photo.thumbnail), default=120)
    labels = max((len(each) for each in marks.values()), default=0)
    cell = side + MARGIN + 2 * FRAME, height + MARGIN + 2 * FRAME + LINE * (1 + labels)
    rows = -(-len(check.photos) // columns)
    top = 2 * LINE
    sheet = Image.new("RGB", (MARGIN + columns * cell[0], top + rows * cell[1] + MARGIN), _PAPER)
    canvas = ImageDraw.Draw(sheet)
    canvas.text((MARGIN, MARGIN), _title(check, marks), fill=_INK, font=ImageFont.load_default(size=18))
    for index, photo in enumerate(check.photos):
        corner = MARGIN + index % columns * cell[0], top + index // columns * cell[1]
        _draw_photo(sheet, corner, (side, height), photo, marks.get(photo.name, ()))
    return sheet


def marks_of(check: PhotoCheck) -> dict[str, list[tuple[str, Severity]]]:
    """{name of a photo: its labels with their severity}."""
    marks: dict[str, list[tuple[str, Severity]]] = {}
    for finding in check.findings:
        for name in finding.photos if finding.kind in LABELS else ():
            marks.setdefault(name, []).append((LABELS[finding.kind], finding.severity))
    return marks


def _title(check: PhotoCheck, marks: Marks) -> str:
    count = photos_text(len(check.photos))
    return f"{check.folder.name}: {count}, {len(marks)} marked (red: problem, orange: warning). {check.counts}"


def _draw_photo(
    sheet: Image.Image,
    corner: tuple[int, int],
    size: tuple[int, int],
    photo: CheckedPhoto,
    labels: Sequence[tuple[str, Severity]],
) -> None:
    """Draw a photo with its frame, name and labels into its cell."""
    canvas, (left, top) = ImageDraw.Draw(sheet), corner
    picture = photo.thumbnail or Image.new("RGB", size, _MISSING)
    right, bottom = left + picture.width + 2 * FRAME, top + picture.height + 2 * FRAME
    if labels:
        severities = [severity for _, severity in labels]
        canvas.rectangle(
            [left, top, right - 1, bottom - 1], fill=COLOURS["problem" if "problem" in severities else "warning"]
        )
    sheet.paste(picture, (left + FRAME, top + FRAME))
    font = ImageFont.load_default(size=14)
    canvas.text((left + FRAME, bottom + 2), _short(photo.name), fill=_INK, font=font)
    for line, (label, severity) in enumerate(labels, start=1):
        canvas.text((left + FRAME, bottom + 2 + LINE * line), label, fill=COLOURS[severity], font=font)


def _short(name: str, most: int = 28) -> str:
    """The end of a long name, which distinguishes it."""
    return name if len(name) <= most else f"…{name[1 - most :]}"
