"""The panel's settings as engine values: Blender properties from a config dataclass, and the inverse.

A setting is declared once, in `engine/config.py`; the string below its field is the tooltip here and the help text of
the command line's flag.
"""

from __future__ import annotations

import dataclasses
import os
import types
import typing
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy

from ...engine.errors import FruitLangsError, SceneError, VocabularyError
from ...engine.scene.video.frames import VIDEO_SUFFIXES
from ...engine.setting import LARGEST, field_docs, path_kind, range_of
from .preference_values import add_preferred_folders
from .region import limit_to_region
from .source_mark import has_mark

if TYPE_CHECKING:
    from ...engine.config import Config


# Blender 4.5 asks for it before it shows paths relative to the .blend; older ones do not need it.
RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else set()
SUBTYPES = {"file": "FILE_PATH", "folder": "DIR_PATH"}
"""Option of the property of a setting that is a path."""
PLY = ".ply"
"""Suffix of a file of Gaussians or coloured points."""
SCENE_FILES = (PLY, *sorted(VIDEO_SUFFIXES))
"""Suffixes of files that are a scene."""
PHOTO_FILE, PHOTO_PROBLEM = "photo_file", "photo_problem"
"""Custom properties of a camera: the file of its photo, from `format_stored_path`, and why it is not shown."""
MEASURES = {
    "scene": ("up",),
    "units": ("length", "points", "cameras", "object", "metres_per_unit"),
    "count": ("diameter", "box", "polygon", "heights", "tree_places"),
}
"""{stage: settings} that are valid in the frame of one source only."""


def make_config_properties(config_class: type, updates: Mapping[str, Callable[..., None]] = {}) -> dict[str, Any]:
    """Return {field: Blender property} of a config dataclass, in its order; updates: {field: update callback}.

    If None is allowed, 0 or an empty text represents it; several texts are one text with commas, and a list of numbers
    of any length is typed as text.
    """
    docs, kinds = field_docs(config_class), typing.get_type_hints(config_class)
    return {
        field.name: _make_property(kinds[field.name], field, docs.get(field.name, ""), updates.get(field.name))
        for field in dataclasses.fields(config_class)
    }


def config_from(group: bpy.types.PropertyGroup, config_class: type) -> Any:
    """The config of a group made by `make_config_properties`.

    Raises:
        ConfigError: a value makes no sense.
        SceneError: a path is relative to a .blend never saved.
    """
    kinds = typing.get_type_hints(config_class)
    values = {field.name: getattr(group, field.name) for field in dataclasses.fields(config_class)}
    for name in values:
        if _is_texts(kinds[name]):
            values[name] = tuple(read_words(values[name]))
    for name in path_names(config_class):
        if values[name].startswith("//"):
            values[name] = str(_make_absolute(values[name]))
    missing = {name for name, value in values.items() if _is_optional(kinds[name]) and _is_zero(value)}
    typed = {name: value.replace(",", " ").split() for name, value in values.items() if _is_list(kinds[name])}
    plain = {name: _to_plain(value) for name, value in values.items()}
    return config_class(**{**plain, **typed, **dict.fromkeys(missing)})


def path_names(config_class: type) -> list[str]:
    """The settings of a config dataclass that are paths."""
    return [field.name for field in dataclasses.fields(config_class) if path_kind(field)]


def _is_zero(value: Any) -> bool:
    """Whether the property of an optional setting has the value that means "not given"."""
    return not any(value) if isinstance(value, bpy.types.bpy_prop_array) else not value


def _to_plain(value: Any) -> Any:
    if isinstance(value, bpy.types.bpy_prop_array):
        return tuple(map(_to_plain, value))
    # A property holds float32; its shortest text is what the user typed, so 0.2 stays 0.2 as on the command line.
    return float(f"{value:.7g}") if isinstance(value, float) else value


def _is_optional(kind: Any) -> bool:
    return typing.get_origin(kind) in (types.UnionType, typing.Union) and type(None) in typing.get_args(kind)


def _unwrap_optional(kind: Any) -> Any:
    """Return the type of an optional setting."""
    return next(choice for choice in typing.get_args(kind) if choice is not type(None)) if _is_optional(kind) else kind


def _is_texts(kind: Any) -> bool:
    """Whether a setting is a list of texts, optional or not."""
    given = _unwrap_optional(kind)
    return typing.get_origin(given) is tuple and set(typing.get_args(given)) == {str}


def _is_list(kind: Any) -> bool:
    """Whether a field holds numbers of any length."""
    return any(Ellipsis in typing.get_args(choice) for choice in (kind, *typing.get_args(kind)))


