"""Programs started by tests."""

from __future__ import annotations

import signal


def restore_ctrl_c() -> None:
    """Undo, in a new process, what a shell does to its background jobs and they to their children: Ctrl-C ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
