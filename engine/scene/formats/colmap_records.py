"""Checks of the records in COLMAP's model files, before pycolmap reads them.

pycolmap trusts the counts in the files: a truncated points3D.bin makes it hang and a truncated cameras.bin loads
without an error. Layouts: https://colmap.github.io/format.html; rigs and frames as COLMAP ≥ 3.12 writes them.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from ...errors import SceneError
from ..pycolmap_import import colmap_library

_QUATERNION = struct.Struct("<4d")
_COUNT = struct.Struct("<Q")
_SENSOR = 8  # int32 type, uint32 id
_POSE = 56  # 7 float64
_POINT2D = 24  # 2 float64, int64

MODEL_FILES = ("cameras", "images", "points3D")
RIG_FILES = ("rigs", "frames")


def check_records(path: Path) -> int:
    """The number of records in a model file, `.bin` or `.txt`, after checking the length or line of each.

    Raises:
        SceneError: the file cannot be read, is cut short, goes on after its last record, or has a malformed line.
    """
    try:
        return (_check_binary if path.suffix == ".bin" else _check_text)(path)
    except OSError as error:
        raise SceneError(f"{path} cannot be read ({error.strerror}). Check its permissions") from error


def _check_binary(path: Path) -> int:
    """Read through all records of a binary file."""
    content = path.read_bytes()
    walk = _WALKS[path.stem]
    try:
        (count,) = _COUNT.unpack_from(content, 0)
        end = walk(content, count, path)
    except (struct.error, IndexError):
        end = len(content) + 1
    if end > len(content):
        raise SceneError(
            f"{path} is cut short: it has {len(content)} bytes and its records need at least {end}. "
            "Copy the file again or export the model again"
        )
    if end < len(content):
        raise SceneError(
            f"{path} has {len(content)} bytes but its {count} records end at byte {end}. "
            "Copy the file again or export the model again"
        )
    return count


def _walk_cameras(content: bytes, count: int, path: Path) -> int:
    at = 8
    for _ in range(count):
        camera_id, model = struct.unpack_from("<Ii", content, at)
        at += 24 + 8 * _parameter_count(model, f"{path}: camera {camera_id}")
        if at > len(content):
            break
    return at


@cache
def _parameter_counts() -> dict[int | str, int]:
    """Number of parameters of every camera model of pycolmap, by id and by name."""
    pycolmap = colmap_library()

    counts: dict[int | str, int] = {}
    for name, model in pycolmap.CameraModelId.__members__.items():
        if int(model.value) >= 0:
            parameters = pycolmap.Camera(model=name, width=2, height=2, params=[]).params_info.split(",")
            counts[int(model.value)] = counts[name] = len(parameters)
    return counts


def _parameter_count(model: int | str, where: str) -> int:
    try:
        return _parameter_counts()[model]
    except KeyError:
        names = ", ".join(str(key) for key in _parameter_counts() if isinstance(key, str))
        raise SceneError(f"{where} has the camera model {model!r}. Known are {names}") from None


def _walk_images(content: bytes, count: int, path: Path) -> int:
    at = 8
    for _ in range(count):
        name_end = content.find(b"\0", at + 64)
        if name_end < 0:
            return len(content) + 1
        _require_rotation(
            _QUATERNION.unpack_from(content, at + 4),
            path,
            f"image {content[at + 64 : name_end].decode(errors='replace')}",
        )
        (points,) = _COUNT.unpack_from(content, name_end + 1)
        at = name_end + 9 + _POINT2D * points
        if at > len(content):
            break
    return at


def _walk_points(content: bytes, count: int, path: Path) -> int:
    at, last = 8, len(content) - 8
    unpack = _COUNT.unpack_from
    for _ in range(count):
        at += 43
        if at > last:
            return at + 8
        at += 8 + 8 * unpack(content, at)[0]
    return at


def _require_rotation(quaternion: Sequence[float], path: Path, what: str) -> None:
    if not 0.0 < sum(q * q for q in quaternion) < math.inf:  # pycolmap accepts (0, 0, 0, 0) as no rotation
        raise SceneError(f"{path}: {what} has the quaternion {tuple(quaternion)}. Copy or export the model again")


def _walk_rigs(content: bytes, count: int, path: Path) -> int:
    at = 8
    for _ in range(count):
        (sensors,) = struct.unpack_from("<I", content, at + 4)
        at += 8 + (_SENSOR if sensors else 0)
        for _ in range(sensors - 1):
            at += _SENSOR + 1 + (_POSE if content[at + _SENSOR] else 0)
    return at


def _walk_frames(content: bytes, count: int, path: Path) -> int:
    at = 8
    for _ in range(count):
        (data,) = struct.unpack_from("<I", content, at + 8 + _POSE)
        _require_rotation(_QUATERNION.unpack_from(content, at + 8), path, "a frame")
        at += 12 + _POSE + (_SENSOR + 8) * data
    return at


_WALKS: dict[str, Callable[[bytes, int, Path], int]] = {
    "cameras": _walk_cameras,
    "images": _walk_images,
    "points3D": _walk_points,
    "rigs": _walk_rigs,
    "frames": _walk_frames,
}


def _check_text(path: Path) -> int:
    """Check all lines of a text file (only count those of rigs and frames)."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise SceneError(f"{path} is not a text file ({error}). Export the model again") from error
    count = 0
    check = _LINES.get(path.stem)
    numbered = iter(enumerate(lines, start=1))
    for number, line in numbered:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        count += 1
        if check is None:
            continue
        try:
            check(line.split(), path, number)
            if path.stem == "images":
                observations = next(numbered, None)
                if observations is None:
                    raise ValueError("the line of its 2D points is missing; an empty one is enough")
                number += 1
                _check_observations(observations[1].split())
        except ValueError as error:
            raise SceneError(f"{path}, line {number}: {error}. Export the model again") from error
    return count


def _check_camera(words: list[str], path: Path, number: int) -> None:
    if len(words) < 4:
        raise ValueError("expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
    parameters = _parameter_count(words[1], f"{path}, line {number}")
    if len(words) != 4 + parameters:
        raise ValueError(f"{words[1]} takes {parameters} parameters, found {len(words) - 4}")
    _numbers([words[0], *words[2:4]], int)
    _numbers(words[4:], float)


def _check_image(words: list[str], path: Path, number: int) -> None:
    if len(words) < 10:
        raise ValueError("expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
    _numbers([words[0], words[8]], int)
    _numbers(words[1:8], float)
    _require_rotation([float(word) for word in words[1:5]], path, f"line {number}, the image")


def _check_observations(words: list[str]) -> None:
    if len(words) % 3:
        raise ValueError(f"2D points are triples X Y POINT3D_ID, found {len(words)} numbers")
    _numbers(words[0::3], float)
    _numbers(words[1::3], float)
    _numbers(words[2::3], int)


def _check_point(words: list[str], path: Path, number: int) -> None:
    if len(words) < 8 or len(words) % 2:
        raise ValueError("expected POINT3D_ID X Y Z R G B ERROR and pairs IMAGE_ID POINT2D_IDX")
    _numbers([words[0], *words[4:7], *words[8:]], int)
    _numbers([*words[1:4], words[7]], float)


def _numbers(words: list[str], kind: type[int] | type[float]) -> None:
    for word in words:
        try:
            kind(word)
        except ValueError:
            raise ValueError(f"{word!r} is not {'a whole number' if kind is int else 'a number'}") from None


_LINES: dict[str, Callable[[list[str], Path, int], None]] = {
    "cameras": _check_camera,
    "images": _check_image,
    "points3D": _check_point,
}