def _make_property(
    kind: Any, field: dataclasses.Field[Any], doc: str, update: Callable[..., None] | None = None
) -> Any:
    """Make the Blender property for one field."""
    words = field.name.replace("_", " ").title()
    named: dict[str, Any] = {
        "name": words.replace("Ssim", "SSIM").replace("Sh ", "SH "),
        "description": doc.rstrip("."),
        "update": update,
    }
    if _is_optional(kind):
        kind = _unwrap_optional(kind)
        typed = kind is str or _is_texts(kind) or _is_list(kind)
        named["description"] += " (empty means not given)" if typed else " (0 means not given)"
        default: Any = field.default or kind()
    else:
        default = field.default
    if typing.get_origin(kind) is typing.Literal:
        items = [(choice, choice.replace("-", " ").capitalize(), "") for choice in typing.get_args(kind)]
        return bpy.props.EnumProperty(items=items, default=default, **named)
    if _is_texts(kind):
        return bpy.props.StringProperty(default=", ".join(default), **named)
    if _is_list(kind):
        return bpy.props.StringProperty(default=" ".join(map(str, default)), **named)
    if typing.get_origin(kind) is tuple:
        size = len(typing.get_args(kind))
        return bpy.props.FloatVectorProperty(size=size, default=default or (0.0,) * size, precision=3, **named)
    if kind is bool:
        return bpy.props.BoolProperty(default=default, **named)
    if kind in (int, float):
        allowed = range_of(field)
        bounds = {} if allowed is None else {"min": kind(allowed.low), "max": kind(min(allowed.high, LARGEST))}
        if kind is int:
            return bpy.props.IntProperty(default=default, **bounds, **named)
        return bpy.props.FloatProperty(default=default, precision=3, **bounds, **named)
    path = path_kind(field)
    if path is not None:
        return bpy.props.StringProperty(default=default, subtype=SUBTYPES[path], options=RELATIVE, **named)
    if kind is str or kind is Path:
        return bpy.props.StringProperty(default=str(default), **named)
    raise TypeError(f"{field.name}: no Blender property for {kind}")


def read_config(settings: Any, source: Path | None = None) -> Config:
    """The configs of all stages from `scene.fruitlangs`, with counting limited to the region box of the scene; nothing
    is downloaded if Blender may not go online. For a run on another `source`, measurements of this one are left out.

    Raises:
        ConfigError: a value makes no sense.
    """
    from ...engine.config import Config

    config = Config(
        **{name: config_from(getattr(settings.config, name), kind) for name, kind in stage_classes().items()}
    )
    embed = add_preferred_folders(config.embed)
    consent = embed.allow_download and is_online()
    config = dataclasses.replace(config, embed=dataclasses.replace(embed, allow_download=consent))
    if source is not None and is_of_another(settings, source):
        return _remove_measures(config)
    return dataclasses.replace(config, count=limit_to_region(settings.id_data, config.count))


def list_given_settings(settings: Any) -> set[str]:
    """List the names ("train.steps") of the panel's settings that were set, whatever their value."""
    return {
        f"{stage}.{field.name}"
        for stage, kind in stage_classes().items()
        for field in dataclasses.fields(kind)
        if getattr(settings.config, stage).is_property_set(field.name)
    }


def _remove_measures(config: Config) -> Config:
    """Return the config without `MEASURES`."""
    usual = type(config)()
    stages = {}
    for stage, names in MEASURES.items():
        values = {name: getattr(getattr(usual, stage), name) for name in names}
        stages[stage] = dataclasses.replace(getattr(config, stage), **values)
    return dataclasses.replace(config, **stages)


def is_online() -> bool:
    """Whether Blender allows online access."""
    return bpy.app.online_access


def apply_preset(settings: Any, _context: Any = None) -> None:
    """Set the training properties of `scene.fruitlangs` to those of its preset."""
    from ...engine.config import PRESETS

    for field in dataclasses.fields(PRESETS["standard"]):
        value = getattr(PRESETS[settings.preset], field.name)
        if value == field.default:
            settings.config.train.property_unset(field.name)  # so that it does not count as given
        else:
            setattr(settings.config.train, field.name, value)


def stage_classes() -> dict[str, type]:
    """{stage: config class} in the order of the stages."""
    from ...engine.config import Config

    kinds = typing.get_type_hints(Config)
    return {field.name: kinds[field.name] for field in dataclasses.fields(Config)}


def read_words(text: str) -> list[str]:
    """'apple, red apple' → ['apple', 'red apple']."""
    return [word.strip() for word in text.split(",") if word.strip()]


