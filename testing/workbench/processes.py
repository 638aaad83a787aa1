"""Helpers for processes started by tests."""

from __future__ import annotations

import signal


def restore_stop_signals() -> None:
    """Restore Ctrl-C and SIGHUP in a new process: under `nohup`, tests and their children ignore SIGHUP, too."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
