"""What tests and benchmarks of batches share."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

from ladarreg_core.batches.jobs.work import JobTask

NOT_COMPARED = {"manifest.jsonl", "timing.json", ".ladarreg-manifest.json"}
"""Of the folder of a batch itself: the order in which jobs ended, and their times."""


class Here(Executor):
    """Does tasks at once, in this process; `change` gets each function first."""

    def __init__(self, change: Callable[[Callable[..., Any], JobTask], Any] = lambda do, task: do(task)) -> None:
        self.change, self.tasks = change, []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.tasks.append(args[0])
        try:
            future.set_result(self.change(fn, *args))
        except Exception as error:
            future.set_exception(error)
        return future


def contents(folder: Path) -> dict[str, bytes]:
    found = {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    return {name: data for name, data in found.items() if name not in NOT_COMPARED}
