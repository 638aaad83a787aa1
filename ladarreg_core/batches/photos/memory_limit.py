"""A limit of the memory that a task may use, so that one that needs too much fails alone."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator

_WATCHED_EVERY_S = 0.2
_ENDED_BY_LIMIT = 77


@contextlib.contextmanager
def memory_limit(most_bytes: int | None) -> Iterator[None]:
    """Let what is done here use so much memory beyond what the process has, and no more.

    On Linux the system refuses more (`RLIMIT_DATA`): a `MemoryError` is raised, as a rule. Elsewhere the memory is
    watched, and the process ends when it has more. Without a number there is no limit.
    """
    if most_bytes is None:
        yield
    elif sys.platform == "linux":
        with _refused_beyond(most_bytes):
            yield
    else:
        with _watched(most_bytes):
            yield


def memory_of_machine() -> int | None:
    """Return the memory of the machine, bytes; None where the system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return None


@contextlib.contextmanager
def _refused_beyond(most_bytes: int) -> Iterator[None]:
    import resource

    from ladarreg_core.formats.isolated.worker import data_bytes

    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = data_bytes() + most_bytes
    resource.setrlimit(resource.RLIMIT_DATA, (wanted if hard < 0 else min(wanted, hard), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


@contextlib.contextmanager
def _watched(most_bytes: int) -> Iterator[None]:
    before, done = _resident_bytes(), threading.Event()

    def watch() -> None:
        while not done.wait(_WATCHED_EVERY_S):
            if _resident_bytes() > before + most_bytes:
                os.write(2, f"it used more than {most_bytes / 1e9:.1f} GB of memory\n".encode())  # its last words
                os._exit(_ENDED_BY_LIMIT)

    threading.Thread(target=watch, name="memory limit", daemon=True).start()
    try:
        yield
    finally:
        done.set()


def _resident_bytes() -> int:
    """Return the resident memory of this process, or its peak where the system says only that."""
    if sys.platform == "win32":
        import ctypes
        from ctypes import wintypes

        class Counters(ctypes.Structure):
            _fields_ = [
                ("cb", wintypes.DWORD), ("faults", wintypes.DWORD), ("peak", ctypes.c_size_t),
                ("working_set", ctypes.c_size_t), *((f"other{k}", ctypes.c_size_t) for k in range(6)),
            ]  # fmt: skip

        found = Counters(cb=ctypes.sizeof(Counters))
        kernel = ctypes.WinDLL("kernel32")
        kernel.GetCurrentProcess.restype = wintypes.HANDLE
        kernel.K32GetProcessMemoryInfo(wintypes.HANDLE(kernel.GetCurrentProcess()), ctypes.byref(found), found.cb)
        return int(found.working_set)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak << 10
