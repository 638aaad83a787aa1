"""Reader of clouds in text files: PTS, and XYZ, CSV and TXT with columns named by a header line or by the caller."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from ladarreg_core.errors import FormatError, OptionError, UnderspecifiedError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.number_rows import numbers_of, row_parts
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading
from ladarreg_core.formats.scans.cloud import most_cells_of, scan_of_cloud
from ladarreg_core.formats.scans.intensity import (
    COLOR_NAMES,
    INTENSITY_NAMES,
    chosen_intensity,
    color_names,
    colors_as_bytes,
    field_named,
    intensity_name,
    plain_name,
    require_intensity,
)
from ladarreg_core.formats.scans.scan_request import IntensitySource
from ladarreg_core.foundations.progress import Report
from ladarreg_core.scan import Scan

_HEAD_LINES = 12
_LONGEST_LINE = 1 << 14
_MAX_COLUMNS = 256
_PART = 8 << 20
_AXES = {
    "x": ("x", "x_m", "x_coord", "coord._x", "easting", "east"),
    "y": ("y", "y_m", "y_coord", "coord._y", "northing", "north"),
    "z": ("z", "z_m", "z_coord", "coord._z", "elevation", "height", "altitude"),
}
_PTS_COLUMNS = {
    3: ("x", "y", "z"),
    4: ("x", "y", "z", "intensity"),
    6: ("x", "y", "z", "r", "g", "b"),
    7: ("x", "y", "z", "intensity", "r", "g", "b"),
}
_SKIPPED = ("-", "_", "")
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")
_READ_BYTES = 90
"""Bytes that a point takes while it is read: its row of float64 and the arrays that it becomes."""


@dataclass(frozen=True, slots=True)
class TextLayout:
    """What the first lines of a text file say about its columns."""

    separator: str | None
    """Between the columns; None: white space."""
    names: tuple[str, ...]
    """Names of the columns; empty: there are none."""
    width: int
    """Columns of the first row of numbers."""
    first_row: str
    """The first row of numbers."""
    data_offset: int
    """Position of the first row of numbers in the file, bytes."""
    count: int | None
    """Number of points as stated above them."""

    @property
    def is_pts(self) -> bool:
        """Whether it is a PTS file: a count, then points without names."""
        return self.count is not None and not self.names and self.width in _PTS_COLUMNS


def sniff_pts(head: bytes) -> bool:
    """Return whether these are the first bytes of a PTS file."""
    layout = _layout_of(head)
    return layout is not None and layout.is_pts


def sniff_text_cloud(head: bytes) -> bool:
    """Return whether these are the first bytes of a text file of points, with or without names of its columns."""
    layout = _layout_of(head)
    if layout is None:
        return False
    if not layout.names:
        return layout.width >= 3
    plain = {plain_name(name) for name in layout.names}
    return _position(layout.names) is not None and not {"u", "v"} <= plain  # x, y, z, u, v are matches


def _layout_of(head: bytes) -> TextLayout | None:
    """Return the layout of a file by its first bytes, whole lines only; None if it is no text of numbers."""
    text = head.removeprefix(b"\xef\xbb\xbf")
    if b"\0" in text:
        return None
    at = len(head) - len(text)
    names: tuple[str, ...] = ()
    count: int | None = None
    for line in text.splitlines(keepends=True)[: _HEAD_LINES + 1]:
        shown = line.decode("latin-1").strip()
        plain = shown.lstrip("/#;%!").strip()
        separator = _separator(plain)
        cells = _cells(plain, separator)
        if not plain:
            pass
        elif plain == shown and len(cells) == 1 and _is_whole(cells[0]) and count is None:
            count = int(cells[0])
        elif plain == shown and (_are_numbers(cells, is_named=bool(names)) or _decimal_commas(plain)):
            return TextLayout(separator, names, len(cells), shown, at, count) if len(cells) <= _MAX_COLUMNS else None
        elif _position(cells) is not None:
            names = tuple(cells)
        elif plain == shown:
            return None  # neither numbers nor names nor a comment
        at += len(line)
    return None


def _separator(line: str) -> str | None:
    """Return the separator of a line's columns; None: white space."""
    return next((mark for mark in (";", "\t", ",") if mark in line), None) if not _decimal_commas(line) else None


def _cells(line: str, separator: str | None) -> list[str]:
    cells = [cell.strip() for cell in line.split(separator)]
    return cells[:-1] if separator is not None and len(cells) > 1 and not cells[-1] else cells


def _is_whole(word: str) -> bool:
    return word.isascii() and word.isdigit() and len(word) <= 12


def _are_numbers(cells: Sequence[str], *, is_named: bool) -> bool:
    """Return whether these are a point's columns: three numbers, which come first unless the columns have names."""
    return sum(_is_number(cell) for cell in (cells if is_named else cells[:3])) >= 3


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _decimal_commas(line: str) -> bool:
    """Return whether a line's numbers have decimal commas: three or more, in columns that something else separates."""
    words = [word for word in re.split(r"[;\s]+", line) if word]
    return len(words) >= 3 and sum(_DECIMAL_COMMA.fullmatch(word) is not None for word in words) >= 3


def _position(names: Sequence[str]) -> tuple[str, str, str] | None:
    x, y, z = (field_named(names, _AXES[axis]) for axis in "xyz")
    return (x, y, z) if x is not None and y is not None and z is not None else None


