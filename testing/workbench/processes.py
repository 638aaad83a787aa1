"""Helpers for processes started by tests."""

from __future__ import annotations

import signal


def restore_stop_signals() -> None:
    """Restore Ctrl-C and SIGHUP in a new process: under `nohup`, tests and their children ignore SIGHUP, too."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def restore_ctrl_c() -> None:
    """Restore Ctrl-C in a new process: a shell makes its background jobs, and they their children, ignore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
