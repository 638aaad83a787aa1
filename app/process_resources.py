"""Process resources: raises the limit of file descriptors, and returns freed memory to the system.

glibc keeps freed memory: each of its arenas, one for every few threads, stays at its largest size. Two arenas suffice
under the interpreter lock, which lets one thread allocate at a time, and trimming returns their free memory.
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
"""Parameter of `mallopt`, from glibc's malloc.h."""
_ARENAS = 2
_RETURN_AFTER_S = 1.0
_LEAST_GROWTH = 32 << 20
"""Growth, bytes, below which memory is not trimmed again: trimming blocks all threads."""
_pending = threading.Lock()
_resident_before = 0


def raised_descriptor_limit() -> int | None:
    """Raise the soft limit of file descriptors and return it; None if there is no such limit for sockets."""
    if sys.platform == "win32":
        return None
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _WANTED_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _WANTED_DESCRIPTORS)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return None if soft == resource.RLIM_INFINITY else soft
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    except (OSError, ValueError):  # macOS has a second, lower limit
        return soft
    return wanted


def limit_arenas() -> None:
    """Limit the number of glibc's arenas; call it before threads start. No effect without glibc."""
    if (libc := _glibc()) is not None:
        libc.mallopt(_M_ARENA_MAX, _ARENAS)


def freeze_loaded_objects() -> None:
    """Exclude all present objects from garbage collection."""
    gc.collect()
    gc.freeze()


def return_memory_soon(*, even_if_small: bool = False) -> None:
    """Return freed memory to the system after a short delay; calls in quick succession are combined.

    Args:
        even_if_small: do it even if the process has not grown since the last time.
    """
    global _resident_before
    if _glibc() is None:
        return
    resident = _resident()
    if not even_if_small and resident < _resident_before + _LEAST_GROWTH:
        _resident_before = min(_resident_before, resident)
    elif _pending.acquire(blocking=False):
        timer = threading.Timer(_RETURN_AFTER_S, _return_memory)
        timer.daemon = True
        timer.start()


def _return_memory() -> None:
    global _resident_before
    _pending.release()
    gc.collect()  # closed connections keep their last message in reference cycles
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
