"""Signals that ask the program to stop: Ctrl-C, a polite kill, a terminal that was closed."""

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
"""SIGHUP exists on POSIX only, SIGBREAK (Ctrl-Break, a console that is closed) on Windows only."""
ONE_REQUEST_S = 1.0
"""Signals that follow the first one within this time belong to it: `make` repeats the Ctrl-C that the terminal has sent
to everybody, and a session that ends sends both SIGHUP and SIGTERM."""


class StopSignals:
    """Stop signals of a server, received by a thread of their own.

    The handlers raise nothing: an exception that a handler raises comes out of whatever line happens to run, which may
    be in the middle of a lock. The interpreter writes each signal's number into a socket, and the thread reads it.
    """

    def __init__(self) -> None:
        self.first: int | None = None
        """The signal that asked first."""
        self._asked = threading.Event()
        self._at_once: Callable[[], object] = _interrupted_at_once
        self._sockets: tuple[socket.socket, socket.socket] | None = None
        self._first_at = 0.0

    def listen(self) -> None:
        """Take over the stop signals until the process ends; they can only be taken over by the main thread."""
        import socket

        if threading.current_thread() is not threading.main_thread():
            return
        reader, writer = self._sockets = socket.socketpair()
        writer.setblocking(False)
        signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        _handle(_nothing)
        threading.Thread(target=self._receive, args=(reader,), name="stop signals", daemon=True).start()

    @property
    def asked(self) -> bool:
        """Whether somebody asked the program to stop."""
        return self._asked.is_set()

    def wait(self, seconds: float) -> bool:
        """Return whether somebody asks the program to stop within a time, s."""
        return self._asked.wait(seconds)

    def check(self) -> None:
        """Give way to a request to stop.

        Raises:
            Cancelled: if there was one.
        """
        if self.asked:
            from ladarreg_core.errors import Cancelled

            raise Cancelled

    def end_at_once_by(self, end: Callable[[], object]) -> None:
        """Set what ends the process when a signal comes again, later than `ONE_REQUEST_S` after the first.

        Args:
            end: called by another thread than the main one, once; the process ends when it returns.
        """
        self._at_once = end

    def _receive(self, reader: socket.socket) -> None:
        while numbers := reader.recv(64):
            for number in numbers:
                if number in STOP_SIGNALS:
                    self._came(number)

    def _came(self, number: int) -> None:
        if self.first is None:
            self.first, self._first_at = number, time.monotonic()
            self._asked.set()
        elif time.monotonic() - self._first_at > ONE_REQUEST_S:
            try:
                self._at_once()
            finally:
                exit_now(ExitCode.INTERRUPTED)


def interrupt_on_stop_signals() -> None:
    """Have stop signals raise KeyboardInterrupt, one for all that come within `ONE_REQUEST_S`."""
    last = -ONE_REQUEST_S

    def interrupt(number: int, frame: object) -> None:
        nonlocal last
        if time.monotonic() - last > ONE_REQUEST_S:
            last = time.monotonic()
            raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        _handle(interrupt)


def exit_now(code: int) -> None:
    """End the process without waiting for its threads."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def say(text: str) -> None:
    """Print a line on stderr, where that can still be written: the terminal may be what was closed."""
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def _handle(handler: Callable[[int, Any], object]) -> None:
    """Handle the stop signals until the interpreter has ended."""
    handled = [each for each in STOP_SIGNALS if not _is_ignored(each)]
    for each in handled:
        signal.signal(each, handler)
    # The interpreter gives handlers up before it is gone, and a late signal would change the exit code.
    atexit.unregister(_ignore)
    atexit.register(_ignore, handled)


def _is_ignored(number: signal.Signals) -> bool:
    """Return whether a signal is not meant for us: `nohup` and a shell's `&` have their programs ignore these."""
    return number is not signal.SIGTERM and signal.getsignal(number) is signal.SIG_IGN


def _ignore(handled: Sequence[signal.Signals]) -> None:
    for each in handled:
        signal.signal(each, signal.SIG_IGN)


def _nothing(number: int, frame: object) -> None:
    return


def _interrupted_at_once() -> None:
    say("ladarreg: interrupted")
