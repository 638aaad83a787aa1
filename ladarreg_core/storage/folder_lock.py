"""Lock of a folder: held by one program at a time, and released by a crash."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

from ladarreg_core.errors import ExportError
from ladarreg_core.storage.atomic_write import cannot_write

READ_ONLY = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})
"""Errors of writing where only reading is permitted."""
_TAKEN = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK})


class FolderLock:
    """Lock on a folder, held until it is released or the process ends.

    A file in the folder is locked, and also the folder itself where the system supports it: the locked file can be
    removed, and a new file of the same name would not be locked. Where neither can be locked, because the file system
    has no locks or nothing can be written, the folder is opened without, and `remark` says so.
    """

    def __init__(self, folder: Path, name: str, *, what: str) -> None:
        """Take the lock.

        Args:
            folder: the folder to lock.
            name: name of the lock file.
            what: what the folder is, for messages, e.g. `project`.

        Raises:
            ExportError: if another program holds it, or the file cannot be created though the folder can be written.
        """
        self._file = folder / name
        self._descriptors: list[int] = []
        self.remark = ""
        """What users should know of the folder, a sentence; empty: it is locked."""
        try:
            self._descriptors.append(os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o600))
        except OSError as error:
            if error.errno not in READ_ONLY:
                raise cannot_write(folder / name, error) from None
            self.remark = f"The folder of the {what} cannot be written: it can be viewed, and nothing is saved in it."
        if os.name != "nt":  # open files cannot be removed there, and folders cannot be opened
            with contextlib.suppress(OSError):
                self._descriptors.append(os.open(folder, os.O_RDONLY))
        try:
            held = [_lock(descriptor) for descriptor in self._descriptors]
        except OSError:
            self.release()
            raise ExportError(
                f"the {what} {folder} is open in another program; close it there, or open a copy of the folder"
            ) from None
        if not any(held) and not self.remark:
            self.remark = (
                f"The file system of the {what} has no locks: make sure yourself that no other program has it open."
            )

    def release(self) -> None:
        """Release the lock."""
        descriptors, self._descriptors = self._descriptors, []
        for descriptor in descriptors:
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def discard(self) -> None:
        """Release the lock and remove its file."""
        self.release()
        with contextlib.suppress(OSError):
            self._file.unlink()


def _lock(descriptor: int) -> bool:
    """Lock an open file or folder; False where the file system has no locks.

    Raises:
        OSError: if another program holds the lock.
    """
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _TAKEN:
            raise
        return False
    return True
