from __future__ import annotations

import gc
import threading
from types import SimpleNamespace

import bpy
import pytest

from fruitlangs.engine.errors import Cancelled, SceneError
from fruitlangs.operators.blender_data import find_owned_objects
from fruitlangs.operators.jobs import jobs
from fruitlangs.operators.steps.show_result import show_result


@pytest.fixture
def started(monkeypatch):
    """Start a job as an operator in a window does; it is cancelled at the end."""
    begun = []

    def start(work):
        job = jobs.Job("Count", work)
        monkeypatch.setattr(jobs, "_current", job)
        job.start()
        begun.append(job)
        return job

    yield start
    for job in begun:
        job.cancel()
        job.wait(5)
        assert job.ended


def test_a_job_reports_progress_and_keeps_its_result(started):
    job = started(lambda progress: (progress(0.5, "half"), 42)[1])
    job.wait(5)
    assert (job.fraction, job.message, job.result, job.error) == (0.5, "half", 42, None)


def test_a_job_runs_in_a_thread_of_its_own(started):
    job = started(lambda progress: threading.current_thread())
    job.wait(5)
    assert job.result is not threading.main_thread()


def test_cancel_stops_at_the_next_report(started):
    asked = threading.Event()

    def work(progress):
        asked.wait(5)
        progress(0.1, "on")
        raise AssertionError("went on after cancel")

    job = started(work)
    assert jobs.find_running_job() is job
    job.cancel()
    asked.set()
    job.wait(5)
    assert isinstance(job.error, Cancelled)
    assert jobs.find_running_job() is None


@pytest.mark.parametrize("fails", [False, True])
def test_while_a_job_runs_garbage_is_looked_for_among_young_objects_alone(started, fails):
    def work(progress):
        meanwhile.append(gc.get_threshold())
        if fails:
            raise SceneError("gone")

    before, meanwhile = gc.get_threshold(), []
    started(work).wait(5)
    ((*young, full),) = meanwhile
    assert young == list(before[:2])
    assert full >= 1_000_000
    assert gc.get_threshold() == before


def test_a_job_is_not_forgotten_before_its_thread_ends(started):
    hold = threading.Event()
    job = started(lambda progress: hold.wait(5))
    jobs.cancel_running(wait=0.01)
    assert jobs.find_running_job() is job
    hold.set()
    job.wait(5)
    assert jobs.find_running_job() is None


class Shower(jobs.JobOperator):
    """An operator that shows a job in a window."""

    title = "Count"

    def __init__(self, job):
        self._job, self._shown, self._timer, self._target = job, None, None, jobs.Target(bpy.context.scene)
        self.finished, self.has_left = [], False

    def finish(self, context, result):
        self.finished.append(result)

    def store_failure(self, context, message):
        assert not message

    def clear_display(self, context):
        self.has_left = True


@pytest.fixture
def window(monkeypatch):
    """A context with one window, in which `window.modal_operators` run, and no job is shown afterwards."""
    shown = SimpleNamespace(modal_operators=[], screen=SimpleNamespace(areas=[]))
    manager = SimpleNamespace(windows=[shown], event_timer_remove=lambda timer: None)
    shown.context = SimpleNamespace(window_manager=manager, workspace=None)
    monkeypatch.setattr(jobs, "_shower", None)
    return shown


def modal(name, *parts):
    """A running operator of Blender; the parts of a macro are operators too."""
    return SimpleNamespace(bl_idname=name, macros=[modal(part) for part in parts])


def shower(started, monkeypatch):
    """An operator whose job has ended."""
    job = started(lambda progress: 42)
    job.wait(5)
    item = Shower(job)
    monkeypatch.setattr(jobs, "_shower", item)
    return item


TICK = SimpleNamespace(type="TIMER", value="NOTHING")


@pytest.mark.parametrize(
    "dragging", [modal("TRANSFORM_OT_translate"), modal("OBJECT_OT_duplicate_move", "TRANSFORM_OT_translate")]
)
def test_a_result_waits_for_the_end_of_a_drag(started, window, monkeypatch, dragging):
    item = shower(started, monkeypatch)
    window.modal_operators = [modal("FRUITLANGS_OT_count"), dragging]
    assert item.modal(window.context, TICK) == {"PASS_THROUGH"}
    assert not item.finished
    assert jobs.find_running_job() is item._job
    window.modal_operators.pop()
    assert item.modal(window.context, TICK) == {"FINISHED"}
    assert item.finished == [42]
    assert jobs.find_running_job() is None


