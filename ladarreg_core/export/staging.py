"""Folders that are written beside their place and put into it in one step, whatever becomes of the program.

Beside a folder NAME, while it is written, lie

.NAME.PID-XXXXXXXX.part   what is not finished, or was replaced: removed at the end
.NAME.PID-XXXXXXXX.old    the folder that is being replaced, for a moment, where two folders cannot be exchanged

A program that is killed leaves them; `clear_leftovers` removes the first and gives the second its name back.
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
from ladarreg_core.export.atomic_write import sync_folder
from ladarreg_core.export.replacement import content_of, in_words, remove_results

_LEFTOVER = re.compile(r"\.(?P<name>.+)\.(?:(?P<pid>\d{1,10})-)?[0-9a-f]{8}\.(?P<state>part|old)")
_HERE = -100  # AT_FDCWD
_EXCHANGE = 2  # RENAME_EXCHANGE


@contextlib.contextmanager
def staging_folder(target: Path, *, more_names: Collection[str] = ()) -> Iterator[Path]:
    """Make a folder beside a place and hold it; at the end remove what it holds then, if it is still there.

    Args:
        target: the place; its parent exists.
        more_names: files that are written, beside those of every run.

    Raises:
        OSError: if it cannot be made.
    """
    folder, held = _new_folder(target)
    try:
        yield folder
    finally:
        remove_results(folder, more_names=more_names)
        _let_go(held)


def put_in_place(new: Path, target: Path, verify: Callable[[Path], None]) -> None:
    """Rename a staging folder to its place; what was there is in the staging folder then.

    On Linux the two folders are exchanged in one step. Elsewhere the old folder is set aside first, and has its name
    back if the new one cannot take it.

    Args:
        new: the staging folder.
        target: the place.
        verify: raises if the folder that was there, given by its path at that moment, must not be replaced; it is put
            back then.

    Raises:
        OSError: if it cannot be renamed.
        ExportError: if another program is replacing the folder.
    """
    if not os.path.lexists(target):
        os.rename(new, target)
        sync_folder(target.parent)
        return
    try:
        held = _hold(target)
    except BlockingIOError:
        raise ExportError(
            f"the folder {in_words(target)} is being replaced by another program; wait for that, or give another folder"
        ) from None
    try:
        if _exchanged(new, target):
            try:
                verify(new)
            except BaseException:
                _exchanged(new, target)
                raise
        else:
            _set_aside_and_rename(new, target, verify)
        sync_folder(target.parent)
    finally:
        _let_go(held)


def clear_leftovers(folder: Path, *, more_names: Collection[str] = ()) -> None:
    """Clear away what killed programs left in a folder: see above. What a living program holds is not touched.

    Args:
        folder: where folders were being written.
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
    held = _hold(path)  # raises where its program lives
    try:
        if held is None and (pid is None or _runs(int(pid))):
            return
        if state == "part":
            remove_results(path, more_names=more_names)
        elif not os.path.lexists(target):
            os.rename(path, target)
        elif content_of(target, more_names=more_names).document:  # the new results stand
            remove_results(path, more_names=more_names)
    finally:
        _let_go(held)


def _set_aside_and_rename(new: Path, target: Path, verify: Callable[[Path], None]) -> None:
    aside = _beside(target, "old")
    try:
        os.rename(target, aside)
        verify(aside)
        os.rename(new, target)
    finally:  # an interruption may fall just behind either
        if os.path.lexists(aside):
            os.rename(aside, new if os.path.lexists(target) else target)


def _exchanged(first: Path, second: Path) -> bool:
    """Exchange two folders in one step; return False where the system or the file system cannot."""
    if sys.platform != "linux":
        return False
    import ctypes

    try:
        exchange = ctypes.CDLL(None).renameat2
    except (OSError, AttributeError):
        return False
    return bool(exchange(_HERE, os.fsencode(first), _HERE, os.fsencode(second), _EXCHANGE) == 0)


def _beside(target: Path, state: Literal["part", "old"]) -> Path:
    return target.with_name(f".{target.name}.{os.getpid()}-{secrets.token_hex(4)}.{state}")


def _new_folder(target: Path) -> tuple[Path, int | None]:
    """Make a folder and hold it, before anybody takes it for a leftover."""
    while True:
        folder = _beside(target, "part")
        folder.mkdir()
        try:
            held = _hold(folder)
            if held is None or os.path.samestat(os.fstat(held), os.stat(folder)):
                return folder, held
            _let_go(held)
        except (BlockingIOError, FileNotFoundError):
            continue


def _hold(folder: Path) -> int | None:
    """Hold a folder for as long as this process lives; None where the system cannot.

    Raises:
        BlockingIOError: if it is held already.
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


def _let_go(held: int | None) -> None:
    if held is not None:
        with contextlib.suppress(OSError):
            os.close(held)


def _runs(pid: int) -> bool:
    """Return whether there is a process of that number."""
    if sys.platform == "win32":
        import ctypes

        kernel = ctypes.WinDLL("kernel32", use_last_error=True)
        kernel.OpenProcess.restype = ctypes.c_void_p
        process = kernel.OpenProcess(0x100000, False, pid)  # SYNCHRONIZE
        if not process:
            return ctypes.get_last_error() == 5  # ERROR_ACCESS_DENIED: it runs, as somebody else
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
