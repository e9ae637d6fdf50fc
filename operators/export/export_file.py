"""What all exports share: a file dialog, a sensible file name, and the current fruit."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy

from ...engine.errors import FruitLangsError, OutputError
from ...engine.progress import Progress
from ..data.read_fruits import has_count, read_fruits
from ..data.stored_review import keep_corrections
from ..jobs.jobs import JobOperator, Work, is_busy, is_linked
from ..settings.settings import format_stored_path, result_folder

if TYPE_CHECKING:
    from ...engine.counting.fruit import FruitCount

Write = Callable[[Path, Progress], None]
"""Writes a file atomically."""
TITLE = "Export"
# Blender 4.5 asks for it before it takes paths relative to the .blend; older ones do not know it.
_PATH = {"SKIP_SAVE"} | ({"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else set())


class ExportFile(JobOperator):
    """Mix-in of operators that write one file. In a window a dialog asks for the path and a thread does the work; a
    script gives `filepath`, and the file is written when the operator returns.
    """

    title = TITLE
    suffixes: tuple[str, ...] = ()
    """Suffixes of its files; the first is added to a name without one."""

    filepath: bpy.props.StringProperty(name="File", subtype="FILE_PATH", options=_PATH, description="File to write")
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_glob: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_linked(cls, context):
            return False
        if context.scene is None or not has_count(context.scene):
            cls.poll_message_set("Count first, then export here")
            return False
        return True

    def prepare_write(self, context: bpy.types.Context, fruit_count: FruitCount) -> Write:
        """Read what else is needed from the .blend, on the main thread, and return the function that writes the file,
        on any."""
        raise NotImplementedError

    def invoke(self: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.filepath or bpy.app.background:
            return super().invoke(context, event)
        self.filepath = str(choose_default_path(context.scene, self.suffixes[0]))
        self.filter_glob = ";".join(f"*{suffix}" for suffix in self.suffixes)
        return self.ask_where(context)

    def check(self: Any, _context: bpy.types.Context) -> bool:
        """Called by the dialog at every change: the name keeps a valid suffix."""
        before = self.filepath
        if Path(before).name and not before.endswith(("/", "\\")):
            self.filepath = str(ensure_suffix(Path(before), self.suffixes))
        return bool(self.filepath != before)

    def prepare(self: Any, context: bpy.types.Context) -> Work:
        path = resolve_file(self.filepath, self.suffixes)
        notices = keep_corrections(context.scene)
        fruit_count = read_fruits(context.scene)
        write = self.prepare_write(context, fruit_count)
        self._path = path
        self._is_empty = not fruit_count.count
        empty = f": {_explain_empty(context.scene)}" if self._is_empty else ""
        self._said = "; ".join([f"Wrote {fruit_count.count} fruit to {path}{empty}", *notices])
        return lambda progress: write(path, progress)

    def finish(self: Any, context: bpy.types.Context, result: Any) -> None:
        bpy_scene = self._target.find()
        if bpy_scene is not None:
            bpy_scene.fruitlangs.result.exported = format_stored_path(self._path)
        self.report({"WARNING" if self._is_empty else "INFO"}, self._said)


def _explain_empty(bpy_scene: bpy.types.Scene) -> str:
    """Say why there is no fruit to export."""
    shown = bpy_scene.fruitlangs.result
    if shown.count > 0:
        return f"none of the {shown.count} counted fruit is left after the review"
    return str(shown.zero_reason) or "no fruit are shown"


def resolve_file(text: str, suffixes: tuple[str, ...]) -> Path:
    """Return the file that the user chose, absolute.

    Raises:
        OutputError: none was chosen, it is a folder, or relative to a .blend never saved.
    """
    if not text:
        raise OutputError("No file is chosen. Choose a file")
    if text.startswith("//") and not bpy.data.filepath:
        raise OutputError(f"{text} is relative to this .blend, which was never saved. Choose the file again")
    path = Path(bpy.path.abspath(text)).absolute()
    if text.endswith(("/", "\\")) or path.is_dir():
        raise OutputError(f"{path} is a folder. Add a file name")
    return ensure_suffix(path, suffixes)


def ensure_suffix(path: Path, suffixes: tuple[str, ...]) -> Path:
    """Return the path with the first of the suffixes, unless it has one of them."""
    return path if path.suffix.lower() in suffixes else path.with_name(path.name + suffixes[0])


def choose_default_path(bpy_scene: bpy.types.Scene, suffix: str) -> Path:
    """Choose the default path of an export: next to the .blend, else next to the results."""
    if bpy.data.filepath:
        opened = Path(bpy.data.filepath)
        return opened.with_name(f"{opened.stem}_fruit{suffix}")
    try:
        results = result_folder(bpy_scene.fruitlangs)
    except FruitLangsError:
        return Path.home() / f"scene_fruit{suffix}"
    return results.parent / f"{results.name.removesuffix('_fruit')}_fruit{suffix}"