def test_a_result_waits_for_the_end_of_a_render(started, window, monkeypatch):
    item = shower(started, monkeypatch)
    asked = []
    app = SimpleNamespace(is_job_running=lambda kind: asked.append(kind) or len(asked) == 1)
    monkeypatch.setattr(jobs, "bpy", SimpleNamespace(app=app, context=bpy.context))
    assert item.modal(window.context, TICK) == {"PASS_THROUGH"}
    assert item.modal(window.context, TICK) == {"FINISHED"}
    assert asked == ["RENDER"] * 2


@pytest.fixture
def edited_points(extension, counted):
    """Sparse points of ours, in Edit Mode."""
    from fruitlangs.operators.data.write_points import write_points
    from fruitlangs.operators.data.write_root import write_root

    item = write_points(bpy.context.scene, counted.scene, write_root(bpy.context.scene, counted.scene))
    bpy.context.view_layer.objects.active = item
    bpy.ops.object.mode_set(mode="EDIT")
    return item


def test_a_result_waits_while_an_object_that_it_replaces_is_edited(started, window, monkeypatch, edited_points):
    item = shower(started, monkeypatch)
    item.replaces_objects = True
    assert item.modal(window.context, TICK) == {"PASS_THROUGH"}
    assert item._job.text == "finished. Sparse points is in Edit Mode: return to Object Mode to see the result"
    assert item._job.fraction == 1.0
    assert item.modal(window.context, SimpleNamespace(type="ESC", value="PRESS")) == {"PASS_THROUGH"}
    assert not item.finished
    bpy.ops.object.mode_set(mode="OBJECT")
    assert item.modal(window.context, TICK) == {"FINISHED"}
    assert item.finished == [42]


def test_a_result_that_waits_for_an_edit_can_be_cancelled(started, window, monkeypatch, edited_points):
    item, told = shower(started, monkeypatch), []
    item.replaces_objects, item.report = True, lambda _, text: told.append(text)
    assert item.modal(window.context, TICK) == {"PASS_THROUGH"}
    jobs.cancel_running()
    assert item.modal(window.context, TICK) == {"CANCELLED"}
    assert (item.finished, told) == ([], ["Count cancelled. Finished stages are kept"])


def test_a_result_that_replaces_nothing_does_not_wait_for_an_edit(started, window, monkeypatch, edited_points):
    assert shower(started, monkeypatch).modal(window.context, TICK) == {"FINISHED"}


@pytest.mark.parametrize("name", ["import_scene", "reconstruct", "count", "open_block", "update_block"])
@pytest.mark.parametrize("mode", ["EDIT", "SCULPT"])
def test_what_replaces_objects_refuses_while_one_is_edited(edited_points, tmp_path, name, mode):
    settings = bpy.context.scene.fruitlangs
    settings.source = str(tmp_path)
    settings.block.trees.add()
    bpy.ops.object.mode_set(mode=mode)
    with pytest.raises(RuntimeError, match=f"Sparse points is in {mode.title()} Mode. Return to Object Mode first"):
        getattr(bpy.ops.fruitlangs, name)()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert getattr(bpy.ops.fruitlangs, name).poll()


def test_a_mesh_of_the_user_in_edit_mode_does_not_stop_an_import(extension):
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.fruitlangs.import_scene.poll()


class Counting(Shower):
    """An operator that shows a count in the Blender scene that it works for, and waits for `hold` before it has one."""

    store_failure = jobs.JobOperator.store_failure

    def __init__(self, started, result):
        self.hold, self.told = threading.Event(), []
        super().__init__(started(lambda progress: (self.hold.wait(5), progress(0.5, "half"), result)[2]))

    def finish(self, context, result):
        show_result(bpy.context, self._target.scene(bpy.context), result)

    def report(self, level, text):
        self.told.append(text)

    def end(self, context):
        """Let the work end, and give the operator the tick that comes after it."""
        self.hold.set()
        self._job.wait(5)
        return self.modal(context, TICK)


@pytest.fixture
def counting(extension, started, window, monkeypatch, counted, result_of, tmp_path):
    """A count at work in a window."""
    item = Counting(started, result_of(counted, tmp_path))
    monkeypatch.setattr(jobs, "_shower", item)
    yield item
    item.hold.set()


