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
