"""Matches files: picks as JSON (points and lines) or CSV (points)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ladarreg_core.errors import ExportError, FormatError
from ladarreg_core.formats.parsing.json_file import LARGEST_BYTES, choice, number, read_json_object, write_json
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading, shown_name
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.matches import Pick, PickKind
from ladarreg_core.scan import Scan

MAX_MATCHES = 5_000
"""Limit; operators draw some dozens, detectors find some hundreds."""
_CELL_COLUMNS = ("row", "column")
_POINT_COLUMNS = ("x", "y", "z")
_PHOTO_COLUMNS = ("u", "v")
_MORE_COLUMNS = ("name", "frame")
_UNIT_TOLERANCE = 1e-6
_FARTHEST_M = 1e5
_LONGEST_NAME = 60
Coordinates = Literal["ray", "cell", "point"]
Frame = Literal["scanner", "world"]


def read_matches(path: PathLike, scan: Scan) -> list[Pick]:
    """Read picks from JSON (versions 1 and 2) or CSV, distinguished by content.

    Points, in metres, keep their distance from the scanner as the length of the pick.

    Args:
        path: the file.
        scan: the scan that cells belong to, and that states where the scanner stands in the world.

    Raises:
        FormatError: if it is not a matches file, contains more than 5,000 matches, a coordinate is missing or not
            finite, a cell lies outside the scan, a point lies more than 100 km from the scanner, or points are given in
            the world and the scan does not state where it stands.
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
    """Write picks as JSON, the scan side as rays, or as points in the scanner's frame where a pick has lengths.

    Version 1 of the format is written if no pick has a length or a name, else version 2.

    Raises:
        ExportError: if the file cannot be written.
    """
    picks = list(picks)
    version = 2 if any(pick.lengths_m is not None or pick.name for pick in picks) else 1
    as_points = bool(picks) and all(pick.lengths_m is not None for pick in picks)
    entries = [
        {
            "id": pick.id,
            **({"name": pick.name} if pick.name else {}),
            "kind": pick.kind,
            # a file of both rays and points says which matches are points
            **({} if as_points or pick.lengths_m is None else {"scan_coordinates": "point"}),
            "scan": _scan_side(pick).tolist(),
            "photo": pick.photo.tolist(),
            "on": pick.on,
            "weight": pick.weight,
        }
        for pick in picks
    ]
    frame = {"frame": "scanner"} if any(pick.lengths_m is not None for pick in picks) else {}
    coordinates = "point" if as_points else "ray"
    write_json(path, {"version": version, "scan_coordinates": coordinates, **frame, "matches": entries})


def write_matches_csv(path: PathLike, picks: Iterable[Pick]) -> None:
    """Write the points among picks as CSV, `x,y,z,u,v`, with their names if they have any.

    CSV stores no lines, no weights and not which picks are off. Picks with lengths are written as points in the
    scanner's frame, others as rays.

    Raises:
        ExportError: if some of the points have lengths and others have none, or the file cannot be written.
    """
    points = [pick for pick in picks if pick.kind == "point"]
    if len({pick.lengths_m is None for pick in points}) > 1:
        raise ExportError("CSV cannot mix rays and points with lengths; write JSON, or either of them alone")
    # the frame marks points, also those that happen to be 1 m away
    more = [name for name, given in (("name", any(p.name for p in points)),
                                     ("frame", any(p.lengths_m is not None for p in points))) if given]  # fmt: skip
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*more, *_POINT_COLUMNS, *_PHOTO_COLUMNS])
    for pick in points:
        texts = {"name": pick.name, "frame": "scanner"}
        writer.writerow([*(texts[name] for name in more), *_scan_side(pick)[0].tolist(), *pick.photo[0].tolist()])
    try:
        Path(path).write_text(text.getvalue(), encoding="utf-8")
    except OSError as error:
        raise ExportError(f"{shown_name(path)} cannot be written: {error.strerror}; check the folder") from error


