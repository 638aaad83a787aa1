"""Unfinished files and folders of processes that were killed before they could remove them."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
from pathlib import Path

_PART = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{8}\.part")
"""Names under which files and folders are written before they are renamed: `.NAME.RANDOM.part`."""
_SURELY_DEAD_S = 24 * 3600.0


def remove_leftovers(folder: Path, *, of: str | None = None, unchanged_s: float = _SURELY_DEAD_S) -> list[Path]:
    """Remove what was being written in a folder when a process was killed.

    Only names of our own pattern are removed, and what cannot be removed stays.

    Args:
        folder: where to look; not below it.
        of: the name that was being written; None: any.
        unchanged_s: how long nothing may have changed in it, s, so that it belongs to no process that still writes; 0
            only where no other process writes there, as in a project that this one holds.

    Returns:
        What was removed.
    """
    removed: list[Path] = []
    try:
        entries = list(folder.iterdir())
    except OSError:
        return removed
    for path in entries:
        match = _PART.fullmatch(path.name)
        if match is None or (of is not None and match["name"] != of) or path.is_symlink():
            continue
        with contextlib.suppress(OSError):
            if unchanged_s > 0 and time.time() - _last_change(path) < unchanged_s:
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
            removed.append(path)
    return removed


def _last_change(path: Path) -> float:
    """Return when a file, or anything directly in a folder, changed last, s since the epoch."""
    inside = [entry.stat().st_mtime for entry in os.scandir(path)] if path.is_dir() else []
    return max([path.stat().st_mtime, *inside])
