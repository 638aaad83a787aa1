"""The journal of a run: which tasks were done, with their results, one line each; what makes a run resumable."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ladarreg_core.errors import FormatError, NewerVersionError
from ladarreg_core.storage.atomic_write import AppendedFile, write_bytes
from ladarreg_core.storage.checksums import checksum_state, sealed

JOURNAL_FILE = ".ladarreg-batch.jsonl"
"""Its name in the folder of a run."""
_VERSION = 1
_LARGEST_BYTES = 1 << 30


class Journal:
    """Records that are only appended, each with its checksum; the last one of a name and stage counts.

    A line that was cut off, since the program was killed while it wrote it, is dropped with all that follows it.

    Args:
        path: the file; it is created where there is none.

    Raises:
        FormatError: if it is no journal, or of a newer version.
        ExportError: if it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        if not path.exists():
            write_bytes(path, _line({"kind": "batch", "version": _VERSION}))
        self._records, intact_bytes = _read(path)
        self._file = AppendedFile(path, intact_bytes=intact_bytes)

    def __bool__(self) -> bool:
        return bool(self._records)

    def find(self, stage: str, name: str, key: str) -> Mapping[str, Any] | None:
        """Return the result of a task if it was done with this key; None: it was not, or with another one."""
        record = self._records.get((stage, name))
        return record["result"] if record is not None and record["key"] == key else None

    def names(self, stage: str) -> dict[str, str]:
        """Return the names of all tasks that were done in a stage, with their keys."""
        return {name: str(record["key"]) for (of, name), record in self._records.items() if of == stage}

    def add(self, stage: str, name: str, key: str, result: Mapping[str, Any]) -> None:
        """Record that a task was done.

        Args:
            stage: of the run.
            name: of the task.
            key: of all that the result depends on.
            result: plain JSON values.

        Raises:
            ExportError: if it cannot be written.
        """
        record = {"stage": stage, "name": name, "key": key, "result": dict(result)}
        self._file.append(_line(record))
        self._records[stage, name] = record

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_journal(path: Path) -> dict[tuple[str, str], Mapping[str, Any]]:
    """Return the last record of each stage and name, also while another program appends to the journal.

    Raises:
        FormatError: as of `Journal`.
    """
    return _read(path)[0]


def _read(path: Path) -> tuple[dict[tuple[str, str], Mapping[str, Any]], int]:
    """Return the last record of each stage and name, and the length of the intact part."""
    if path.stat().st_size > _LARGEST_BYTES:
        raise FormatError(f"{path} is too large for the journal of a run; give another folder")
    records: dict[tuple[str, str], Mapping[str, Any]] = {}
    intact = 0
    for number, line in enumerate(path.read_bytes().splitlines(keepends=True)):
        fields = _fields(line)
        if number == 0:
            _check_head(path, fields)
        elif fields is None:
            break
        else:
            records[str(fields["stage"]), str(fields["name"])] = fields
        intact += len(line)
    if intact == 0:
        _check_head(path, None)
    return records, intact


def _line(fields: Mapping[str, Any]) -> bytes:
    return json.dumps(sealed(fields), ensure_ascii=False, allow_nan=False).encode("utf-8") + b"\n"


def _fields(line: bytes) -> dict[str, Any] | None:
    """Return the fields of a line; None: it is damaged or cut off."""
    try:
        fields = json.loads(line) if line.endswith(b"\n") else None
    except (ValueError, RecursionError):
        return None
    if not isinstance(fields, dict) or checksum_state(fields) != "intact":
        return None
    return fields


def _check_head(path: Path, fields: Mapping[str, Any] | None) -> None:
    if fields is None or fields.get("kind") != "batch":
        raise FormatError(f"{path} is not the journal of a run; give another folder, or remove that file")
    if fields.get("version") != _VERSION:
        raise NewerVersionError(f"{path} was written by a newer version of ladarreg; use that one, or another folder")
