"""What the system gives this process: more file descriptors than it starts with, and memory that goes back when unused.

glibc keeps what was freed: each of its arenas, one for every few threads, stays as large as it ever was. Two arenas are
enough where one interpreter lock lets one thread allocate at a time, and trimming returns what lies free in them.
"""

from __future__ import annotations

import ctypes
import functools
import sys
import threading
from typing import Any

_WANTED_DESCRIPTORS = 4096
_M_ARENA_MAX = -8
"""Of `mallopt`, from glibc's malloc.h."""
_ARENAS = 2
_TRIM_AFTER_S = 1.0
_pending = threading.Lock()


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


def return_memory_soon() -> None:
    """Give freed memory back to the system in a moment; many calls at once are one."""
    if _glibc() is None or not _pending.acquire(blocking=False):
        return
    timer = threading.Timer(_TRIM_AFTER_S, _trim)
    timer.daemon = True
    timer.start()


def _trim() -> None:
    _pending.release()
    import gc, time
    t=time.perf_counter(); n=gc.collect(); t1=time.perf_counter()
    libc = _glibc()
    assert libc is not None
    libc.malloc_trim(0)
    print("collected", n, len(gc.get_objects()), gc.get_freeze_count(), t1-t, "trim", time.perf_counter()-t1, file=open("/tmp/floods/log","a"))


@functools.cache
def _glibc() -> Any:
    """Return the C library if it is glibc, else None."""
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)
    return library if hasattr(library, "malloc_trim") and hasattr(library, "mallopt") else None
