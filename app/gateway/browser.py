"""The browser of whoever starts the program."""

from __future__ import annotations

import os
import sys
import webbrowser


def open_browser(address: str) -> bool:
    """Open an address where there is a screen: without one, a text browser would take over the terminal.

    Args:
        address: what to open.

    Returns:
        Whether a browser was found.
    """
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return bool(sys.platform in ("win32", "darwin") or screen) and webbrowser.open(address)
