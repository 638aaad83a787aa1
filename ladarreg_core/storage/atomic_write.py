"""Durable writing of files: data are on disk when a call returns, and failed appends leave no partial data.

A file is on disk once both it and the folder with its name are synchronised; if that fails, the write has failed.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NoReturn

from ladarreg_core.errors import DiskFullError, ExportError

_NO_SUCH_CALL = frozenset({errno.EINVAL, errno.ENOSYS, getattr(errno, "ENOTSUP", errno.EINVAL)})
"""Errors of file systems that cannot synchronise folders, such as some on a network."""

_FULL = frozenset({errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)})
_MAX_CAUSES = 20  # causes of errors can be circular


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file durably.

    Raises:
        ExportError: if that fails.
    """
    write_chunks(path, (data,))


def write_chunks(path: str | Path, chunks: Iterable[bytes | memoryview]) -> None:
    """Write a file durably, in pieces that need not be in memory at the same time.

    Raises:
        ExportError: if that fails.
    """
    try:
        with open(path, "wb") as file:
            for data in chunks:
                file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise cannot_write(path, error) from None


@contextlib.contextmanager
def replaced_file(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside a file, which replaces the file in one step unless an exception is raised.

    The new content is on disk before it gets the file's name, and so is the name when the block ends.

    Raises:
        ExportError: if the file cannot be replaced.
    """
    target = Path(os.path.abspath(path))
    new = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        yield new
        sync_file(new)
        os.replace(new, target)
        sync_folder(target.parent)
    except OSError as error:
        raise cannot_write(target, error) from None
    finally:
        with contextlib.suppress(OSError):
            new.unlink()


class AppendedFile:
    """A file that is only appended to, in complete pieces: a failed append leaves no partial piece behind.

    The file is kept open, so that appending needs no free file descriptor. If the remains of a failed append cannot be
    truncated at once, they are truncated before the next append.

    Args:
        path: an existing file.
        intact_bytes: length of its intact part; None: the whole file.
    """

    def __init__(self, path: str | Path, *, intact_bytes: int | None = None) -> None:
        self.path = Path(path)
        self._intact_bytes = intact_bytes
        self._descriptor: int | None = None
        self._sync_failed = False

    @property
    def intact(self) -> bool:
        """Whether the path still refers to this file, and everything appended is on disk."""
        if self._sync_failed:
            return False
        try:
            here, there = os.fstat(self._open()), os.stat(self.path)
        except OSError:
            return False
        return os.path.samestat(here, there) and here.st_size >= (self._intact_bytes or 0)

    def append(self, data: bytes) -> None:
        """Append data durably.

        Raises:
            ExportError: if that fails; the file is then restored, at the latest before the next append.
        """
        try:
            descriptor = self._open()
            self._truncate(descriptor)
            try:
                _write_all(descriptor, data)
            except OSError:
                with contextlib.suppress(OSError):
                    self._truncate(descriptor)
                raise
            self._sync(descriptor)
        except OSError as error:
            raise cannot_write(self.path, error) from None
        self._intact_bytes = (self._intact_bytes or 0) + len(data)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def _open(self) -> int:
        if self._descriptor is None:
            self._descriptor = os.open(self.path, os.O_RDWR | os.O_APPEND | getattr(os, "O_BINARY", 0))
        if self._intact_bytes is None:
            self._intact_bytes = os.fstat(self._descriptor).st_size
        return self._descriptor

    def _truncate(self, descriptor: int) -> None:
        if os.fstat(descriptor).st_size > (self._intact_bytes or 0):
            os.ftruncate(descriptor, self._intact_bytes or 0)

    def _sync(self, descriptor: int) -> None:
        sync = getattr(os, "fdatasync", os.fsync)  # a file's times need not be synchronised
        try:
            sync(descriptor)
        except OSError:
            # It is unknown which pages reached the disk: after reporting a failure once, the system may consider all
            # of them written.
            self._sync_failed = True
            with contextlib.suppress(OSError):
                self._truncate(descriptor)
            raise


def _write_all(descriptor: int, data: bytes) -> None:
    """Write all data; a disk that becomes full meanwhile accepts a part of them without an error."""
    left = memoryview(data)
    while left:
        written = os.write(descriptor, left)
        if written == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        left = left[written:]


def cannot_write(path: str | Path, error: OSError) -> ExportError:
    """Return a one-line error for a file or folder that could not be written."""
    reason = (error.strerror or type(error).__name__).lower()
    kind = DiskFullError if is_disk_full(error) else ExportError
    return kind(f"cannot write {path}: {reason}; give a writable folder with enough free space")


def is_disk_full(error: BaseException | None) -> bool:
    """Return whether an error, or what caused it, says that the disk is full or the user's share of it."""
    for _ in range(_MAX_CAUSES):
        if error is None:
            return False
        if isinstance(error, DiskFullError) or (isinstance(error, OSError) and error.errno in _FULL):
            return True
        error = error.__cause__ or error.__context__
    return False


def sync_file(path: str | Path) -> None:
    """Synchronise a file's content to disk.

    Raises:
        OSError: if that fails.
    """
    # Windows synchronises only what is open for writing; elsewhere read-only files are to be synchronised, too.
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: str | Path) -> None:
    """Synchronise a folder's entries to disk where the system supports it.

    Raises:
        OSError: if that fails: changes of its entries may then be lost.
    """
    if os.name == "nt":  # folders cannot be opened there
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NO_SUCH_CALL:
            raise
    finally:
        os.close(descriptor)


def sync_tree(folder: str | Path) -> None:
    """Synchronise a folder to disk with all files and folders in and below it, but not its own name.

    Raises:
        OSError: if that fails.
    """
    for path in files_below(folder):
        if not path.is_symlink():
            sync_file(path)
    for parent, _, _ in os.walk(folder, topdown=False, onerror=raise_error):
        sync_folder(parent)


def files_below(folder: str | Path) -> Iterator[Path]:
    """Yield the files in and below a folder; links to folders are not followed.

    Raises:
        OSError: if a folder cannot be listed; it is not taken for an empty one.
    """
    for parent, _, names in os.walk(folder, onerror=raise_error):
        yield from (Path(parent, name) for name in names)


def make_folder(path: str | Path) -> None:
    """Create a folder with its missing parents, durably; one that exists stays.

    Raises:
        OSError: if that fails.
    """
    wanted = Path(os.path.abspath(path))
    missing = [parent for parent in (wanted, *wanted.parents) if not os.path.lexists(parent)]
    wanted.mkdir(parents=True, exist_ok=True)
    for made in missing:
        sync_folder(made.parent)


def move_file(old: str | Path, new: str | Path) -> None:
    """Give a file another name in one step, durably, replacing any file of that name.

    Raises:
        OSError: if that fails.
    """
    sync_file(old)
    os.replace(old, new)
    # The new folder first: a crash between the two may leave the file in both, never in neither.
    for folder in dict.fromkeys((Path(new).parent, Path(old).parent)):
        sync_folder(folder)


def raise_error(error: OSError) -> NoReturn:
    """Raise an error; as the `onerror` of `os.walk`, which otherwise skips a folder that cannot be listed."""
    raise error
