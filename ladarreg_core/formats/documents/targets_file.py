"""Files of survey targets: their surveyed coordinates, and where each was picked in which scan, if it was; CSV."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.csv_table import read_csv_table
from ladarreg_core.formats.parsing.untrusted import one_line, reading

_PICK, _PLACE = ("row", "column"), ("x", "y", "z")
_SIZES = ("radius_m", "side_m")
_SCAN = "scan"
_MAX_BYTES = 4 << 20
_HEAD_BYTES = 1 << 12
_NEEDS = (
    "a CSV with the columns name, x, y, z, row and column if they were picked, scan if in several, and, where targets "
    "differ, radius_m or side_m"
)
_MAX_SHOWN = 8


@dataclass(frozen=True, slots=True)
class TargetEntry:
    """A line of the file."""

    name: str
    """Its name, which is unique in a scan."""
    pick: tuple[int, int] | None
    """Row and column of a cell on it; None: the file has no such columns."""
    coordinates: tuple[float, float, float] | None
    """Surveyed, m; None: it was not, but it was picked."""
    radius_m: float | None = None
    """Of the sphere; None: not said."""
    side_m: float | None = None
    """Of the quadrants of a flat one; None: it is a sphere, or not said."""
    scan: str | None = None
    """Name of the scan that it was picked in; None: the file has no such column."""

    def size_or(self, *, radius_m: float | None = None, side_m: float | None = None) -> dict[str, float]:
        """Return what `fit_target` is to be told of its size, where the file is silent by what is given; or nothing."""
        own = {"radius_m": self.radius_m, "side_m": self.side_m}
        stated = own if any(own.values()) else {"radius_m": radius_m, "side_m": side_m}
        return {name: size for name, size in stated.items() if size is not None}


def is_targets_file(path: str | Path) -> bool:
    """Return whether a file is a table of targets, by its first line: it has names, which a cloud has not."""
    try:
        with open(path, "rb") as stream:
            head = stream.read(_HEAD_BYTES)
        lines = [line for line in head.decode("utf-8-sig").splitlines() if line.strip() and line.lstrip()[0] != "#"]
    except (OSError, UnicodeDecodeError):
        return False
    cells = {cell.strip().lower() for cell in lines[0].replace(";", ",").split(",")} if lines else set()
    return "name" in cells and len(cells) > 1


def surveyed_coordinates(entries: Sequence[TargetEntry]) -> dict[str, tuple[float, float, float]]:
    """Return the coordinates of the targets of a file, by name; those that were not surveyed are not among them."""
    return {one.name: one.coordinates for one in entries if one.coordinates is not None}


def read_targets(path: str | Path) -> list[TargetEntry]:
    """Read a file of survey targets.

    Raises:
        FormatError: if it is no such file; all faults of its lines are listed.
    """
    with reading(path) as file:
        header, rows = read_csv_table(file, most_bytes=_MAX_BYTES, needs=_NEEDS)
        picked = any(name in header for name in _PICK)
        placed = not picked or any(name in header for name in _PLACE)
        needed = ("name", *(_PICK if picked else ()), *(_PLACE if placed else ()))
        missing = [name for name in needed if name not in header]
        unknown = [name for name in header if name not in ("name", *_PICK, *_PLACE, *_SIZES, *(picked * (_SCAN,)))]
        if missing or unknown or len(set(header)) != len(header):
            raise FormatError(f"its first line is {one_line(','.join(header), 60)!r}; give {_NEEDS}")
        faults: list[str] = []
        found = [
            entry for number, row in enumerate(rows, start=1)
            if (entry := _entry(number, dict(zip(header, row, strict=False)), len(row) - len(header), faults))
        ]  # fmt: skip
        faults += [
            f"{count} targets{'' if scan is None else f' in scan {one_line(scan, 30)}'} are called {one_line(name, 30)}"
            for (scan, name), count in Counter((one.scan, one.name) for one in found).items() if count > 1
        ]  # fmt: skip
        coordinates = surveyed_coordinates(found)
        faults += [
            f"target {one_line(name, 30)} has several coordinates"
            for name in dict.fromkeys(
                one.name for one in found if one.coordinates not in (None, coordinates.get(one.name))
            )
        ]  # fmt: skip
        if not rows:
            faults.append("it has no targets; each line after the first gives one")
        if faults:
            more = f"; and {len(faults) - _MAX_SHOWN} more" if len(faults) > _MAX_SHOWN else ""
            raise FormatError(f"{'; '.join(faults[:_MAX_SHOWN])}{more}")
        return found


def _entry(number: int, cells: dict[str, str], surplus: int, faults: list[str]) -> TargetEntry | None:
    name = cells.get("name", "")
    called = f"target {number}" if not name else f"target {one_line(name, 30)}"
    if surplus > 0 or not name:
        faults.append(f"{called} has {'too many cells' if surplus > 0 else 'no name'}")
        return None
    picked = _PICK if _PICK[0] in cells else ()
    placed = _PLACE if not picked or any(cells.get(key) for key in _PLACE) else ()
    values = {key: _number(cells.get(key, "")) for key in (*placed, *picked)}
    wrong = [key for key, value in values.items() if value is None or (key in _PICK and (value < 0 or value % 1))]
    sizes = {key: _number(cells[key]) if cells.get(key) else None for key in _SIZES}
    wrong += [key for key, size in sizes.items() if cells.get(key) and (size is None or size <= 0)]
    if wrong:
        given = ", ".join(f"{key} {one_line(cells.get(key, '') or 'empty', 20)}" for key in wrong)
        faults.append(f"{called} has {given}; rows and columns are whole numbers from 0, lengths are in metres")
        return None
    if None not in sizes.values():
        faults.append(f"{called} has both radius_m and side_m; a target is a sphere or flat")
        return None
    if _SCAN in cells and not cells[_SCAN]:
        faults.append(f"{called} names no scan")
        return None
    numbers = {key: value for key, value in values.items() if value is not None}
    at = (int(numbers["row"]), int(numbers["column"])) if picked else None
    place = (numbers["x"], numbers["y"], numbers["z"]) if placed else None
    return TargetEntry(name, at, place, sizes["radius_m"], sizes["side_m"], cells.get(_SCAN))


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
