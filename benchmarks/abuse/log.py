"""Log of a long run: JSON lines, appended as results arrive, so that an interrupted run can be resumed."""

from __future__ import annotations

import datetime
import json
import os
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

Row = dict[str, Any]


class Log:
    """Appends rows to a file, and reads the rows already in it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows = read_rows(path)
        self.work = path.with_name(f"{path.name}.d")
        """Folder for working files and for files that caused a fault."""
        self.work.mkdir(parents=True, exist_ok=True)

    def add(self, section: str, **fields: Any) -> None:
        """Append a row."""
        row: Row = {"section": section, "when": _now(), **fields}
        line = json.dumps(row, default=str)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")
        self.rows.append(row)

    def of(self, section: str, **wanted: Any) -> list[Row]:
        """Return the rows of a section whose fields have these values."""
        return rows_of(self.rows, section, wanted)


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a file; an incomplete last line is ignored."""
    rows = []
    if path.is_file():
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                rows.append(json.loads(line))
            except ValueError:
                continue
    return rows


def rows_of(rows: list[Row], section: str, wanted: Mapping[str, Any] | None = None) -> list[Row]:
    """Return the rows of a section whose fields have these values."""
    return [
        row
        for row in rows
        if row.get("section") == section and all(row.get(name) == value for name, value in (wanted or {}).items())
    ]


def machine() -> Row:
    """Return a description of the machine and the software."""
    import platform

    try:
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    return {
        "commit": commit.strip(), "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}", "processors": os.cpu_count(),
    }  # fmt: skip


def _now() -> str:
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")
