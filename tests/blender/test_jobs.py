from __future__ import annotations

import gc
import threading

import pytest

from fruitlangs.engine.errors import Cancelled, SceneError
from fruitlangs.operators import jobs


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
    assert jobs.running() is job
    job.cancel()
    asked.set()
    job.wait(5)
    assert isinstance(job.error, Cancelled)
    assert jobs.running() is None


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
    assert jobs.running() is job
    hold.set()
    job.wait(5)
    assert jobs.running() is None


def test_errors_are_described_in_plain_words(capsys):
    assert jobs.describe_error(SceneError("no photos")) == "no photos"
    assert "torch" in jobs.describe_error(ModuleNotFoundError("No module named 'torch'"))
    assert capsys.readouterr().err == ""


def test_an_unforeseen_error_is_named_and_printed_in_full(capsys):
    assert "ZeroDivisionError" in jobs.describe_error(ZeroDivisionError("x"))
    assert "ZeroDivisionError: x" in capsys.readouterr().err