def read_prompts(settings: Any) -> list[str]:
    """The prompts.

    Raises:
        VocabularyError: none was given.
    """
    prompts = read_words(settings.prompt)
    if not prompts:
        raise VocabularyError("The prompt is empty: type what to count, for example apple")
    return prompts


def source_folder(settings: Any) -> Path:
    """The scene's folder, a video, or a .ply to count in, absolute.

    Raises:
        SceneError: none was chosen, it is relative to a .blend never saved, or it does not exist (any more).
    """
    if not settings.source:
        raise SceneError("No scene is chosen. Choose a folder of photos, a video or a .ply")
    folder = _make_absolute(settings.source)
    if not folder.is_dir() and not (folder.suffix.lower() in SCENE_FILES and folder.is_file()):
        raise SceneError(f"The scene {folder} does not exist. Choose it again")
    return folder


def resolve_imported_file(settings: Any) -> Path | None:
    """Return the .ply that replaces training, absolute; None without one.

    Raises:
        SceneError: it does not exist (any more).
    """
    if not settings.gaussians:
        return None
    file = _make_absolute(settings.gaussians)
    if not file.is_file():
        raise SceneError(f"The file {file} does not exist. Choose it again, or empty the field to train")
    return file


def result_folder(settings: Any) -> Path:
    """The result folder: as set, else that of an earlier run on this source, else next to the .blend, else, for an
    unsaved .blend, next to the scene's."""
    if settings.out:
        return _make_absolute(settings.out)
    source = _make_absolute(settings.source) if settings.source else Path("scene")
    earlier = resolve_known_path(settings.result.work)
    if earlier is not None and earlier.is_dir() and not is_of_another(settings, source):
        return earlier
    beside = Path(bpy.data.filepath).parent if bpy.data.filepath else source.parent
    return beside / f"{source.stem if source.suffix.lower() in SCENE_FILES else source.name}_fruit"


def find_true_source(source: Path) -> Path:
    """Return the source of an earlier result, or `source` itself if it is not a result."""
    from ...engine.result_folder import ResultFolder

    earlier = ResultFolder(source)
    if earlier.holds_result():
        with suppress(FruitLangsError):
            return earlier.source(earlier.read(verify=False))
    return source


def is_of_another(settings: Any, source: Path) -> bool:
    """Whether the shown data, decisions and measurements belong to another source; False if their source is unknown."""
    known = resolve_known_path(settings.result.source)
    return known is not None and not is_same_source(known, settings.result.mark, source)


def is_same_source(known: Path, mark: str, source: Path) -> bool:
    """Whether the scene at `source` is the one at `known`: made from it, or its folder, which was moved, kept its name
    and matches its mark."""
    true = find_true_source(source)
    return known == true or (known.name == true.name and not known.exists() and has_mark(true, mark))


def resolve_known_path(text: str) -> Path | None:
    """Return a path from `format_stored_path`, absolute; None if there is none, or if it is relative to an unsaved
    .blend."""
    return None if not text or (text.startswith("//") and not bpy.data.filepath) else _make_absolute(text)


def resolve_stored_file(text: str) -> Path:
    """Return a path from `format_stored_path`, absolute.

    Raises:
        SceneError: it is relative to a .blend never saved.
    """
    return _make_absolute(text)


def _make_absolute(text: str) -> Path:
    if text.startswith("//") and not bpy.data.filepath:
        raise SceneError(f"The folder {text} is relative to this .blend, which was never saved. Choose it again")
    return Path(bpy.path.abspath(text)).resolve()


def format_stored_path(path: Path) -> str:
    """Write a path as stored in the .blend: relative to it if it was saved and is on the same drive."""
    return make_relative_path(path, Path(bpy.data.filepath).parent) if bpy.data.filepath else str(path)


def make_relative_path(path: Path, folder: Path) -> str:
    """Return `path` relative to a .blend in `folder`; absolute on another drive, and where symbolic links would lead a
    relative path elsewhere."""
    target = path.resolve()
    for found, start in ((target, folder.resolve()), (path, folder)):
        try:
            text = str(bpy.path.relpath(str(found), start=str(start)))
        except ValueError:  # another drive
            break
        steps = folder / text.removeprefix("//")
        if steps.resolve() == target == Path(os.path.normpath(steps)).resolve():
            return text
    return str(path)


def is_on_another_drive(text: str) -> bool:
    """Whether a path of the panel cannot be relative to the saved .blend."""
    return bool(text and bpy.data.filepath) and not format_stored_path(_make_absolute(text)).startswith("//")
