"""Readers that misbehave, run in reader processes by the tests."""

from __future__ import annotations

import ctypes
import os
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.errors import FormatError
from ladarreg_core.formats import photo_file, read_scan
from ladarreg_core.photo import Photo
from ladarreg_core.progress import Progress, Report
from ladarreg_core.scan import Scan


def size_of(path: Path) -> int:
    return path.stat().st_size


def process_id() -> int:
    return os.getpid()


def echo(value: Any) -> Any:
    return value


def sleeps(path: Path) -> None:
    time.sleep(600)


def computes(path: Path) -> None:
    while True:
        pass


def holds_the_interpreter(path: Path) -> None:
    """Hang in native code that never lets another thread run."""
    if sys.platform == "win32":
        ctypes.PyDLL("kernel32").Sleep(600_000)
    ctypes.PyDLL(None).sleep(600)


def crashes(path: Path) -> None:
    ctypes.string_at(0)


def aborts(path: Path) -> None:
    os.abort()


def exits(path: Path) -> None:
    os._exit(3)


def fails(path: Path) -> None:
    raise ZeroDivisionError("a fault of the program")


def grows(path: Path, megabytes: int) -> int:
    return int(np.ones(megabytes << 20, np.uint8)[-1])


def refuses(path: Path) -> None:
    raise FormatError(f"{path.name}: it is no good; take another")


def returns_code(path: Path) -> Any:
    return refuses


def writes_nonsense(path: Path) -> None:
    """Act like a compromised decoder: write to every open file."""
    for descriptor in range(3, 20):
        try:
            os.write(descriptor, b"\xff" * 4096)
        except OSError:
            continue


def goes_on(path: Path, steps: int, step_s: float, report: Report | None = None) -> int:
    for done in range(steps):
        time.sleep(step_s)
        if report is not None:
            report(Progress(done + 1, steps, "reading"))
    return steps


def marks_time(path: Path, report: Report | None = None) -> None:
    """Hang while repeating the same progress report."""
    while True:
        time.sleep(0.02)
        if report is not None:
            report(Progress(1, 2, "reading"))


def open_files() -> list[str]:
    found = []
    for name in os.listdir("/proc/self/fd"):
        with suppress(FileNotFoundError):  # the one that listed them
            found.append(os.readlink(f"/proc/self/fd/{name}"))
    return found


def environment() -> list[str]:
    return sorted(os.environ)


def read_photo(path: Path, **options: Any) -> Photo:
    """Read a photograph, unless its name requests misbehaviour."""
    _misbehave(path)
    return photo_file.read_photo(path, **options)


def read_scan_or_misbehave(path: Path, *, report: Report | None = None, **asked: Any) -> Scan:
    """Read a scan, unless its name requests misbehaviour."""
    _misbehave(path)
    return read_scan(path, report=report, **asked)


def _misbehave(path: Path) -> None:
    content = path.read_bytes()[-8:]
    if content.endswith(b"crash"):
        ctypes.string_at(0)
    if content.endswith(b"hang"):
        time.sleep(600)
