"""Thousands of damaged files for every format."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.abuse.log import Log
from ladarreg_core.formats import FORMATS
from testing.attacks.reader_fuzz import read_damaged
from testing.files.seed_files import write_seeds

SECTION = "readers"
_AT_A_TIME = 100
_MAX_FAULTS = 20
"""Number of files per row of the log."""


def run(log: Log, mutations: int) -> None:
    """Read this many damaged files of each format, without those read before."""
    with tempfile.TemporaryDirectory(prefix="seeds-") as name:
        folder = Path(name)
        seeds = write_seeds(folder)
        for known in FORMATS:
            if not any(seed.format == known.name for seed in seeds):
                log.add(SECTION, format=known.name, files=0, refused=0, seconds=0, mb=0, faults=["no seed file"])
                continue
            done = {row["first"] for row in log.of(SECTION, format=known.name) if "first" in row}
            for first in range(0, mutations, _AT_A_TIME):
                if first in done:
                    continue
                last = min(first + _AT_A_TIME, mutations)
                keep = log.work / "readers" / known.name.replace(" ", "-")
                found = read_damaged(folder, known.name, first, last, keep=keep)
                log.add(
                    SECTION, format=known.name, first=first, files=found.files, refused=found.refused,
                    seconds=found.seconds, mb=found.mb, count=len(found.faults), faults=found.faults[:_MAX_FAULTS],
                )  # fmt: skip