def _scan_side(pick: Pick) -> FloatArray:
    """Return the rays (1 or 2, 3) of a pick, or its points where it has lengths."""
    return pick.scan if pick.lengths_m is None else pick.scan * pick.lengths_m[:, None]


def _from_json(file: Path, scan: Scan) -> list[Pick]:
    fields = read_json_object(file, "a matches file")
    version = fields.get("version", 1)
    if isinstance(version, bool) or version not in (1, 2):
        raise FormatError(f"it is of version {one_line(repr(version), 30)}; versions 1 and 2 are read")
    known = ("ray", "cell") if version == 1 else ("ray", "cell", "point")
    side = _ScanSide(scan, choice(fields, "scan_coordinates", known), _frame_of(fields, "scanner"))
    entries = fields.get("matches")
    if not isinstance(entries, list):
        raise FormatError("the field 'matches' is missing or no list; it must be the list of matches")
    if len(entries) > MAX_MATCHES:
        raise _too_many(f"{len(entries):,}")
    return [_pick(entry, k, side, version) for k, entry in enumerate(entries)]


def _frame_of(fields: Mapping[str, Any], default: Frame) -> Frame:
    return "world" if choice(fields, "frame", ("scanner", "world"), default) == "world" else "scanner"


@dataclass(frozen=True, slots=True)
class _ScanSide:
    """How the scan side of matches is given."""

    scan: Scan
    coordinates: str
    frame: Frame

    def of(self, given: FloatArray, name: str) -> tuple[FloatArray, FloatArray | None]:
        """Return the rays (1 or 2, 3) of coordinates, and their lengths where these are points.

        Raises:
            FormatError: naming the match.
        """
        if self.coordinates == "cell":
            return _rays_of_cells(given, self.scan, name), None
        if self.coordinates == "ray":
            return given, None
        if self.frame == "world":
            world_from_scanner = self.scan.world_from_scanner
            if world_from_scanner is None:
                raise FormatError(
                    f"match {name!r} is a point in the world, but the scan's file does not say where the scanner "
                    "stands in the world; give points in the scanner's frame, or a scan with its pose (E57, PTX, NPZ)"
                )
            # the difference of two large coordinates first: it is exact where a product of them is not
            given = (given - world_from_scanner.translation) @ world_from_scanner.rotation
        lengths = np.linalg.norm(given, axis=-1)
        if not (lengths > 0).all():
            raise FormatError(f"match {name!r} is at the scanner itself; a point must lie in the scene")
        if (lengths > _FARTHEST_M).any():
            where = "the scanner, as its pose in the scan's file says" if self.frame == "world" else "the scanner"
            remedy = (
                "check the coordinates and the pose"
                if self.frame == "world"
                else "coordinates of a survey need the frame 'world', and all are in metres"
            )
            raise FormatError(f"match {name!r} is {lengths.max():,.0f} m from {where}; {remedy}")
        return given / lengths[:, None], lengths


def _pick(entry: Any, index: int, side: _ScanSide, version: int) -> Pick:
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
    if version == 2 and ("scan_coordinates" in entry or "frame" in entry):
        own = choice(entry, "scan_coordinates", ("ray", "cell", "point"), side.coordinates)
        side = replace(side, coordinates=own, frame=_frame_of(entry, side.frame))
    size = 2 if side.coordinates == "cell" else 3
    scan_side = _coordinates(entry.get("scan"), ends, size, f"the scan side of match {name!r}")
    photo = _coordinates(entry.get("photo"), ends, 2, f"the photo side of match {name!r}")
    title = entry.get("name", "") if version == 2 else ""
    if isinstance(title, bool) or not isinstance(title, str | int):
        raise FormatError(f"match {name!r} has the name {one_line(repr(title), 40)}; it must be a string or a number")
    rays, lengths = side.of(scan_side, one_line(title, 40) or name)
    return Pick(
        str(given),
        kind,
        rays,
        photo,
        on=on,
        weight=number(entry, "weight", 1.0),
        origin="file",
        lengths_m=lengths,
        name=one_line(title, _LONGEST_NAME),
    )


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
        f"it contains {count} matches; at most {MAX_MATCHES:,} are read: keep the best ones, well spread"
    )


