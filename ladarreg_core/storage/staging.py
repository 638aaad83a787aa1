"""Atomic replacement of folders: a staging folder is written next to the target and renamed at the end.

While a folder NAME is being written, these are next to it:

.NAME.PID-XXXXXXXX.part   the unfinished or the replaced folder; removed at the end
.NAME.PID-XXXXXXXX.old    the folder being replaced, for a moment, on systems that cannot exchange two folders

A killed program leaves them behind; `clear_leftovers` removes the first and gives the second its name back.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import sys
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Literal

from ladarreg_core.errors import ExportError
from ladarreg_core.storage.atomic_write import sync_folder
from ladarreg_core.storage.replacement import display_path, folder_content, remove_results

_LEFTOVER = re.compile(r"\.(?P<name>.+)\.(?:(?P<pid>\d{1,10})-)?[0-9a-f]{8}\.(?P<state>part|old)")
_HERE = -100  # AT_FDCWD
_EXCHANGE = 2  # RENAME_EXCHANGE


@contextlib.contextmanager
def staging_folder(target: Path, *, more_names: Collection[str] = ()) -> Iterator[Path]:
    """Create and lock a temporary folder next to a target; at the end it is removed with its remaining result files.

    Args:
        target: the target folder; its parent exists.
        more_names: names of additional result files, beyond those that every run writes.

    Raises:
        OSError: if it cannot be created.
    """
    folder, held = _new_folder(target)
    try:
        yield folder
    finally:
        remove_results(folder, more_names=more_names)
        _unlock(held)


def put_in_place(new: Path, target: Path, verify: Callable[[Path], None]) -> None:
    """Rename a staging folder to its target; the previous content is then in the staging folder.

    On Linux the two folders are exchanged atomically. Elsewhere the old folder is renamed first, and gets its name back
    if the new one cannot be renamed.

    Args:
        new: the staging folder.
        target: the target folder.
        verify: called with the current path of the previous folder; raises if it must not be replaced, in which case
            it is restored.

    Raises:
        OSError: if it cannot be renamed.
        ExportError: if another program is replacing the folder.
    """
    if not os.path.lexists(target):
        os.rename(new, target)
        try:
            sync_folder(target.parent)
        except OSError:
            os.rename(target, new)
            raise
        return
    try:
        held = _lock(target)
    except BlockingIOError:
        raise ExportError(
            f"the folder {display_path(target)} is being replaced by another program; wait for it, or give another "
            "folder"
        ) from None
    try:
        if _exchange(new, target):
            try:
                verify(new)
                # What is in the staging folder is removed next: it might be all that the disk has.
                sync_folder(target.parent)
            except BaseException:
                _exchange(new, target)
                raise
        else:
            _set_aside_and_rename(new, target, verify)
    finally:
        _unlock(held)


def clear_leftovers(folder: Path, *, more_names: Collection[str] = ()) -> None:
    """Remove what killed programs left in a folder, see above. Folders locked by running programs are not touched.

    Args:
        folder: parent of the folders that were being written.
        more_names: as in `staging_folder`.
    """
    with contextlib.suppress(OSError):
        with os.scandir(folder) as listed:
            found = [
                (folder / entry.name, match)
                for entry in listed
                if (match := _LEFTOVER.fullmatch(entry.name)) and entry.is_dir(follow_symlinks=False)
            ]
        for path, match in found:
            with contextlib.suppress(OSError):
                _clear(path, folder / match["name"], match["state"], match["pid"], more_names)


def _clear(path: Path, target: Path, state: str, pid: str | None, more_names: Collection[str]) -> None:
    held = _lock(path)  # raises if its program is running
    try:
        if held is None and (pid is None or is_running(int(pid))):
            return
        if state == "part":
            remove_results(path, more_names=more_names)
        elif not os.path.lexists(target):
            os.rename(path, target)
        elif folder_content(target, more_names=more_names).document:  # the new results are in place
            remove_results(path, more_names=more_names)
    finally:
        _unlock(held)


def _set_aside_and_rename(new: Path, target: Path, verify: Callable[[Path], None]) -> None:
    aside = _temporary_path(target, "old")
    try:
        os.rename(target, aside)
        verify(aside)
        os.rename(new, target)
        sync_folder(target.parent)
    except OSError:
        if os.path.lexists(aside) and not os.path.lexists(new):
            os.rename(target, new)  # see above
        raise
    finally:  # an interruption may occur right after either rename
        if os.path.lexists(aside):
            os.rename(aside, new if os.path.lexists(target) else target)


def _exchange(first: Path, second: Path) -> bool:
    """Exchange two folders atomically; return False where the system or the file system does not support it."""
    if sys.platform != "linux":
        return False
    import ctypes

    try:
        exchange = ctypes.CDLL(None).renameat2
    except (OSError, AttributeError):
        return False
    return bool(exchange(_HERE, os.fsencode(first), _HERE, os.fsencode(second), _EXCHANGE) == 0)


def _temporary_path(target: Path, state: Literal["part", "old"]) -> Path:
    return target.with_name(f".{target.name}.{os.getpid()}-{secrets.token_hex(4)}.{state}")


def _new_folder(target: Path) -> tuple[Path, int | None]:
    """Create a folder and lock it before another program considers it a leftover."""
    while True:
        folder = _temporary_path(target, "part")
        folder.mkdir()
        try:
            held = _lock(folder)
            if held is None or os.path.samestat(os.fstat(held), os.stat(folder)):
                return folder, held
            _unlock(held)
        except (BlockingIOError, FileNotFoundError):
            continue


def _lock(folder: Path) -> int | None:
    """Lock a folder for the lifetime of this process; None where the system does not support it.

    Raises:
        BlockingIOError: if it is locked already.
        OSError: if it cannot be opened.
    """
    if sys.platform == "win32":
        return None
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise
    except OSError:  # as on some network file systems
        os.close(descriptor)
        return None
    return descriptor


def _unlock(held: int | None) -> None:
    if held is not None:
        with contextlib.suppress(OSError):
            os.close(held)


def is_running(pid: int) -> bool:
    """Return whether a process with that id is running."""
    if sys.platform == "win32":
        import ctypes

        kernel = ctypes.WinDLL("kernel32", use_last_error=True)
        kernel.OpenProcess.restype = ctypes.c_void_p
        process = kernel.OpenProcess(0x100000, False, pid)  # SYNCHRONIZE
        if not process:
            return ctypes.get_last_error() == 5  # ERROR_ACCESS_DENIED: it runs as another user
        ended = kernel.WaitForSingleObject(ctypes.c_void_p(process), 0) == 0
        kernel.CloseHandle(ctypes.c_void_p(process))
        return not ended
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
