"""The photo of a Blender camera: its file and its lens.

A camera stores them in custom properties, so that a saved .blend needs neither the scene's model nor its reader.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import bpy

from ...engine.errors import SceneError
from ..blender_data import OWNER
from ..settings.settings import PHOTO_FILE, format_stored_path, resolve_known_path

if TYPE_CHECKING:
    from ...engine.scene.camera import Camera, Photo
    from ...engine.scene.photos.photo import FilePhoto

PHOTO, FILE, LENS, SIZE, ASPECT = "photo", PHOTO_FILE, "photo_lens", "photo_size", "pixel_aspect"
"""Custom properties of a camera: name and file of its photo, its lens if the file is distorted, the camera's width and
height in pixels, and fx / fy."""
UNREAD = (".heic", ".heif")
"""Suffixes of photos that Blender does not read: they are shown as a copy."""
LONGEST = 2048
"""Longest side of an undistorted picture in pixels: the user waits for it."""
NEAR_BLEND = 2
"""Folders above the .blend in which a moved photo is searched."""


def keep_photo(item: bpy.types.Object, camera: Camera, photo: Photo | None) -> None:
    """Store in a camera what is needed to find and show its photo later."""
    item[PHOTO] = "" if photo is None else photo.name
    item[SIZE] = [camera.width, camera.height]
    item[ASPECT] = float(camera.K[0, 0] / camera.K[1, 1])
    for key in (FILE, LENS):
        item.pop(key, None)
    path = getattr(photo, "path", None)
    if path is None:
        return
    found: Any = photo
    item[FILE] = format_stored_path(path.absolute())
    if not found.is_as_stored or path.suffix.lower() in UNREAD:
        lens = found.lens
        item[LENS] = json.dumps(
            {
                "model": lens.model,
                "params": list(lens.params),
                "calibrated": [lens.width, lens.height],
                "size": [found.width, found.height],
                "face": found.face,
                "turn": None if found.turn is None else int(found.turn),
            }
        )


def has_photo(item: bpy.types.Object | None) -> bool:
    """Whether an object is a camera of ours that was created with its photo."""
    return item is not None and item.get("fruitlangs") == "camera" and bool(item.get(FILE)) and SIZE in item


def photo_path(item: bpy.types.Object) -> Path:
    """The file of a camera's photo; one that was moved together with the .blend or the scene's folder is found.

    Raises:
        SceneError: the camera was made without one, or it is not there (any more).
    """
    if not item.get(FILE):
        raise SceneError(f"There was no photo for the camera {item.name}. Import the scene again with its photos")
    kept = resolve_known_path(item[FILE])
    if kept is not None and kept.is_file():
        return kept
    kept = kept or Path(item[FILE])
    parts = [part for part in kept.parts[1:] if part != ".."]
    tails = [PurePath(*parts[start:]) for start in range(len(parts))]
    found = next((base / tail for base in _list_bases() for tail in tails if (base / tail).is_file()), None)
    if found is None:
        raise SceneError(
            f"The photo {kept.name} is no longer in {kept.parent}. Put it back, or move its folder next to the .blend"
        )
    return found


def _list_bases() -> list[Path]:
    """List the folders in which moved photos are searched."""
    found = []
    if bpy.data.filepath:
        folder = Path(bpy.data.filepath).parent
        found += [folder, *list(folder.parents)[:NEAR_BLEND]]
    sources = {scene.fruitlangs.source for scene in bpy.data.scenes if hasattr(scene, "fruitlangs")}
    return found + [folder for folder in map(resolve_known_path, sorted(sources)) if folder is not None]


def provide_viewed_file(item: bpy.types.Object) -> Path:
    """Return a picture of what the camera shows: the photo's own file, or an undistorted copy in Blender's temporary
    folder.

    Raises:
        SceneError: the photo is gone or cannot be decoded.
        ImportError: undistorting needs a package that is not installed.
    """
    made = _name_viewed_file(item)
    if not made.is_file():
        prepare_undistortion(item)()
    return made


def find_ready_file(item: bpy.types.Object) -> Path | None:
    """Do as `provide_viewed_file` if that takes no time; return None if `prepare_undistortion` must be called first.

    Raises:
        SceneError: the photo is gone.
    """
    made = _name_viewed_file(item)
    return made if made.is_file() else None


def prepare_undistortion(item: bpy.types.Object) -> Callable[[], None]:
    """Return the function that makes the picture that the camera sees; any thread may call it.

    Raises (both this and what is returned):
        SceneError: the photo is gone or cannot be decoded.
        ImportError: a package is not installed.
    """
    photo, made = _open_photo(item, photo_path(item)), _name_viewed_file(item)
    return lambda: _write_undistorted(photo, made)


def _name_viewed_file(item: bpy.types.Object) -> Path:
    path = photo_path(item)
    if LENS not in item:
        return path
    text = f"{path} {path.stat().st_mtime_ns} {item[LENS]}"
    return Path(bpy.app.tempdir) / f"fruitlangs_{hashlib.sha256(text.encode()).hexdigest()[:16]}.png"


def _open_photo(item: bpy.types.Object, path: Path) -> FilePhoto:
    """Open the photo as the scene reader reads it, no larger than `LONGEST`."""
    from PIL import Image

    from ...engine.scene.photos.lens import Lens
    from ...engine.scene.photos.photo import FilePhoto, read_header

    kept = json.loads(item[LENS])
    width, height = kept["size"]
    # The view of a smaller copy has the same frame: its K follows the resize exactly.
    shrunk = max(max(width, height) / LONGEST, 1.0)
    return FilePhoto(
        name=item[PHOTO],
        path=path,
        header=read_header(path),
        lens=Lens(kept["model"], tuple(kept["params"]), *kept["calibrated"]),
        width=round(width / shrunk),
        height=round(height / shrunk),
        face=kept["face"],
        turn=None if kept["turn"] is None else Image.Transpose(kept["turn"]),
    )


def _write_undistorted(photo: FilePhoto, made: Path) -> None:
    from PIL import Image

    part = made.with_suffix(".part.png")
    try:
        Image.fromarray(photo.pixels()).save(part, compress_level=1)
        part.replace(made)
    except OSError as error:
        raise SceneError(f"The undistorted copy {made} cannot be written ({error}). Free some space there") from error


def remove_backgrounds(items: Iterable[bpy.types.Object]) -> None:
    """Remove our photos from these cameras and from memory."""
    for item in items:
        slots = item.data.background_images
        for slot in [slot for slot in slots if slot.image is not None and slot.image.get(OWNER) == "photo"]:
            image, slot.image = slot.image, None  # removing the slot alone would keep a user of the picture
            slots.remove(slot)
            if image.users == 0:
                bpy.data.images.remove(image)
