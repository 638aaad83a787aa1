"""Bytes on the disk, surely."""

from __future__ import annotations

import contextlib
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


def append_bytes(path: str | Path, data: bytes) -> None:
    """Append to a file and wait until the disk has it.

    Raises:
        ExportError: if that fails; a part may have been appended.
    """
    try:
        with open(path, "ab", buffering=0) as file:
            file.write(data)
            sync = getattr(os, "fdatasync", os.fsync)  # a file's times need not be on the disk
            sync(file.fileno())
    except OSError as error:
        raise cannot_write(path, error) from None


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
