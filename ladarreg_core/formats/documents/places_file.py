"""Places to be measured: CSV with a line for each point, in a photograph, in the scan, or as coordinates."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading

MAX_PLACES = 10_000
"""Most points of a file."""
_LARGEST_BYTES = 4 << 20
_PHOTO, _CELL, _POINT = ("u", "v"), ("row", "column"), ("x", "y", "z")
_WORDS = ("measurement", "kind", "photo")
_LONGEST_WORD = 60


@dataclass(frozen=True, slots=True)
class Place:
    """A point to be measured."""

    at: tuple[float, ...]
    """u, v of a pixel; row, column of a cell; x, y, z, m; or a ray of the scanner frame."""
    where: str
    """`photo`, `cell`, `point` or, never in a file, `ray`."""
    photo: str = ""
    """Name or id of the photograph; empty: the only one."""
    measurement: str = ""
    """Name of the measurement that it belongs to."""
    kind: str = ""
    """What the measurement is, such as `distance`; empty: not stated here."""
    name: str = ""
    """What messages call it; empty: its place."""
    sigma: float = 0.0
    """Standard deviation of the pick along each axis, pixels of a photograph or rad of a ray, where that is more than
    is stated for all."""


def read_places(path: PathLike) -> list[Place]:
    """Read points to be measured.

    The first line names the columns: `u,v`, `row,column` or `x,y,z`, or several of these of which each line fills one;
    and optionally `measurement` (points of one name belong together, in their order), `kind` and `photo`.

    Raises:
        FormatError: if it is no such file, or a line does not give exactly one place of finite numbers.
    """
    with reading(path) as file:
        header, rows = _rows(file)
        sets = [one for one in (_PHOTO, _CELL, _POINT) if set(one) <= set(header)]
        places = []
        for line, row in enumerate(rows, start=2):
            if len(row) != len(header):
                raise FormatError(f"line {line} has {len(row)} cells, the first line names {len(header)}")
            fields = dict(zip(header, (cell.strip() for cell in row), strict=True))
            given = [one for one in sets if any(fields[name] for name in one)]
            if len(given) != 1:
                wanted = " or ".join(",".join(one) for one in sets)
                raise FormatError(f"line {line} gives {len(given)} places; each line gives one, as {wanted}")
            at = tuple(_number(fields[name], name, line) for name in given[0])
            words = [one_line(fields.get(name, ""), _LONGEST_WORD) for name in _WORDS]
            where = {_PHOTO: "photo", _CELL: "cell", _POINT: "point"}[given[0]]
            places.append(Place(at, where, words[2], words[0], words[1].lower()))
        if not places:
            raise FormatError("it has no points; each line after the first gives one")
        return places


def _rows(file: Path) -> tuple[list[str], list[list[str]]]:
    size = file.stat().st_size
    if size > _LARGEST_BYTES:
        raise FormatError(f"it has {size:,} bytes; a file of points has at most {_LARGEST_BYTES:,}: divide it")
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError("it is not text; points to be measured are CSV") from None
    rows = [row for row in csv.reader(text.splitlines()) if any(cell.strip() for cell in row)]
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    columns = {*_PHOTO, *_CELL, *_POINT}
    whole = [one for one in (_PHOTO, _CELL, _POINT) if set(one) <= set(header)]
    partly = columns & set(header) - {name for one in whole for name in one}
    unknown = set(header) - columns - {*_WORDS}
    if not whole or partly or unknown or len(set(header)) != len(header):
        raise FormatError(
            f"its first line is {one_line(','.join(header), 60)!r}; it must name u,v or row,column or x,y,z (and, "
            "optionally, measurement, kind and photo)"
        )
    if len(rows) - 1 > MAX_PLACES:
        raise FormatError(f"it has {len(rows) - 1:,} points; at most {MAX_PLACES:,} are read: divide it")
    return header, rows[1:]


def _number(text: str, name: str, line: int) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FormatError(f"line {line} has the {name} {one_line(text, 30)!r}; it must be a finite number")
    return value
