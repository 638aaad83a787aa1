"""Helpers for processes started by tests."""

from __future__ import annotations

import signal


def restore_ctrl_c() -> None:
    """Restore Ctrl-C in a new process: a shell makes its background jobs, and they their children, ignore it.

    Likewise the end of a terminal, which `nohup` makes them ignore.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
