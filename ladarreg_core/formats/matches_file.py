"""Matches files: picks as JSON (points and lines) or CSV (points)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.errors import ExportError, FormatError
from ladarreg_core.formats.json_file import LARGEST_BYTES, choice, number, read_json_object, write_json
from ladarreg_core.formats.untrusted import PathLike, one_line, reading, shown_name
from ladarreg_core.matches import Pick, PickKind
from ladarreg_core.scan import Scan

MOST_MATCHES = 5_000
"""Limit; operators draw some dozens, detectors find some hundreds."""
_CELL_HEADER = ["row", "column", "u", "v"]
_RAY_HEADER = ["x", "y", "z", "u", "v"]


def read_matches(path: PathLike, scan: Scan) -> list[Pick]:
    """Read picks from JSON or CSV, distinguished by content.

    Args:
        path: the file.
        scan: the scan that cells belong to.

    Raises:
        FormatError: if it is not a matches file, contains more than 5,000 matches, a coordinate is missing or not
            finite, or a cell lies outside the scan.
        ShapeError: if a pick is not a pair of points or lines.
    """
    with reading(path) as file:
        with open(file, "rb") as stream:
            head = stream.read(256).removeprefix(b"\xef\xbb\xbf").lstrip()
        picks = _from_json(file, scan) if head.startswith((b"{", b"[")) else _from_csv(file, scan)
        if not picks:
            raise FormatError("it contains no matches; it needs at least one")
        seen: set[str] = set()
        for pick in picks:
            if pick.id in seen:
                raise FormatError(f"the id {one_line(pick.id, 40)!r} is used by two matches; ids must differ")
            seen.add(pick.id)
        return picks


def write_matches(path: PathLike, picks: Iterable[Pick]) -> None:
    """Write picks as JSON, the scan side as rays.

    Raises:
        ExportError: if the file cannot be written.
    """
    entries = [
        {
            "id": pick.id,
            "kind": pick.kind,
            "scan": pick.scan.tolist(),
            "photo": pick.photo.tolist(),
            "on": pick.on,
            "weight": pick.weight,
        }
        for pick in picks
    ]
    write_json(path, {"version": 1, "scan_coordinates": "ray", "matches": entries})


def write_matches_csv(path: PathLike, picks: Iterable[Pick]) -> None:
    """Write the points among picks as CSV, `x,y,z,u,v`; CSV stores no lines, no weights and not which picks are off.

    Raises:
        ExportError: if the file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_RAY_HEADER)
    writer.writerows([*pick.scan[0].tolist(), *pick.photo[0].tolist()] for pick in picks if pick.kind == "point")
    try:
        Path(path).write_text(text.getvalue(), encoding="utf-8")
    except OSError as error:
        raise ExportError(f"{shown_name(path)} cannot be written: {error.strerror}; check the folder") from error


def _from_json(file: Path, scan: Scan) -> list[Pick]:
    fields = read_json_object(file, "a matches file")
    version = fields.get("version", 1)
    if version != 1:
        raise FormatError(f"it is of version {one_line(repr(version), 30)}; version 1 is read")
    in_cells = choice(fields, "scan_coordinates", ("ray", "cell")) == "cell"
    entries = fields.get("matches")
    if not isinstance(entries, list):
        raise FormatError("the field 'matches' is missing or no list; it must be the list of matches")
    if len(entries) > MOST_MATCHES:
        raise _too_many(f"{len(entries):,}")
    return [_pick(entry, k, scan, in_cells=in_cells) for k, entry in enumerate(entries)]


