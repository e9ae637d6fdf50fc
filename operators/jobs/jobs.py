"""Long work of an operator: in a thread with progress and Cancel in a window, synchronously in background mode.

The thread runs engine functions only. bpy is used on the main thread only: before the work starts
(`JobOperator.prepare`) and after it has ended (`JobOperator.finish`).
"""

from __future__ import annotations

import gc
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import bpy

from ...engine.errors import Cancelled, FruitLangsError
from ...engine.progress import Progress, duration, silent
from ..blender_data import areas_of, find_edited_object
from .active_tool import end_waiting
from .preload import preload_libraries
from .target_scene import Target

REDRAW_SECONDS = 0.25
"""Seconds between two redraws; more frequent ones slow down the work."""

LEAST_FRACTION, LEAST_SECONDS = 0.03, 3.0
"""Progress and duration of a job above which the remaining time is shown."""

ROUNDING = 5
"""Remaining seconds are shown in multiples of this."""

LEAVE_EDITING = "Leave Edit Mode first (Tab)"
LINKED = "This scene is linked from another file. Make it local first"

Work = Callable[[Progress], Any]


class Job:
    """A function that runs in a thread, with its state for panels."""

    def __init__(self, title: str, work: Work) -> None:
        self.title = title
        self.fraction = 0.0
        self.message = "starting"
        self.started = time.monotonic()
        self.result: Any = None
        self.error: BaseException | None = None
        self.cancelling = False
        self._work = work
        self._thread = threading.Thread(target=self._run, name=f"fruitlangs {title}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def cancel(self) -> None:
        """Ask the work to stop, which it does at its next progress report."""
        self.cancelling = True

    def wait(self, seconds: float) -> None:
        """Wait for the end of the thread, at most this long."""
        self._thread.join(seconds)

    @property
    def ended(self) -> bool:
        return not self._thread.is_alive()

    @property
    def remaining(self) -> float | None:
        """Estimated remaining seconds; None if unknown."""
        if self.ended or self.fraction < LEAST_FRACTION or self.seconds < LEAST_SECONDS:
            return None
        return self.seconds * (1.0 - self.fraction) / self.fraction

    @property
    def text(self) -> str:
        """The progress as text: 'step 300/1200, 41,000 Gaussians, about 2 min left'."""
        if self.cancelling:
            return "stopping at the next safe point"
        return (
            self.message
            if self.remaining is None
            else f"{self.message}, about {duration(self.remaining, ROUNDING)} left"
        )

    @property
    def shown(self) -> tuple[int, str, int, bool]:
        """The state that a panel shows: a redraw is needed when it changes."""
        return int(100 * self.fraction), self.text, int(self.seconds), self.cancelling

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self.started

    def _store_progress(self, fraction: float, message: str) -> None:
        if self.cancelling:
            raise Cancelled
        self.fraction, self.message = fraction, message

    def _run(self) -> None:
        try:
            with limit_garbage_collection():
                preload_libraries()
                self.result = self._work(self._store_progress)
        except BaseException as error:  # any error: the main thread reports it
            self.error = error


@contextmanager
def limit_garbage_collection() -> Iterator[None]:
    """Limit Python's garbage collection to young objects.

    A full collection stops the window for half a second while kernels are compiled for the first time.
    """
    young, middle, full = gc.get_threshold()
    gc.set_threshold(young, middle, 1_000_000)
    try:
        yield
    finally:
        gc.set_threshold(young, middle, full)


# A thread cannot be stored in a .blend, so the running job is kept here. It is kept until its thread has ended, even
# if its file was closed, because two jobs must never run at once.
_current: Job | None = None
# The operator that shows it in a window, until it takes the result over.
_shower: JobOperator | None = None


def find_running_job() -> Job | None:
    """Return the running job, or one whose result is not shown yet, if any."""
    global _current
    if _current is not None and _current.ended and _shower is None:
        _current = None
    return _current


def is_busy(operator: Any) -> bool:
    """Whether a job is running; the operator's poll shows that as the reason."""
    if find_running_job() is None:
        return False
    operator.poll_message_set("Another job is running. Wait for it or cancel it first")
    return True


def is_linked(operator: Any, context: bpy.types.Context) -> bool:
    """Whether the scene is linked from another file and cannot be changed; the operator's poll shows that as the
    reason."""
    if context.scene is None or context.scene.library is None:
        return False
    operator.poll_message_set(LINKED)
    return True


def is_being_edited(operator: Any, context: bpy.types.Context) -> bool:
    """Whether the user edits an object that a result replaces; the operator's poll shows that as the reason."""
    item = None if context.scene is None else find_edited_object(context.scene)
    if item is None:
        return False
    operator.poll_message_set(f"{_describe_edited(item)}. Return to Object Mode first")
    return True


def _describe_edited(item: bpy.types.Object) -> str:
    """Say 'Gaussians is in Edit Mode'."""
    return f"{item.name} is in {item.mode.replace('_', ' ').title()} Mode"


def is_editing(operator: Any, context: bpy.types.Context) -> bool:
    """Whether Blender is not in Object Mode or there is no scene of this file; the operator's poll shows that as the
    reason."""
    if is_linked(operator, context):
        return True
    if context.scene is not None and context.mode == "OBJECT":
        return False
    operator.poll_message_set(LEAVE_EDITING)
    return True


def cancel_running(wait: float = 0.0) -> None:
    """Ask the running job to stop and wait up to this many seconds for it."""
    job = find_running_job()
    if job is not None:
        job.cancel()
        job.wait(wait)


def release_job(wait: float) -> None:
    """Stop the job and remove what shows it: Blender does not notify an operator when its class is unregistered."""
    cancel_running(wait)
    if _shower is not None:
        _shower._leave(bpy.context)


def is_user_busy(context: bpy.types.Context) -> bool:
    """Whether the user drags something or renders, and objects must not change."""
    if bpy.app.is_job_running("RENDER"):
        return True
    modal = [item for window in context.window_manager.windows for item in getattr(window, "modal_operators", ())]
    return any(part.bl_idname.startswith("TRANSFORM_OT_") for item in modal for part in (item, *item.macros))


def start(operator: Any, name: str, **properties: Any) -> set[str]:
    """Start `fruitlangs.name` like a button does, from the `execute` of an operator that shows why it cannot start."""
    try:
        getattr(bpy.ops.fruitlangs, name)("INVOKE_DEFAULT", **properties)
    except RuntimeError as error:
        operator.report({"ERROR"}, str(error).rpartition(".poll() ")[2].removeprefix("Error: ").strip())
        return {"CANCELLED"}
    return {"FINISHED"}


def describe_error(error: BaseException) -> str:
    """One line for the user; an unexpected error is also printed in full to the console."""
    if isinstance(error, FruitLangsError):
        return str(error)
    if isinstance(error, ImportError):
        return f"A Python package is missing or broken: {error}. The Fruit tab says how to install what is needed"
    if isinstance(error, MemoryError):
        return "Out of memory. Use smaller photos (downscale) or fewer Gaussians"
    traceback.print_exception(error)
    return f"Unexpected {type(error).__name__}: {error}. The system console has the details. Please report it"


class JobOperator:
    """Mix-in of operators with long work.

    `execute` (scripts, background mode) runs to the end before it returns; `invoke` in a window starts a thread, and a
    modal timer shows its progress. A failure is an error report, which scripts get as RuntimeError, and {'CANCELLED'}.
    `self._target` is the Blender scene it works for, whatever happens in the meantime.
    """

    title = ""
    replaces_objects = False
    """Whether the result replaces objects of this extension, so that it waits while the user edits one of them."""
    _target: Target
    _job: Any = None
    _asked = False

    def prepare(self, context: bpy.types.Context) -> Work:
        """Read the settings and return the work; called on the main thread. May raise FruitLangsError.

        The work imports the engine itself: that takes seconds, which the thread can spend.
        """
        raise NotImplementedError

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        """Show the result; called on the main thread."""
        raise NotImplementedError

    def store_failure(self: Any, context: bpy.types.Context, message: str) -> None:
        """Store the message where a panel shows it; called on the main thread, '' when work starts or succeeded."""
        bpy_scene = self._target.find()
        if bpy_scene is not None:
            bpy_scene.fruitlangs.error = message
            bpy_scene.fruitlangs.failed = self.title if message else ""

    def update_display(self, context: bpy.types.Context) -> None:
        """Called a few times a second on the main thread during the work, to show its current state."""

    def clear_display(self, context: bpy.types.Context) -> None:
        """Called when the work has ended, before `finish`: remove what `update_display` showed."""

    def ask_where(self: Any, context: bpy.types.Context) -> set[str]:
        """Open Blender's file dialog, which calls `execute` when a path was chosen; return value of an `invoke`."""
        self._asked = True
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self: Any, context: bpy.types.Context) -> set[str]:
        if self._asked:  # when started again, the operator works in a thread
            name = type(self).bl_idname.partition(".")[2]
            return start(self, name, **self.as_keywords(ignore=("check_existing", "filter_glob")))
        self._begin(context)
        try:
            self.finish(context, self.prepare(context)(silent))
        except Exception as error:
            return self._report_failure(context, error)
        return {"FINISHED"}

    def invoke(self: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        global _current, _shower
        if bpy.app.background:
            return self.execute(context)
        other = find_running_job()
        if other is not None:
            self.report({"WARNING"}, f"{other.title} is still running. Wait for it or cancel it first")
            return {"CANCELLED"}
        self._begin(context)
        try:
            self._job = Job(self.title, self.prepare(context))
        except Exception as error:
            return self._report_failure(context, error)
        self._shown: Any = None
        _current, _shower = self._job, self
        self._job.start()
        self._timer = context.window_manager.event_timer_add(REDRAW_SECONDS, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def _begin(self, context: bpy.types.Context) -> None:
        """Forget the last failure, and end the tool that waits for clicks: the job replaces what they would hit."""
        self._target = Target(context.scene)
        self.store_failure(context, "")
        end_waiting()

    def modal(self: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC" and event.value == "PRESS" and not self._job.ended:
            self._job.cancel()
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if not self._job.ended:
            if self._job.shown != self._shown:
                self._shown = self._job.shown
                redraw_sidebars(context)
                show_status(context, f"{self.title} {self._job.fraction:.0%}: {self._job.text}. Esc cancels")
            self.update_display(context)
            return {"PASS_THROUGH"}
        if is_user_busy(context) or self._waits_for_editing(context):
            return {"PASS_THROUGH"}
        self._leave(context)
        return self._conclude(context)

    def _waits_for_editing(self: Any, context: bpy.types.Context) -> bool:
        """Whether the user edits an object that the result replaces; panel and status bar say so."""
        bpy_scene = self._target.find()
        item = None if bpy_scene is None or not self.replaces_objects else find_edited_object(bpy_scene)
        if item is None or self._job.error is not None:
            return False
        if self._job.cancelling:
            self._job.error = Cancelled()
            return False
        message = f"finished. {_describe_edited(item)}: return to Object Mode to see the result"
        if self._job.message != message:
            self._job.fraction, self._job.message = 1.0, message
            redraw_sidebars(context)
            show_status(context, f"{self.title} {message}")
        return True

    def cancel(self: Any, context: bpy.types.Context) -> None:
        """Called by Blender when the file or the window is closed: the result cannot be shown.

        Also called when the file dialog that some open first is cancelled: then there is no job yet.
        """
        if self._job is not None:
            self._job.cancel()
            self._leave(context)

    def _leave(self: Any, context: bpy.types.Context) -> None:
        """Remove what the running job showed."""
        global _shower
        _shower = None
        redraw_sidebars(context)
        show_status(context, None)
        context.window_manager.event_timer_remove(self._timer)
        self.clear_display(context)

    def _conclude(self: Any, context: bpy.types.Context) -> set[str]:
        job = self._job
        if isinstance(job.error, Cancelled):
            self.report({"INFO"}, f"{job.title} cancelled. Finished stages are kept")
            return {"CANCELLED"}
        if job.error is not None:
            return self._report_failure(context, job.error)
        try:
            self.finish(context, job.result)
            self.store_failure(context, "")  # an undo in the meantime may have restored an old message
        except Exception as error:
            return self._report_failure(context, error)
        return {"FINISHED"}

    def _report_failure(self: Any, context: bpy.types.Context, error: BaseException) -> set[str]:
        message = describe_error(error)
        self.store_failure(context, message)
        self.report({"ERROR"}, message)
        return {"CANCELLED"}


class FRUITLANGS_OT_cancel(bpy.types.Operator):
    bl_idname = "fruitlangs.cancel"
    bl_label = "Cancel"
    bl_description = "Stop the job; finished stages and the last checkpoint are kept"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return find_running_job() is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        cancel_running()
        return {"FINISHED"}


def show_status(context: bpy.types.Context, text: str | None) -> None:
    """Show it in the status bar, if there is one.

    None restores Blender's own text, in every workspace, since the user may have switched to another one.
    """
    if context.workspace is None:
        return
    for workspace in [context.workspace] if text is not None else bpy.data.workspaces:
        with context.temp_override(workspace=workspace):
            workspace.status_text_set(text)


def redraw_sidebars(context: bpy.types.Context) -> None:
    """Redraw only the sidebars of the 3D viewports."""
    for _, area in areas_of(context, "VIEW_3D"):
        for region in area.regions:
            if region.type == "UI":
                region.tag_redraw()


CLASSES = (FRUITLANGS_OT_cancel,)
