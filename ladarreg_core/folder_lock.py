"""Lock of a folder: held by one program at a time, and released by a crash."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from ladarreg_core.atomic_write import cannot_write
from ladarreg_core.errors import ExportError


class FolderLock:
    """Lock on a folder, held until it is released or the process ends.

    A file in the folder is locked, and also the folder itself where the system supports it: the locked file can be
    removed, and a new file of the same name would not be locked.
    """

    def __init__(self, folder: Path, name: str, *, what: str) -> None:
        """Take the lock.

        Args:
            folder: the folder to lock.
            name: name of the lock file.
            what: what the folder is, for messages, e.g. `project`.

        Raises:
            ExportError: if another program holds it, or the file cannot be created.
        """
        self._descriptors: list[int] = []
        try:
            self._descriptors.append(os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o600))
        except OSError as error:
            raise cannot_write(folder / name, error) from None
        try:
            _lock(self._descriptors[0])
            if os.name != "nt":  # open files cannot be removed there
                self._descriptors.append(os.open(folder, os.O_RDONLY))
                _lock_folder(self._descriptors[1])
        except OSError:
            self.release()
            raise ExportError(
                f"the {what} {folder} is open in another program; close it there, or open a copy of the folder"
            ) from None

    def release(self) -> None:
        """Release the lock."""
        descriptors, self._descriptors = self._descriptors, []
        for descriptor in descriptors:
            with contextlib.suppress(OSError):
                os.close(descriptor)


def _lock(descriptor: int) -> None:
    if os.name == "nt":
        import msvcrt

        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _lock_folder(descriptor: int) -> None:
    """Lock a folder where possible; network file systems may support locks on files only."""
    try:
        _lock(descriptor)
    except BlockingIOError:
        raise
    except OSError:
        return
