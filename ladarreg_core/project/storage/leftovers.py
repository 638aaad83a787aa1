"""Removal of unfinished files that a killed process left in a project."""

from __future__ import annotations

import contextlib
import re
import shutil
from pathlib import Path

_PART = re.compile(r"\..+\.[0-9a-f]{8}\.part|.+\.zip\.part")
"""Temporary names of files that are being written: `.NAME.RANDOM.part`, and zips of earlier versions."""


def remove_leftovers(project: Path) -> list[Path]:
    """Remove files that were being written in a project when its process was killed.

    Only temporary names as written by this program are removed; files that cannot be removed stay.

    Args:
        project: the project folder; this process must hold its lock, so that no other process writes there.

    Returns:
        The removed files and folders.
    """
    removed: list[Path] = []
    for folder in (project, project / "arrays", project / "exports"):
        try:
            entries = list(folder.iterdir())
        except OSError:
            continue
        for path in entries:
            if path.is_symlink() or not _PART.fullmatch(path.name):
                continue
            with contextlib.suppress(OSError):
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink()
                removed.append(path)
    return removed
