"""Progress on stderr: a bar on a terminal, plain lines elsewhere, nothing if quiet."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Protocol, TextIO

from ladarreg_core.matching.step_labels import step_label

if TYPE_CHECKING:
    from types import TracebackType

    from ladarreg_core.foundations.progress import Progress
    from ladarreg_core.results.steps import Step

_MILESTONES = {
    "Read scan": 0.08,
    "Read photo": 0.1,
    "photo": 0.01,
    "channels": 0.4,
    "hypothesis": 0.35,
    "climb": 0.45,
    "turn": 0.4,
    "places": 0.42,
    "finish": 0.55,
    "verify": 0.58,
    "second minimum": 0.595,
    "camera": 0.585,
    "wrong poses": 0.587,
    "evidence": 0.59,
    "matches": 0.3,
    "corners": 0.2,
    "unconstrained search": 0.25,
    "constrained search": 0.3,
    "lines between matches": 0.35,
    "simplex": 0.5,
    "outliers removed": 0.55,
    "pose": 0.58,
    "starts": 0.59,
    "result": 0.6,
    "Assess": 0.6,
    "Smooth": 0.6,
}
"""Share of the usual time that has passed after each step; some steps may occur several times."""
_EXPORTS_FROM = 0.6
_LABEL_WIDTH = 28
_SECONDS_BETWEEN_LINES = 3.0


class ProgressBar(Protocol):
    """A context manager that receives the progress of a command."""

    def __enter__(self) -> ProgressBar:
        """Show the bar."""
        ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Remove the bar."""
        ...

    def step(self, step: Step) -> None:
        """Report a finished step."""
        ...

    def loading(self, progress: Progress) -> None:
        """Report the progress of reading the scan."""
        ...

    def progress(self, progress: Progress) -> None:
        """Report the progress of writing."""
        ...

    def work(self, progress: Progress) -> None:
        """Report the progress of a whole command."""
        ...


def progress_bar(*, quiet: bool, stream: TextIO | None = None) -> ProgressBar:
    """Return the kind of progress display that suits the stream; None: stderr."""
    out = stream or sys.stderr
    if quiet:
        return _Silent()
    return _Bar() if out.isatty() else _Lines(out)


class _Silent:
    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        return None

    def step(self, step: Step) -> None:
        """Ignore it."""

    def loading(self, progress: Progress) -> None:
        """Ignore it."""

    def progress(self, progress: Progress) -> None:
        """Ignore it."""

    def work(self, progress: Progress) -> None:
        """Ignore it."""


class _Lines(_Silent):
    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._label = ""
        self._said_at: float | None = None

    def step(self, step: Step) -> None:
        """Print the step with its time and figures."""
        detail = "  ".join(
            f"{key} {value}"
            for key, value in step.detail.items()
            if isinstance(value, str | int | float) and not isinstance(value, bool)
        )
        label = f"{step_label(step.name):<{_LABEL_WIDTH}}"
        print(f"{label} {step.seconds:6.2f} s  {detail}".rstrip(), file=self._out, flush=True)

    def loading(self, progress: Progress) -> None:
        """Print how much of a large file is read, every few seconds."""
        now = time.monotonic()
        if self._said_at is None:
            self._said_at = now
        elif now - self._said_at >= _SECONDS_BETWEEN_LINES and progress.total:
            self._said_at = now
            print(f"{progress.label} {progress.done / progress.total:.0%}", file=self._out, flush=True)

    def progress(self, progress: Progress) -> None:
        """Print each new label once."""
        if progress.label != self._label:
            self._label = progress.label
            print(progress.label, file=self._out, flush=True)

    def work(self, progress: Progress) -> None:
        """Print each new label with its number."""
        if progress.label != self._label:
            self._label = progress.label
            counted = f" ({progress.done} of {progress.total})" if progress.done and progress.total else ""
            print(f"{progress.label}{counted}", file=self._out, flush=True)


class _Bar(_Silent):
    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as RichProgress

        self._bar = RichProgress(
            TextColumn(f"{{task.description:<{_LABEL_WIDTH}}}"),
            BarColumn(complete_style="#5cc8ff", finished_style="#5cc8ff"),
            TimeElapsedColumn(),
            TextColumn("[dim]{task.fields[note]}"),
            console=Console(stderr=True),
            transient=True,
        )
        self._task = self._bar.add_task("starting", total=1.0, note="")
        self._steps = 0

    def __enter__(self) -> ProgressBar:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._bar.stop()

    def step(self, step: Step) -> None:
        """Advance the bar to the step's milestone."""
        self._steps += 1
        self._show(step_label(step.name), _MILESTONES.get(step.name, 0.0), f"{self._steps} steps")

    def loading(self, progress: Progress) -> None:
        """Advance the bar towards the scan's milestone."""
        share = progress.done / progress.total if progress.total else 0.0
        self._show(progress.label, _MILESTONES["Read scan"] * share, f"{share:.0%}")

    def progress(self, progress: Progress) -> None:
        """Advance the bar within the exports."""
        share = progress.done / progress.total if progress.total else 0.0
        self._show(progress.label, _EXPORTS_FROM + (1 - _EXPORTS_FROM) * share, f"{self._steps} steps")

    def work(self, progress: Progress) -> None:
        """Advance the bar to the share that is done."""
        share = progress.done / progress.total if progress.total else 0.0
        self._show(progress.label, share, f"{progress.done} of {progress.total}" if progress.total else "")

    def _show(self, label: str, share: float, note: str) -> None:
        from rich.markup import escape

        done = max(share, self._bar.tasks[0].completed)
        self._bar.update(self._task, description=escape(label)[:40], completed=done, note=note)