def _pick(entry: Any, index: int, scan: Scan, *, in_cells: bool) -> Pick:
    if not isinstance(entry, Mapping):
        raise FormatError(f"match {index + 1} is {one_line(repr(entry), 40)}; it must be an object in braces")
    given = entry.get("id", index + 1)
    if isinstance(given, bool) or not isinstance(given, str | int) or given == "":
        raise FormatError(f"match {index + 1} has the id {one_line(repr(given), 40)}; it must be a string or a number")
    name = one_line(given, 40)
    kind: PickKind = "line" if choice(entry, "kind", ("point", "line"), "point") == "line" else "point"
    on = entry.get("on", True)
    if not isinstance(on, bool):
        raise FormatError(f"match {name!r} has 'on' {one_line(repr(on), 40)}; it must be true or false")
    ends = 1 if kind == "point" else 2
    scan_side = _coordinates(entry.get("scan"), ends, 2 if in_cells else 3, f"the scan side of match {name!r}")
    photo = _coordinates(entry.get("photo"), ends, 2, f"the photo side of match {name!r}")
    rays = _rays_of_cells(scan_side, scan, name) if in_cells else scan_side
    return Pick(str(given), kind, rays, photo, on=on, weight=number(entry, "weight", 1.0), origin="file")


def _coordinates(value: Any, ends: int, size: int, what: str) -> FloatArray:
    """Return (ends, size); the outer brackets of a point's only coordinate are optional."""
    if ends == 1 and isinstance(value, list) and len(value) == size and not any(isinstance(v, list) for v in value):
        value = [value]
    fits = isinstance(value, list) and len(value) == ends and all(isinstance(v, list) and len(v) == size for v in value)
    if not fits:
        raise FormatError(f"{what} is {one_line(repr(value), 60)}; it must be {ends} x {size} numbers")
    return np.array([[number({what: x}, what) for x in row] for row in value])


def _rays_of_cells(cells: FloatArray, scan: Scan, name: str) -> FloatArray:
    height, width = scan.shape
    inside = (cells >= -0.5).all() and (cells <= [height - 0.5, width - 0.5]).all()
    rays = scan.geometry.ray_at(cells) if inside else np.full((len(cells), 3), np.nan)
    if not np.isfinite(rays).all():
        raise FormatError(
            f"match {name!r} has the cell {one_line(cells.tolist(), 60)}, which has no ray in this scan of "
            f"{height} x {width} cells; give [row, column] inside it"
        )
    return rays


def _too_many(count: str) -> FormatError:
    return FormatError(
        f"it contains {count} matches; at most {MOST_MATCHES:,} are read: keep the best ones, well spread"
    )


def _from_csv(file: Path, scan: Scan) -> list[Pick]:
    header, *rows = csv_rows(file)
    picks = []
    for line, row in enumerate(rows, start=1):
        values = _csv_numbers(row, line, len(header))
        side = np.array([values[:-2]])
        rays = _rays_of_cells(side, scan, str(line)) if header == _CELL_HEADER else side
        picks.append(Pick(str(line), "point", rays, np.array([values[-2:]]), origin="file"))
    return picks


def csv_rows(file: Path) -> list[list[str]]:
    """Return the cells of a CSV of matches, row by row; the first row is the header, in lower case.

    Raises:
        FormatError: if it is not text, is too large, has another header, or contains more than 5,000 matches.
    """
    size = file.stat().st_size
    if size > LARGEST_BYTES:
        raise FormatError(
            f"it has {size:,} bytes; a matches file has at most {LARGEST_BYTES:,}, and {MOST_MATCHES:,} matches: keep "
            "the best ones, well spread"
        )
    rows: list[list[str]] = []
    try:
        with open(file, encoding="utf-8-sig", newline="") as stream:
            for row in csv.reader(stream):
                if any(cell.strip() for cell in row):
                    rows.append(row)
                    if len(rows) == MOST_MATCHES + 2:
                        raise _too_many(f"more than {MOST_MATCHES:,}")
    except UnicodeDecodeError:
        raise FormatError("it is not text; matches are JSON or CSV") from None
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    if header not in (_CELL_HEADER, _RAY_HEADER):
        raise FormatError(
            f"its first line is {one_line(','.join(header), 60)!r}; matches are JSON, or CSV with the first line "
            "row,column,u,v or x,y,z,u,v"
        )
    return [header, *rows[1:]]


def _csv_numbers(row: list[str], line: int, count: int) -> list[float]:
    try:
        values = [float(cell) for cell in row]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise FormatError(f"match {line} is {one_line(','.join(row), 60)!r}; it must be {count} finite numbers")
    return values
