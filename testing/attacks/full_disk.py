"""Harmless simulations of full disks."""

from __future__ import annotations

import errno
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


class DiskNotMounted(Exception):  # noqa: N818 - it is not an error
    """No small disk can be mounted."""


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Limit the size of this process's files: a piece that does not fit is written in part, then refused."""
    import resource  # not available on Windows

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def small_disk(place: Path, size: int) -> Iterator[Path]:
    """Mount a disk of a given size in memory.

    Raises:
        DiskNotMounted: if that is not permitted.
    """
    if sys.platform != "linux":
        raise DiskNotMounted("a small disk in memory is mounted on Linux only")
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(place)], capture_output=True, text=True
    )
    if mounted.returncode != 0:
        raise DiskNotMounted(f"a small disk in memory cannot be mounted: {mounted.stderr.strip()}")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def fill(disk: Path) -> Path:
    """Fill a disk to the last byte, and return the file that fills it."""
    ballast = disk / "ballast"
    with open(ballast, "wb", buffering=0) as file:
        for piece in (4096, 1):
            try:
                while True:
                    file.write(b"\0" * piece)
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
    return ballast


def free(ballast: Path, room: int) -> None:
    """Free some bytes of a full disk."""
    with suppress(FileNotFoundError), open(ballast, "r+b") as file:
        file.truncate(max(ballast.stat().st_size - room, 0))
