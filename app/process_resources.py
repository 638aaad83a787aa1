"""Resources of this process: raises the limit of file descriptors, and returns unused memory to the system.

glibc keeps freed memory: each of its arenas, one for every few threads, stays as large as it ever was. Two arenas are
enough, because the interpreter lock lets one thread allocate at a time, and trimming returns their free memory.
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

_DESCRIPTORS = 4096
_M_ARENA_MAX = -8
"""Parameter of `mallopt`, from glibc's malloc.h."""
_ARENAS = 2
_TRIM_DELAY_S = 1.0
_MIN_GROWTH_BYTES = 32 << 20
"""Growth of the process that makes another trim worthwhile: all threads wait for it."""
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_OWN_MAPPING_BYTES = 4 << 20
_LARGEST_MAPPING_THRESHOLD = 32 << 20
"""Of what glibc accepts; larger arrays always have a mapping of their own."""
_KEPT_BYTES = 1 << 30
_COLLECTED_AFTER = (2000, 10, 10)
"""Of `gc.set_threshold`, about Python's own."""
_trim_pending = threading.Lock()
_resident_after_trim = 0


def raise_descriptor_limit() -> int | None:
    """Raise the soft limit of file descriptors and return it; None if sockets are not limited by one."""
    if sys.platform == "win32":
        return None
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _DESCRIPTORS)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return None if soft == resource.RLIM_INFINITY else soft
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    except (OSError, ValueError):  # macOS has an additional limit
        return soft
    return wanted


def limit_arenas() -> None:
    """Limit the arenas of glibc; call it before threads are started. Without glibc it does nothing."""
    if (libc := _glibc()) is not None:
        libc.mallopt(_M_ARENA_MAX, _ARENAS)


def freeze_loaded_objects() -> None:
    """Exempt all present objects from garbage collection, since they are modules and stay; look for others more often.

    A command is over before its garbage matters; a server is not.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(*_COLLECTED_AFTER)


def return_memory_soon(*, force: bool = False) -> None:
    """Return freed memory to the system shortly; several calls at once have the effect of one.

    Args:
        force: even if the process has not grown since the last time.
    """
    global _resident_after_trim
    if _glibc() is None:
        return
    resident = _resident_bytes()
    if not force and resident < _resident_after_trim + _MIN_GROWTH_BYTES:
        _resident_after_trim = min(_resident_after_trim, resident)
    elif _trim_pending.acquire(blocking=False):
        timer = threading.Timer(_TRIM_DELAY_S, _trim)
        timer.daemon = True
        timer.start()


def keep_heap_small() -> None:
    """Return the memory of every freed array of several megabytes to the system at once; without glibc it does nothing.

    Otherwise glibc keeps up to a gigabyte of them for reuse, which costs less time but is too much beside a large scan.
    """
    if (libc := _glibc()) is not None:
        libc.mallopt(_M_MMAP_THRESHOLD, _OWN_MAPPING_BYTES)


def keep_freed_memory() -> None:
    """Keep the memory of freed arrays for the next ones; without glibc it does nothing.

    Otherwise every array of some megabytes is of new pages, which the system has to clear first: a tenth of the time of
    the export of a scan of one million cells.
    """
    if (libc := _glibc()) is not None:
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGEST_MAPPING_THRESHOLD)
        libc.mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)


def return_memory() -> None:
    """Return freed memory to the system now; without glibc it does nothing."""
    gc.collect()
    if (libc := _glibc()) is not None:
        libc.malloc_trim(0)


def _trim() -> None:
    global _resident_after_trim
    _trim_pending.release()
    gc.collect()  # closed connections keep their last message in reference cycles
    libc = _glibc()
    assert libc is not None
    libc.malloc_trim(0)
    _resident_after_trim = _resident_bytes()


def _resident_bytes() -> int:
    """Return the resident memory of the process, bytes."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")


@functools.cache
def _glibc() -> Any:
    """Return the C library if it is glibc, else None."""
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)
    return library if hasattr(library, "malloc_trim") and hasattr(library, "mallopt") else None
