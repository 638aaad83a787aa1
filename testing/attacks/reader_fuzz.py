"""Damaged files read in child processes: outcome and cost for the readers of each format."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

CHECKOUT = Path(__file__).resolve().parents[2]


@dataclass
class Readings:
    """Outcome for a number of damaged files of one format."""

    format: str
    files: int = 0
    refused: int = 0
    """By the reader of the format."""
    seconds: float = 0.0
    """Largest processor time of a file."""
    mb: float = 0.0
    """Largest peak memory of a file above that of the idle process."""
    faults: list[str] = field(default_factory=list)
    """Failures: exceptions other than `LadarregError`, too much memory or time, processes that died."""


def read_damaged(
    folder: Path, name: str, first: int, last: int, *, patience_s: float = 120.0, keep: Path | None = None
) -> Readings:
    """Read damaged files of a format in a child process; as `read_damaged_formats`."""
    (found,) = read_damaged_formats(folder, [name], last, first=first, patience_s=patience_s, keep=keep)
    return found


def read_damaged_formats(
    folder: Path,
    names: Sequence[str],
    last: int,
    *,
    first: int = 0,
    patience_s: float = 120.0,
    keep: Path | None = None,
) -> list[Readings]:
    """Read damaged files in one child process; if it dies, another continues with the next file.

    Args:
        folder: contains the seeds.
        names: of the formats.
        last: number after the last damaged file of each format.
        first: number of the first one of the first format; the others begin with 0.
        patience_s: wall time after which a reader is taken to hang.
        keep: folder that files at fault are copied to.
    """
    found, left = [Readings(name) for name in names], [*names]
    while left:
        words = ["testing.attacks.reader_child", folder, json.dumps(left), first, last, patience_s]
        done = subprocess.run(
            [sys.executable, "-m", *map(str, [*words, *([keep] if keep else [])])],
            capture_output=True, text=True, check=False, cwd=CHECKOUT,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(CHECKOUT)},
        )  # fmt: skip
        rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
        for row in rows:
            _add(found[names.index(row["format"])], row)
        first = max((row["number"] + 1 for row in rows if row["format"] == left[0]), default=first)
        while left and first >= last:
            del left[0]
            first = max((row["number"] + 1 for row in rows if left and row["format"] == left[0]), default=0)
        if left:
            if not rows and done.returncode == 1 and "Timeout" not in done.stderr:  # the harness itself failed
                raise RuntimeError(done.stderr[-2000:])
            died = found[names.index(left[0])]
            died.files += 1
            died.faults.append(f"file {first}: {_death(done.returncode, done.stderr, patience_s)}")
            first += 1
            if first >= last:
                del left[0]
                first = 0
    return found


def _add(found: Readings, row: dict[str, Any]) -> None:
    found.files += 1
    found.refused += bool(row["refused"])
    found.seconds, found.mb = max(found.seconds, row["seconds"]), max(found.mb, row["mb"])
    found.faults += [f"file {row['number']} of {row['seed']}, {row['bytes']} bytes: {fault}" for fault in row["faults"]]


def _death(code: int, said: str, patience_s: float) -> str:
    place = next((line.strip() for line in said.splitlines() if "ladarreg_core" in line), "")
    if "Timeout" in said:
        return f"hang, more than {patience_s:g} s; {place}"
    return f"crash, exit code {code}; {place or said.strip()[-200:]}"
