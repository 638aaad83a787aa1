"""Guards for untrusted files: checks before reading, and one-line errors for whatever fails inside a file."""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import Cancelled, FormatError, LadarregError
from ladarreg_core.foundations.arrays import FloatArray

PathLike = str | os.PathLike[str]
LARGEST_GRID_CELLS = 100_000_000
"""Largest grid that is read; a scan that claims more cells is refused before anything is allocated."""

_logger = logging.getLogger(__name__)
_LONGEST_LINE = 280
_MEDIAN_VALUES = 1_000_000  # of larger grids a part is looked at
_LONGEST_NAME = 80
_SUSPICIOUS_MEDIAN_M = 200.0


def one_line(text: object, longest: int = _LONGEST_LINE) -> str:
    """Return a text on one line without control characters, shortened in the middle if it is too long."""
    line = " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())
    if len(line) <= longest:
        return line
    keep = (longest - 5) // 2
    return f"{line[:keep]} ... {line[-keep:]}"


def shown_name(path: PathLike) -> str:
    """Return a file's name in a form that is safe to show in an error."""
    text = os.fspath(path)
    return one_line(os.path.basename(text.rstrip("/\\")) or text or "(no name)", _LONGEST_NAME)


@contextmanager
def reading(path: PathLike) -> Iterator[Path]:
    """Yield the path of a readable, non-empty file; any failure inside becomes a one-line error that names the file.

    Raises:
        FormatError: if there is no such file, if it is a folder, a device or empty, or if an exception that is not a
            `LadarregError` was raised inside.
        LadarregError: of the type raised inside, with the file's name in front.
    """
    if not isinstance(path, str | os.PathLike):  # an integer would be taken for a file descriptor
        raise FormatError(f"{one_line(repr(path), 60)} is not a path; give the name of a file")
    try:
        yield _checked(path)
    except (Cancelled, AssertionError):
        raise
    except LadarregError as error:
        raise type(error)(one_line(_named(path, error))) from error
    except MemoryError as error:
        message = _named(path, "it needs more memory than is available; thin it out or split it")
        raise FormatError(one_line(message)) from error
    except RecursionError as error:
        raise FormatError(one_line(_named(path, "it is nested too deeply"))) from error
    except Exception as error:  # the file's bytes decide which library fails, and how
        _logger.debug("reading %s failed", path, exc_info=True)
        reason = one_line(error, 120) or type(error).__name__
        message = _named(path, f"it could not be read ({reason}); it is damaged or has another format than it seems to")
        raise FormatError(one_line(message)) from error


def _named(path: PathLike, message: object) -> str:
    name, text = shown_name(path), str(message)
    return text if text.startswith(f"{name}: ") else f"{name}: {text}"


def _checked(path: PathLike) -> Path:
    try:
        status = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        raise FormatError(f"there is no such file ({one_line(os.fspath(path), 160)}); check the path") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FormatError(f"it cannot be opened: {reason}; check the path") from None
    if stat.S_ISDIR(status.st_mode):
        raise FormatError("it is a folder; give a file")
    if not stat.S_ISREG(status.st_mode):
        raise FormatError("it is a device or a pipe, not a regular file; give a file")
    if status.st_size == 0:
        raise FormatError("it is empty (0 bytes); copy or export it again")
    if not os.access(path, os.R_OK):
        raise FormatError("it cannot be read (permission denied); change its permissions")
    return Path(path)


def inside_folder(folder: Path, name: object, what: str) -> Path:
    """Return the file of that name inside a folder.

    Raises:
        FormatError: if the name is not a relative path, or leads out of the folder, be it through a symbolic link.
    """
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise FormatError(f"{what} is {one_line(repr(name), 60)}; it must be the name of a file next to this one")
    home = folder.resolve()
    target = (home / name).resolve()
    if Path(name).is_absolute() or not target.is_relative_to(home):
        raise FormatError(f"{what} {one_line(repr(name), 60)} leads out of the folder; put the file next to this one")
    return target


def as_float32(values: Any) -> NDArray[np.float32]:
    """Return numbers as float32; values that are too large become infinite, which scans treat as no return."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(values, dtype=np.float32)


def unit_notes(ranges: FloatArray) -> tuple[str, ...]:
    """Return a note if ranges (m, NaN = no return) look like millimetres: if their median exceeds 200 m."""
    stride = max(1, int(np.sqrt(ranges.size / _MEDIAN_VALUES)))
    ranges = ranges[::stride, ::stride] if ranges.ndim == 2 else ranges[:: stride**2]
    known = ranges[np.isfinite(ranges) & (ranges > 0)]
    if not known.size:
        return ()
    median = float(np.median(known))
    if median <= _SUSPICIOUS_MEDIAN_M:
        return ()
    return (
        f"ranges look like millimetres: median {median:,.0f}; they were read as metres: "
        "if that is wrong, divide them by 1000",
    )


def require_cells(rows: int, columns: int) -> None:
    """Refuse a grid of an implausible size.

    Raises:
        FormatError: if a side is not positive, or the grid has more than 100 million cells.
    """
    if rows < 1 or columns < 1:
        raise FormatError(f"the grid is {rows} x {columns} cells; both must be positive")
    if rows * columns > LARGEST_GRID_CELLS:
        raise FormatError(
            f"the grid has {rows:,} x {columns:,} cells; at most {LARGEST_GRID_CELLS:,} can be read: thin it out"
        )
