"""Rows of numbers in text files, read in parts, with the position of what is damaged."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.foundations.progress import Progress, Report

_PART = 8 << 20
_LONGEST_ROW = 1 << 16


def row_parts(stream: BinaryIO, end: int, *, report: Report | None = None, label: str = "reading") -> Iterator[bytes]:
    """Yield the bytes from the stream's position to `end` in parts that end with a line; report the progress.

    Raises:
        FormatError: if a line is longer than 64 kB.
    """
    begin = stream.tell()
    while (at := stream.tell()) < end:
        if report is not None:
            report(Progress(at - begin, end - begin, label))
        part = stream.read(min(_PART, end - at))
        if not part:
            return
        if stream.tell() < end and not part.endswith(b"\n"):
            part += stream.readline(min(_LONGEST_ROW, end - stream.tell()))
            if stream.tell() < end and not part.endswith(b"\n"):
                raise FormatError("it has a line of more than 64 kB; it is damaged or not a text file of points")
        yield part
    if report is not None:
        report(Progress(end - begin, end - begin, label))


def numbers_of(
    part: bytes, width: int, *, separator: str | None = None, columns: tuple[int, ...] | None = None, short: int = 0
) -> NDArray[np.float64]:
    """Return the rows of a part (N, width), blank lines left out.

    Args:
        part: whole lines.
        width: numbers in a row.
        separator: between the numbers; None: any white space.
        columns: the columns that are returned, width many; None: the row has `width` numbers.
        short: a row may also have only this many numbers, the others are then zero; 0: it may not.

    Raises:
        FormatError: showing the first line that is not such a row.
    """
    if not part.strip():
        return np.zeros((0, width))
    try:
        table = _table(part, separator, columns)
        if table.shape[1] == width:
            return table
    except ValueError:
        pass
    rows = []  # line by line, either to mend the rows or to show the first that is wrong
    mark = None if separator is None else separator.encode()
    for line in part.splitlines():
        text = line.strip()
        if not text or text.startswith((b"#", b"//")):
            continue
        cells = [cell.strip() for cell in text.split(mark)]
        if len(cells) == 1 and width > 1 and cells[0].isdigit():
            continue  # another count of points
        if short and len(cells) == short:
            cells += [b"0"] * (width - short)
        elif columns is None and len(cells) != width:
            raise FormatError(f"the line {_shown(text)} has {len(cells)} numbers instead of {width}; it is damaged")
        elif columns is not None and len(cells) <= max(columns):
            raise FormatError(
                f"the line {_shown(text)} has {len(cells)} columns instead of {max(columns) + 1} or more; it is damaged"
            )
        try:
            rows.append([float(cell or b"nan") for cell in (cells if columns is None else [cells[k] for k in columns])])
        except ValueError:
            raise FormatError(f"the line {_shown(text)} is not a row of numbers; it is damaged") from None
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def _table(part: bytes, separator: str | None, columns: tuple[int, ...] | None) -> NDArray[np.float64]:
    return np.loadtxt(
        io.BytesIO(part), dtype=np.float64, delimiter=separator, comments=None, usecols=columns, ndmin=2,
        encoding="latin-1",
    )  # fmt: skip


def _shown(text: bytes) -> str:
    return repr(one_line(text[:200].decode("latin-1"), 60))
