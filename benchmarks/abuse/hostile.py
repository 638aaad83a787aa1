"""Hostile files of all formats, and `--force` beside foreign files."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import closing, suppress
from pathlib import Path

from benchmarks.abuse.log import Log
from ladarreg_core.errors import LadarregError
from ladarreg_core.formats import describe
from ladarreg_core.formats.isolated import IsolatedReaders
from testing.attacks.forced_runs import COMMANDS, forced_runs
from testing.attacks.hostile_files import Listener, traced_reading, write_hostile

FILES, FORCED = "hostile", "forced"


def run(log: Log, files: int) -> None:
    """Read this many hostile files, confined and traced, and in a process that is not confined."""
    if log.of(FILES):
        return
    with tempfile.TemporaryDirectory(prefix="hostile-") as name, closing(Listener()) as listener:
        folder = Path(name) / "in"
        folder.mkdir()
        hostile = write_hostile(folder, files, listener.address)
        with closing(IsolatedReaders()) as readers:
            for file in hostile:
                for describing in (lambda path: readers.run(describe, path), describe):
                    with suppress(LadarregError):
                        describing(file)
        traced = None if shutil.which("strace") is None else traced_reading(hostile, folder, Path(name) / "log")
        faults = () if traced is None else (*traced.foreign, *traced.others)
        log.add(
            FILES, files=files, heard=listener.heard, traced=traced is not None,
            confined=0 if traced is None else traced.confined, connects=0 if traced is None else len(traced.others),
            foreign=0 if traced is None else len(traced.foreign), faults=faults[:20],
        )  # fmt: skip


def run_forced(log: Log, times: int) -> None:
    """Run each command that has `--force` this many times beside foreign files."""
    for command in COMMANDS:
        if not log.of(FORCED, command=command):
            found = forced_runs(command, times)
            log.add(
                FORCED, command=command, runs=found.runs, refused=found.refused, replaced=found.replaced,
                others=found.others, count=len(found.lost), lost=found.lost[:20],
            )  # fmt: skip
