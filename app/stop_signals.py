"""Signals that ask the program to stop: Ctrl-C, SIGTERM, a closed terminal."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from .exit_codes import ExitCode

if TYPE_CHECKING:
    import socket

STOP_SIGNALS: tuple[signal.Signals, ...] = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name)
)
"""SIGHUP exists on POSIX only, SIGBREAK (Ctrl-Break, a closed console) on Windows only."""
ONE_REQUEST_S = 1.0
"""Signals within this time of the first one count as the same request: `make` repeats the Ctrl-C that the terminal has
sent to all its processes, and a session that ends sends both SIGHUP and SIGTERM."""


class StopSignals:
    """Receiver of the stop signals of a server, in a thread of its own.

    The handlers raise nothing: an exception raised by a handler surfaces in whatever line is running, possibly while a
    lock is held. The interpreter writes each signal's number into a socket, and the thread reads it.
    """

    def __init__(self) -> None:
        self.first: int | None = None
        """The first signal received."""
        self._requested = threading.Event()
        self._on_second: Callable[[], object] = _report_interruption
        self._sockets: tuple[socket.socket, socket.socket] | None = None
        self._first_at = 0.0

    def listen(self) -> None:
        """Handle the stop signals until the process ends; does nothing outside the main thread."""
        import socket

        if threading.current_thread() is not threading.main_thread():
            return
        reader, writer = self._sockets = socket.socketpair()
        writer.setblocking(False)
        signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        _handle(_do_nothing)
        threading.Thread(target=self._receive, args=(reader,), name="stop signals", daemon=True).start()

    @property
    def requested(self) -> bool:
        """True if the program has been asked to stop."""
        return self._requested.is_set()

    def wait(self, seconds: float) -> bool:
        """Wait at most so many seconds, and return whether the program has been asked to stop."""
        return self._requested.wait(seconds)

    def check(self) -> None:
        """Raise if the program has been asked to stop.

        Raises:
            Cancelled: if it has.
        """
        if self.requested:
            from ladarreg_core.errors import Cancelled

            raise Cancelled

    def on_second_request(self, callback: Callable[[], object]) -> None:
        """Set the callback for a signal later than `ONE_REQUEST_S` after the first, which ends the process at once.

        Args:
            callback: called once, in a thread other than the main one; the process ends when it returns.
        """
        self._on_second = callback

    def _receive(self, reader: socket.socket) -> None:
        while numbers := reader.recv(64):
            for number in numbers:
                if number in STOP_SIGNALS:
                    self._record(number)

    def _record(self, number: int) -> None:
        if self.first is None:
            self.first, self._first_at = number, time.monotonic()
            self._requested.set()
        elif time.monotonic() - self._first_at > ONE_REQUEST_S:
            try:
                self._on_second()
            finally:
                exit_now(ExitCode.INTERRUPTED)


def interrupt_on_stop_signals() -> None:
    """Make stop signals raise KeyboardInterrupt, once for all within `ONE_REQUEST_S`."""
    last = -ONE_REQUEST_S

    def interrupt(number: int, frame: object) -> None:
        nonlocal last
        if time.monotonic() - last > ONE_REQUEST_S:
            last = time.monotonic()
            raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        _handle(interrupt)


def forget_interrupt() -> None:
    """Let the exit code of the program count after a KeyboardInterrupt that has been handled.

    If one was raised inside `exec` or `eval` of a text, as many imports use them, `python -m` would end by SIGINT
    whatever the exit code: the interpreter notes it there, and forgets it only when the next text is executed.
    """
    exec("")


def exit_now(code: int) -> None:
    """End the process without waiting for its threads."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def print_error(text: str) -> None:
    """Print a line on stderr, if that can still be written: the terminal may have been closed."""
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def _handle(handler: Callable[[int, Any], object]) -> None:
    """Install a handler for the stop signals until the interpreter has ended."""
    handled = [each for each in STOP_SIGNALS if not _is_ignored(each)]
    for each in handled:
        signal.signal(each, handler)
    # The interpreter drops its handlers before it ends, and a late signal would change the exit code.
    atexit.unregister(_ignore)
    atexit.register(_ignore, handled)


def _is_ignored(number: signal.Signals) -> bool:
    """Return whether a signal was set to be ignored at the start, as `nohup` and a shell's `&` do."""
    return number is not signal.SIGTERM and signal.getsignal(number) is signal.SIG_IGN


def _ignore(handled: Sequence[signal.Signals]) -> None:
    for each in handled:
        signal.signal(each, signal.SIG_IGN)


def _do_nothing(number: int, frame: object) -> None:
    return


def _report_interruption() -> None:
    print_error("ladarreg: interrupted")