def fruit_shown() -> int:
    return sum(len(find_owned_objects(scene, "fruit")) for scene in bpy.data.scenes)


def test_esc_stops_the_job_at_its_next_report_and_nothing_is_shown(counting, window):
    assert counting.modal(window.context, SimpleNamespace(type="A", value="PRESS")) == {"PASS_THROUGH"}
    assert not counting._job.cancelling
    assert counting.modal(window.context, SimpleNamespace(type="ESC", value="PRESS")) == {"RUNNING_MODAL"}
    assert counting.modal(window.context, TICK) == {"PASS_THROUGH"}
    assert counting.end(window.context) == {"CANCELLED"}
    assert counting.told == ["Count cancelled. Finished stages are kept"]
    assert jobs.find_running_job() is None
    assert fruit_shown() == 0


def test_what_is_undone_while_a_job_runs_takes_nothing_of_its_result(counting, window):
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.ed.undo_push(message="Add Cube")
    bpy.ops.ed.undo()
    assert "Cube" not in bpy.data.objects
    assert counting.end(window.context) == {"FINISHED"}
    assert fruit_shown() == bpy.context.scene.fruitlangs.result.count == 3


def test_another_file_opened_while_a_job_runs_gets_nothing_of_its_result(counting, window, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"), copy=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "other.blend"))
    assert counting.end(window.context) == {"CANCELLED"}
    assert counting.told == ["The scene Scene was deleted or closed. The results are in the results folder"]
    assert fruit_shown() == 0
    assert bpy.context.scene.fruitlangs.error == ""


def test_a_closed_window_cancels_its_job_which_is_not_forgotten_before_its_thread_ends(counting, window):
    counting.cancel(window.context)
    assert counting.has_left
    assert jobs.find_running_job() is counting._job
    assert not bpy.ops.fruitlangs.import_scene.poll()
    counting.hold.set()
    counting._job.wait(5)
    assert isinstance(counting._job.error, Cancelled)
    assert jobs.find_running_job() is None
    assert bpy.ops.fruitlangs.import_scene.poll()


def test_a_closed_file_dialog_has_no_job_to_cancel(window):
    jobs.JobOperator().cancel(window.context)
    assert jobs.find_running_job() is None


def test_disabling_the_extension_stops_the_job_and_takes_away_what_shows_it(extension, started, window, monkeypatch):
    asked = threading.Event()
    job = started(lambda progress: asked.wait(5) and progress(0.1, "on"))
    item = Shower(job)
    item._timer = bpy.context.window_manager.event_timer_add(1.0, window=bpy.context.window)
    monkeypatch.setattr(jobs, "_shower", item)
    asked.set()
    extension.unregister()
    assert item.has_left
    assert job.ended
    assert jobs.find_running_job() is None


class Asking(jobs.JobOperator):
    """An operator whose file dialog was answered."""

    bl_idname = "fruitlangs.import_scene"
    _asked = True

    def __init__(self):
        self.reports = []

    def as_keywords(self, ignore):
        return {"directory": "/nowhere/at/all/"}

    def report(self, level, text):
        self.reports.append((level, text))


def test_what_fails_after_the_file_dialog_is_reported_in_words(extension):
    item = Asking()
    assert item.execute(bpy.context) == {"CANCELLED"}
    ((level, text),) = item.reports
    assert level == {"ERROR"}
    assert text.startswith("The scene /nowhere")


def test_a_job_begun_while_the_file_dialog_was_open_is_reported(extension, started):
    hold = threading.Event()
    started(lambda progress: hold.wait(5))
    item = Asking()
    assert item.execute(bpy.context) == {"CANCELLED"}
    hold.set()
    assert item.reports == [({"ERROR"}, "Another job is running. Wait for it or cancel it first")]


def test_errors_are_described_in_plain_words(capsys):
    assert jobs.describe_error(SceneError("no photos")) == "no photos"
    assert "torch" in jobs.describe_error(ModuleNotFoundError("No module named 'torch'"))
    assert capsys.readouterr().err == ""


def test_an_unforeseen_error_is_named_and_printed_in_full(capsys):
    assert "ZeroDivisionError" in jobs.describe_error(ZeroDivisionError("x"))
    assert "ZeroDivisionError: x" in capsys.readouterr().err
