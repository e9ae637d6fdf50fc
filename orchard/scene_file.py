"""Scenes as TOML files: the settings of an `OrchardConfig`, one per line, and optionally the scene that they extend."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from .check import check_types
from .config import OrchardConfig
from .errors import OrchardError

PRESETS = Path(__file__).resolve().parents[1] / "benchmarks" / "scenes"
"""The scenes of the project; they can be given by name."""


@dataclass(frozen=True, kw_only=True)
class SceneFile:
    """A scene file with everything that it extends."""

    name: str
    about: str
    """The purpose of the scene, in one line; the file's own `about`."""
    values: dict[str, object]
    """Settings by name; missing ones keep their defaults."""

    @property
    def config(self) -> OrchardConfig:
        """The settings of the scene, not yet checked against each other."""
        return OrchardConfig(**{k: v for k, v in self.values.items()})  # type: ignore[arg-type]


def find_scene(name: str, beside: Path | None = None) -> Path:
    """The file of a name or path: first as a path, also relative to another scene file, then as a preset.

    Raises:
        OrchardError: there is no such file and no such preset.
    """
    bare = name if name.endswith(".toml") else f"{name}.toml"
    places = [beside / bare if beside else Path(bare), PRESETS / bare]
    for place in places:
        if place.is_file():
            return place
    raise OrchardError(f"Scene {name} cannot be found: give a TOML file, or a name that --list prints")


def read_scene(path: Path, extended: tuple[Path, ...] = ()) -> SceneFile:
    """Read a scene file; `extended` are the files that extend it.

    Raises:
        OrchardError: the file cannot be read, is no TOML, names an unknown setting or one of the wrong kind, or extends
            itself.
    """
    if path.resolve() in extended:
        raise OrchardError(f"{path} extends itself: take the line extends out of one of the files")
    try:
        values: dict[str, object] = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise OrchardError(f"{path} cannot be read ({error.strerror}): name another scene file") from error
    except ValueError as error:
        raise OrchardError(f"{path} is no TOML ({error}): correct it") from error
    about, base = values.pop("about", ""), values.pop("extends", "")
    for key, word in (("about", about), ("extends", base)):
        if not isinstance(word, str):
            raise OrchardError(f"{path}: {key} is {word!r}: give a text in quotes")
    check_types(values, str(path))
    if base:
        trail = (*extended, path.resolve())
        values = {**read_scene(find_scene(str(base), path.parent), trail).values, **values}
    return SceneFile(name=path.stem, about=str(about), values=values)


def presets() -> list[SceneFile]:
    """Every scene of the project, by name."""
    return [read_scene(path) for path in sorted(PRESETS.glob("*.toml"))]
