"""The job runner: what a control does at the moment when the job ends."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from ladarreg.jobs.runner import JobContext, JobRunner

from ladarreg_core.errors import OptionError
from ladarreg_core.project.history import Author


class Pausing(threading.Event):
    """The event of `JobContext` whose clearing pauses; the job ends in that moment."""

    def __init__(self, runner: JobRunner, ends: threading.Event) -> None:
        super().__init__()
        self._runner, self._ends = runner, ends

    def clear(self) -> None:
        self._ends.set()
        self._runner.wait(0.3)  # the job ends first if it may
        super().clear()


@pytest.mark.parametrize("action", ["pause", "step"])
def test_a_job_that_ends_while_it_is_paused_has_ended(action: str) -> None:
    published: list[str] = []
    runner = JobRunner(lambda job: published.append(job.state))
    ends = threading.Event()

    def work(context: JobContext) -> str:
        ends.wait(60)
        return "Done."

    can: Any = ("pause", "step")
    runner.start("simplex", work, label="Simplex", photo="p1", author=Author("", ""), can=can)
    context = runner._context
    assert context is not None
    context._resumed = Pausing(runner, ends)
    runner.control(action)
    runner.wait(60)
    assert runner.job is not None
    assert (runner.job.state, runner.job.message) == ("done", "Done.")
    assert not runner.is_busy
    assert published[-1] == "done"
    with pytest.raises(OptionError, match="no job is running"):
        runner.control("resume")


class Gate:
    """Jobs that begin and end when a test wants, with the order in which they began."""

    def __init__(self) -> None:
        self.published: list[tuple[str, str]] = []
        self.runner = JobRunner(lambda job: self.published.append((job.id, job.state)))
        self.begun: list[str] = []
        self.ends: dict[str, threading.Event] = {}

    def start(self, kind: str, photo: str) -> str:
        name = f"{kind} {photo}"
        ends = self.ends[name] = threading.Event()

        def work(context: JobContext) -> str:
            self.begun.append(name)
            while not ends.wait(0.01):
                context.check()
            return "Done."

        return self.runner.start(kind, work, label=name, photo=photo, author=Author("", ""))

    def end(self, *names: str) -> None:
        for name in names:
            self.ends[name].set()


def test_jobs_on_other_photographs_wait_and_none_is_stopped_for_them() -> None:
    gate = Gate()
    first = gate.start("auto", "p1")
    second, third = gate.start("auto", "p2"), gate.start("verify", "p1")
    assert [job.id for job in gate.runner.waiting] == [second, third]
    assert gate.runner.job is not None
    assert (gate.runner.job.id, gate.runner.job.state) == (first, "running")
    gate.end("auto p2", "verify p1", "auto p1")
    gate.runner.wait(60)
    assert gate.begun == ["auto p1", "auto p2", "verify p1"]
    ended = [(job, state) for job, state in gate.published if state in ("done", "stopped")]
    assert ended == [(first, "done"), (second, "done"), (third, "done")]


def test_the_same_job_on_the_same_photograph_replaces_the_former_one() -> None:
    gate = Gate()
    first = gate.start("auto", "p1")
    gate.start("auto", "p2")
    waiting = gate.start("verify", "p2")
    again = gate.start("verify", "p2")
    assert [job.label for job in gate.runner.waiting] == ["auto p2", "verify p2"]
    assert gate.runner.waiting[1].id == again
    assert gate.published[-2:] == [(waiting, "stopped"), (again, "waiting")]
    anew = gate.start("auto", "p1")  # the running one is stopped, and this one goes before those that wait
    assert (first, "stopped") in gate.published
    assert gate.runner.job is not None
    assert (gate.runner.job.id, gate.runner.job.state) == (anew, "running")
    assert len(gate.runner.waiting) == 2
    gate.end("auto p1", "auto p2", "verify p2")
    gate.runner.wait(60)
    assert gate.begun == ["auto p1", "auto p1", "auto p2", "verify p2"]


def test_a_job_that_waits_can_be_taken_back_and_closing_begins_none() -> None:
    gate = Gate()
    gate.start("auto", "p1")
    second, third = gate.start("auto", "p2"), gate.start("auto", "p3")
    with pytest.raises(OptionError, match="only be stopped"):
        gate.runner.control("pause", job=second)
    gate.runner.control("stop", job=second)
    assert [job.id for job in gate.runner.waiting] == [third]
    with pytest.raises(OptionError, match="ended"):
        gate.runner.control("stop", job=second)
    gate.runner.close()
    assert gate.begun == ["auto p1"]
    assert not gate.runner.is_busy
    assert (third, "stopped") in gate.published


def test_so_many_jobs_may_wait() -> None:
    gate = Gate()
    for number in range(51):
        gate.start("auto", f"p{number}")
    with pytest.raises(OptionError, match="50 jobs are waiting"):
        gate.start("auto", "p100")
    gate.runner.close()
