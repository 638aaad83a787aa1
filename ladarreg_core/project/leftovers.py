"""Unfinished files that a killed process left in a project."""

from __future__ import annotations

import contextlib
import re
import shutil
from pathlib import Path

_PART = re.compile(r"\..+\.[0-9a-f]{8}\.part|.+\.zip\.part")
"""Names under which files are written before they are renamed: `.NAME.RANDOM.part`, and zips by earlier versions."""


def remove_leftovers(project: Path) -> list[Path]:
    """Remove what was being written in a project when its process was killed.

    Only names of our own pattern are removed, and what cannot be removed stays.

    Args:
        project: the project's folder; this process must hold its lock, so that nobody else writes there.

    Returns:
        The files and folders that were removed.
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