def read_text_cloud(
    path: PathLike,
    *,
    origin: tuple[float, float, float] | None = None,
    intensity: IntensitySource = "auto",
    columns: Sequence[str] = (),
    memory_bytes: int | None = None,
    report: Report | None = None,
) -> Scan:
    """Read a cloud in a text file as a scan.

    Args:
        path: a PTS file (a count, then x y z intensity [r g b]), or rows of numbers separated by white space, commas,
            semicolons or tabs, whose columns a header line names.
        origin: where the scanner stood, in the file's coordinates, m.
        intensity: `luma` takes the luminance of the colours.
        columns: names of the columns, one each, `-` for one that is skipped; they replace those of the file.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress.

    Returns:
        The scan, on a grid of directions.

    Raises:
        FormatError: if the columns are not known, lack what is asked for as the intensity, have decimal commas, or a
            row is damaged.
        ShapeError: if there are too few returns for a grid.
        OptionError: if `columns` does not fit the file.
    """
    with reading(path) as file:
        size = file.stat().st_size
        with open(file, "rb") as stream:
            layout = _layout_of(_first_lines(stream))
            if layout is None:
                raise FormatError("it does not begin with rows of numbers; a cloud needs x, y, z and intensity")
            if _decimal_commas(layout.first_row):
                raise FormatError(
                    f"its numbers have decimal commas ({one_line(layout.first_row, 50)!r}), and only decimal points "
                    "are read: export it again with points, or replace the commas"
                )
            names = _names(layout, tuple(columns))
            places = _places(names, intensity)
            stream.seek(layout.data_offset)
            lines = _count_lines(stream)
            stream.seek(layout.data_offset)
            budget = ReadBudget.of(size, memory_bytes)
            most_cells = most_cells_of(budget, lines, _READ_BYTES)
            table = np.empty((lines, len(places)), np.float64)
            done = 0
            wanted = tuple(places.values())
            for part in row_parts(stream, size, report=report, label="reading the points"):
                rows = numbers_of(part, len(wanted), separator=layout.separator, columns=wanted)
                table[done : done + len(rows)] = rows
                done += len(rows)
        if layout.count is not None and layout.is_pts and done < layout.count:
            raise FormatError(
                f"it claims {layout.count:,} points and contains {done:,}; it is truncated: copy or export it again"
            )
        table = table[:done]
        at = {name: k for k, name in enumerate(places)}
        color = None
        if "r" in at:
            color = colors_as_bytes([table[:, at[name]] for name in "rgb"])
        points = table[:, :3]
        laser = table[:, at["intensity"]] if "intensity" in at else None
        value, said = chosen_intensity(intensity, laser, color, points.shape[:-1])
        return scan_of_cloud(
            points,
            value,
            color,
            name=file.stem,
            origin=origin,
            most_cells=most_cells,
            notes=said,
        )


def _first_lines(stream: BinaryIO) -> bytes:
    return b"".join(stream.readline(_LONGEST_LINE) for _ in range(_HEAD_LINES + 1))


def _count_lines(stream: BinaryIO) -> int:
    """Return the number of lines from here to the end, an unfinished one included."""
    count, last = 0, b"\n"
    while part := stream.read(_PART):
        count += part.count(b"\n")
        last = part[-1:]
    return count + (last != b"\n")


def _names(layout: TextLayout, asked: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the file's columns: as asked for, as in its header, or as PTS has them."""
    if asked:
        if len(asked) != layout.width:
            raise OptionError(
                f"`columns` names {len(asked)} columns, and the first row has {layout.width} "
                f"({one_line(layout.first_row, 60)!r}); name each, with - for one that is skipped"
            )
        plain = [plain_name(name) for name in asked if name not in _SKIPPED]
        known = {*INTENSITY_NAMES, *(name for group in (*_AXES.values(), *COLOR_NAMES) for name in group)}
        if unknown := [name for name in plain if name not in known]:
            raise OptionError(
                f"`columns` has the name {one_line(unknown[0], 30)!r}; x, y, z, intensity, r, g, b and - (skipped) are "
                "known"
            )
        if len(set(plain)) < len(plain) or _position(asked) is None:
            raise OptionError(
                f"`columns` is {one_line(','.join(asked), 60)!r}; it must name x, y and z, and each of its columns once"
            )
        return asked
    if layout.names:
        return layout.names
    if layout.is_pts:
        return _PTS_COLUMNS[layout.width]
    example = _PTS_COLUMNS.get(layout.width, _PTS_COLUMNS[7])[: layout.width]
    padded = ",".join((*example, *("-",) * (layout.width - len(example))))
    raise UnderspecifiedError(
        f"its columns have no names, and which is the intensity cannot be known; its first row is "
        f"{one_line(layout.first_row, 60)!r}: name them, e.g. `columns={one_line(padded, 60)}` (- skips one)"
    )


def _places(names: Sequence[str], source: IntensitySource) -> dict[str, int]:
    """Return the column of x, y, z, of the intensity and of r, g, b where there are any."""
    position, strength, paint = _position(names), intensity_name(names), color_names(names)
    listed = ", ".join(names)
    if position is None:
        raise FormatError(f"its columns are {one_line(listed, 80)}; a scan needs x, y and z: name them by `columns`")
    others = [name for name in names if name not in (*position, *_SKIPPED)]
    if strength is None and paint is None and others:
        raise UnderspecifiedError(
            f"its columns are {one_line(listed, 60)}, none of which is called an intensity: name the column by "
            "`columns`, or skip the others by - to compare the shape alone"
        )
    require_intensity(
        source, has_intensity=strength is not None, has_color=paint is not None, what="its points", fields=listed
    )
    found = dict(zip("xyz", position, strict=True))
    if strength is not None:
        found["intensity"] = strength
    if paint is not None:
        found |= dict(zip("rgb", paint, strict=True))
    return {key: list(names).index(name) for key, name in found.items()}
