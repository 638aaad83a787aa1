"""Bytes on the disk, surely."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

from ladarreg_core.errors import ExportError


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file and wait until the disk has it.

    Raises:
        ExportError: if that fails.
    """
    try:
        with open(path, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise cannot_write(path, error) from None


class AppendedFile:
    """A file that only grows, by whole pieces: an append that fails leaves no part of it behind.

    The file is kept open, so that appending needs no free file descriptor. What lies behind the sound length, because
    a failed append could not be cut off at once, is cut off before the next one.

    Args:
        path: an existing file.
        sound: how many of its bytes are sound; None: all of them.
    """

    def __init__(self, path: str | Path, *, sound: int | None = None) -> None:
        self.path = Path(path)
        self._sound = sound
        self._descriptor: int | None = None
        self._unsure = False

    @property
    def intact(self) -> bool:
        """Whether the path still leads to this file and the disk has all that was appended to it."""
        if self._unsure:
            return False
        try:
            here, there = os.fstat(self._opened()), os.stat(self.path)
        except OSError:
            return False
        return os.path.samestat(here, there) and here.st_size >= (self._sound or 0)

    def append(self, data: bytes) -> None:
        """Append and wait until the disk has it.

        Raises:
            ExportError: if that fails; the file is as it was before, at the latest when the next piece is appended.
        """
        try:
            descriptor = self._opened()
            self._cut(descriptor)
            try:
                _write_all(descriptor, data)
            except OSError:
                with contextlib.suppress(OSError):
                    self._cut(descriptor)
                raise
            self._sync(descriptor)
        except OSError as error:
            raise cannot_write(self.path, error) from None
        self._sound = (self._sound or 0) + len(data)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def _opened(self) -> int:
        if self._descriptor is None:
            self._descriptor = os.open(self.path, os.O_RDWR | os.O_APPEND | getattr(os, "O_BINARY", 0))
        if self._sound is None:
            self._sound = os.fstat(self._descriptor).st_size
        return self._descriptor

    def _cut(self, descriptor: int) -> None:
        if os.fstat(descriptor).st_size > (self._sound or 0):
            os.ftruncate(descriptor, self._sound or 0)

    def _sync(self, descriptor: int) -> None:
        sync = getattr(os, "fdatasync", os.fsync)  # a file's times need not be on the disk
        try:
            sync(descriptor)
        except OSError:
            # Which of the pages reached the disk is unknown, also of those that were synchronised by mistake before:
            # the system may take all of them for written after it has said once that they are not.
            self._unsure = True
            with contextlib.suppress(OSError):
                self._cut(descriptor)
            raise


def _write_all(descriptor: int, data: bytes) -> None:
    """Write everything; a disk that runs full in the middle of a piece takes a part of it without an error."""
    left = memoryview(data)
    while left:
        written = os.write(descriptor, left)
        if written == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        left = left[written:]


def cannot_write(path: str | Path, error: OSError) -> ExportError:
    """Return the one-line error for a file or folder that could not be written."""
    reason = (error.strerror or type(error).__name__).lower()
    return ExportError(f"cannot write {path}: {reason}; give a folder that is writable and has room")


def sync_folder(folder: Path) -> None:
    """Have the disk know the folder's entries, where the system can say so."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
