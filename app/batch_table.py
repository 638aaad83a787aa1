"""The progress of a batch on stderr: a live table on a terminal, plain lines elsewhere, nothing if quiet."""

from __future__ import annotations

import sys
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Protocol, TextIO

from .messages import one_line

if TYPE_CHECKING:
    from types import TracebackType

    from ladarreg_core.batches.jobs.run import BatchProgress

_MAX_LINES = 8
_STYLES = {"accepted": "green", "refused": "yellow", "failed": "red"}


class BatchTable(Protocol):
    """A context manager that receives the progress of a batch."""

    def __enter__(self) -> BatchTable:
        """Show it."""
        ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Remove it."""
        ...

    def show(self, progress: BatchProgress) -> None:
        """Show the progress."""
        ...


def batch_table(*, quiet: bool, stream: TextIO | None = None) -> BatchTable:
    """Return the kind of display that suits the stream; None: stderr."""
    out = stream or sys.stderr
    if quiet:
        return _Silent()
    return _Live(out) if out.isatty() else _Lines(out)


def time_left(progress: BatchProgress, seconds: float) -> str:
    """Return how long the rest will take at the pace so far; empty while there is none.

    Args:
        progress: of the batch.
        seconds: since this run began.
    """
    here, left = progress.done - progress.resumed, progress.total - progress.done
    if here <= 0 or left <= 0:
        return ""
    minutes, second = divmod(round(seconds / here * left), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours} h {minute:02} min" if hours else f"{minute} min {second:02} s" if minute else f"{second} s"


class _Silent:
    def __enter__(self) -> BatchTable:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        return None

    def show(self, progress: BatchProgress) -> None:
        """Ignore it."""


class _Lines(_Silent):
    def __init__(self, out: TextIO) -> None:
        self._out, self._remark, self._done = out, "", -1
        self._started = time.monotonic()

    def show(self, progress: BatchProgress) -> None:
        """Print a line for each job that was done, and what the batch waits for."""
        if progress.remark != self._remark:
            self._remark = progress.remark
            if self._remark:
                print(f"Waiting: {one_line(self._remark)}", file=self._out, flush=True)
        if progress.done != self._done and progress.label:
            first, self._done = self._done < 0, progress.done
            if first and progress.resumed:
                print(f"{progress.resumed} of {progress.total} jobs are done already", file=self._out, flush=True)
            elif not first:
                left = time_left(progress, time.monotonic() - self._started)
                rest = f", {left} left" if left else ""
                print(f"{one_line(progress.label)} ({progress.done} of {progress.total}{rest})", file=self._out,
                      flush=True)  # fmt: skip


class _Live(_Silent):
    def __init__(self, out: TextIO) -> None:
        from rich.console import Console
        from rich.live import Live

        self._lines: deque[str] = deque(maxlen=_MAX_LINES)
        self._started, self._done = time.monotonic(), -1
        self._live = Live(console=Console(file=out), transient=True, auto_refresh=False)

    def __enter__(self) -> BatchTable:
        self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._live.stop()

    def show(self, progress: BatchProgress) -> None:
        """Show the counts, the time left, and the jobs that were done last."""
        if progress.label and progress.done > max(self._done, progress.resumed):
            self._lines.append(one_line(progress.label))
        self._done = progress.done
        self._live.update(self._table(progress), refresh=True)

    def _table(self, progress: BatchProgress) -> Any:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, padding=(0, 2, 0, 0), show_edge=False)
        for name in ("done", *_STYLES, "time left"):
            table.add_column(name, justify="right", style=_STYLES.get(name, ""), header_style="dim")
        counts = [str(progress.outcomes.get(name, 0)) for name in _STYLES]  # type: ignore[call-overload]
        left = time_left(progress, time.monotonic() - self._started)
        table.add_row(f"{progress.done} of {progress.total}", *counts, left)
        parts: list[Any] = [table, ProgressBar(total=max(1, progress.total), completed=progress.done, width=60)]
        if progress.remark:
            parts.append(Text(one_line(progress.remark), style="yellow"))
        parts += [Text(line, style="dim", no_wrap=True, overflow="ellipsis") for line in self._lines]
        return Group(*parts)
