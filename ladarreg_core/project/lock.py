"""The lock of a project's folder: one program at a time, and none after a crash."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from ladarreg_core.errors import ExportError
from ladarreg_core.export.atomic_write import cannot_write


class FolderLock:
    """Holds a folder for as long as the process lives.

    A file in the folder is locked, and the folder itself where the system can lock one: a file can be removed while it
    is locked, and another of the same name would not be.
    """

    def __init__(self, folder: Path, name: str) -> None:
        """Take the lock.

        Args:
            folder: what is held.
            name: of the file in it.

        Raises:
            ExportError: if another program holds it, or the file cannot be made.
        """
        self._descriptors: list[int] = []
        try:
            self._descriptors.append(os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o600))
        except OSError as error:
            raise cannot_write(folder / name, error) from None
        try:
            _lock(self._descriptors[0])
            if os.name != "nt":  # there a file that is open cannot be removed
                self._descriptors.append(os.open(folder, os.O_RDONLY))
                _lock_folder(self._descriptors[1])
        except OSError:
            self.release()
            raise ExportError(
                f"the project {folder} is open in another program; close that, or open a copy of the folder"
            ) from None

    def release(self) -> None:
        """Let others have the folder."""
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
    """Lock a folder; file systems of other machines may lock files only."""
    try:
        _lock(descriptor)
    except BlockingIOError:
        raise
    except OSError:
        return