def _from_csv(file: Path, scan: Scan) -> list[Pick]:
    header, *rows = csv_rows(file)
    in_cells = "row" in header
    columns = [header.index(name) for name in (*(_CELL_COLUMNS if in_cells else _POINT_COLUMNS), *_PHOTO_COLUMNS)]
    parsed = []
    for line, row in enumerate(rows, start=1):
        more = {
            name: row[header.index(name)].strip()
            for name in _MORE_COLUMNS
            if name in header and len(row) == len(header)
        }
        values = _csv_numbers(row, line, columns, len(header))
        parsed.append((np.array([values[:-2]]), np.array([values[-2:]]), more))
    sides = np.array([side[0] for side, _, _ in parsed]).reshape(len(parsed), len(columns) - 2)
    unit = in_cells or (np.abs(np.linalg.norm(sides, axis=1) - 1) <= _UNIT_TOLERANCE).all()
    coordinates: Coordinates = "cell" if in_cells else "ray" if unit and "frame" not in header else "point"
    picks = []
    for line, (side, photo, more) in enumerate(parsed, start=1):
        name = one_line(more.get("name", ""), _LONGEST_NAME)
        frame = _frame_of({"frame": more["frame"].lower()} if more.get("frame") else {}, "scanner")
        rays, lengths = _ScanSide(scan, coordinates, frame).of(side, name or str(line))
        picks.append(Pick(str(line), "point", rays, photo, origin="file", lengths_m=lengths, name=name))
    return picks


def csv_rows(file: Path) -> list[list[str]]:
    """Return the cells of a CSV of matches, row by row; the first row is the header, in lower case.

    Raises:
        FormatError: if it is not text, is too large, has another header, or contains more than 5,000 matches.
    """
    size = file.stat().st_size
    if size > LARGEST_BYTES:
        raise FormatError(
            f"it has {size:,} bytes; a matches file has at most {LARGEST_BYTES:,}, and {MAX_MATCHES:,} matches: keep "
            "the best ones, well spread"
        )
    rows: list[list[str]] = []
    try:
        with open(file, encoding="utf-8-sig", newline="") as stream:
            for row in csv.reader(stream):
                if any(cell.strip() for cell in row):
                    rows.append(row)
                    if len(rows) == MAX_MATCHES + 2:
                        raise _too_many(f"more than {MAX_MATCHES:,}")
    except UnicodeDecodeError:
        raise FormatError("it is not text; matches are JSON or CSV") from None
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    main = sorted(name for name in header if name not in _MORE_COLUMNS)
    known = (sorted((*first, *_PHOTO_COLUMNS)) for first in (_CELL_COLUMNS, _POINT_COLUMNS))
    if main not in known or len(set(header)) != len(header):
        is_ours = {*_PHOTO_COLUMNS} <= {*header}
        named = f"is {one_line(','.join(header), 60)!r}" if is_ours else "names no columns of matches"
        raise FormatError(
            f"its first line {named}; matches are JSON, or CSV with the first line "
            "row,column,u,v or x,y,z,u,v (and, optionally, name and frame)"
        )
    return [header, *rows[1:]]


def _csv_numbers(row: list[str], line: int, columns: list[int], count: int) -> list[float]:
    try:
        values = [float(row[k]) for k in columns] if len(row) == count else []
    except ValueError:
        values = []
    if not values or not all(map(math.isfinite, values)):
        raise FormatError(
            f"match {line} is {one_line(','.join(row), 60)!r}; it must be {count} cells, {len(columns)} of them finite "
            "numbers"
        )
    return values
