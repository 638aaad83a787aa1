"""What the system gives this process: more file descriptors than it starts with, and memory that goes back when unused.

glibc keeps what was freed: each of its arenas, one for every few threads, stays as large as it ever was. Two arenas are
enough where one interpreter lock lets one thread allocate at a time, and trimming returns what lies free in them.
"""

from __future__ import annotations

import ctypes
import functools
import gc
import os
import sys
import threading
from pathlib import Path
from typing import Any

_WANTED_DESCRIPTORS = 4096
_M_ARENA_MAX = -8
"""Of `mallopt`, from glibc's malloc.h."""
_ARENAS = 2
_RETURN_AFTER_S = 1.0
_WORTH_WHILE = 32 << 20
"""Bytes of growth from which on it is done again: everybody waits while it is."""
_pending = threading.Lock()
_resident_before = 0


def raised_descriptor_limit() -> int | None:
    """Raise the soft limit of file descriptors and return it; None where sockets do not count towards one."""
    if sys.platform == "win32":
        return None
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _WANTED_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _WANTED_DESCRIPTORS)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return None if soft == resource.RLIM_INFINITY else soft
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    except (OSError, ValueError):  # macOS has a limit of its own, too
        return soft
    return wanted


def limit_arenas() -> None:
    """Have glibc make few arenas; to be called before there are threads, elsewhere it does nothing."""
    if (libc := _glibc()) is not None:
        libc.mallopt(_M_ARENA_MAX, _ARENAS)


def keep_what_is_loaded() -> None:
    """Take what is in memory now for what stays: the garbage collector need not look at it again."""
    gc.collect()
    gc.freeze()


def return_memory_soon(*, surely: bool = False) -> None:
    """Give freed memory back to the system in a moment; many calls at once are one.

    Args:
        surely: even if the process has not grown since that was last done.
    """
    global _resident_before
    if _glibc() is None:
        return
    resident = _resident()
    if not surely and resident < _resident_before + _WORTH_WHILE:
        _resident_before = min(_resident_before, resident)
    elif _pending.acquire(blocking=False):
        timer = threading.Timer(_RETURN_AFTER_S, _return_memory)
        timer.daemon = True
        timer.start()


def _return_memory() -> None:
    global _resident_before
    _pending.release()
    gc.collect()  # closed connections hold their last message in circles of references
    libc = _glibc()
    assert libc is not None
    libc.malloc_trim(0)
    _resident_before = _resident()


def _resident() -> int:
    """Return the resident memory, bytes."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")


@functools.cache
def _glibc() -> Any:
    """Return the C library if it is glibc, else None."""
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)
    return library if hasattr(library, "malloc_trim") and hasattr(library, "mallopt") else None
