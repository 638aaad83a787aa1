"""The Chromium of the browser tests; `python -m testing.workbench.browser` prints it, and fails if there is none."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
CHEAP = ("--disable-gpu-rasterization", "--disable-accelerated-2d-canvas", "--disable-gpu-compositing")
"""Pages are drawn without the emulated graphics card, which is then left to WebGL."""
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_MAC = "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome"


@cache
def find_chromium() -> str | None:
    """Return a Chromium that starts, or None: some distributions' `chromium` only prints how to install it."""
    for candidate in (os.environ.get("LADARREG_CHROMIUM"), *map(shutil.which, _NAMES), _MAC, _playwrights_own()):
        if candidate and Path(candidate).exists() and _starts(candidate):
            return candidate
    return None


def _playwrights_own() -> str | None:
    try:
        from playwright.sync_api import sync_playwright

        with sync_playwright() as playwright:
            return playwright.chromium.executable_path
    except Exception:
        return None


def _starts(path: str) -> bool:
    try:
        return subprocess.run([path, "--version"], capture_output=True, timeout=30).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


if __name__ == "__main__":
    found = find_chromium()
    sys.stdout.write(f"browser tests: {found}\n" if found else "browser tests: no Chromium, they will be skipped\n")
    sys.exit(found is None)
