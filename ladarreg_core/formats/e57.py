"""Reader of E57 scans: structured grids with one ray per point, and clouds gridded by spherical projection."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, ByteArray, FloatArray, IntArray
from ladarreg_core.errors import DependencyError, FormatError, OptionError, ShapeError
from ladarreg_core.formats.budget import ReadBudget
from ladarreg_core.formats.cloud import scan_of_cloud
from ladarreg_core.formats.e57_header import E57Info, E57ScanInfo, read_e57_info
from ladarreg_core.formats.grid_order import order_of, unit_rays
from ladarreg_core.formats.untrusted import PathLike, as_float32, one_line, reading, unit_notes
from ladarreg_core.progress import Progress, Report
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.gridding import LARGEST_GRID
from ladarreg_core.scanner.grids import TabulatedGrid

_CHUNK = 500_000
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_INDICES = ("rowIndex", "columnIndex")
_STATES = ("cartesianInvalidState", "sphericalInvalidState", "isIntensityInvalid")
_LEAST_UNIQUE = 0.6
_CELLS_PER_POINT = 200
# Measured peak memory of a read: per point, per field of a point, per point's cell where the grid is full, and per cell
# of a grid that is mostly empty.
_POINT_BYTES = 160
_FIELD_BYTES = 8
_OWN_CELL_BYTES = 200
_CELL_BYTES = 300


def read_e57(
    path: PathLike,
    *,
    scan_index: int = 0,
    origin: tuple[float, float, float] | None = None,
    memory_bytes: int | None = None,
    report: Report | None = None,
) -> Scan:
    """Read one scan of an E57 file.

    Args:
        path: the file.
        scan_index: index of the scan, from 0.
        origin: where the scanner stood in the scan's coordinates, (3,) m, for a scan without a grid; None: at their
            zero point, unless the pattern of the points says otherwise.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress, in points.

    Returns:
        The scan in the scanner's frame. Row 0 is the top and column 0 the left, whatever the file's order. Points
        without row and column indices are gridded. A grid of more than 8 million cells is thinned.

    Raises:
        FormatError: if it is damaged, has no scan or no intensity, or would need more memory than it may use.
        ShapeError: if there are no returns.
        OptionError: if there is no scan with that index.
    """
    with reading(path) as file:
        info = read_e57_info(file)
        scan = _chosen(info, scan_index)
        _require_fields(scan)
        budget = ReadBudget.of(file.stat().st_size, memory_bytes)
        fields = len(scan.field_names & {*_CARTESIAN, *_SPHERICAL, *_COLORS, *_INDICES, *_STATES})
        held = scan.points * (_POINT_BYTES + _FIELD_BYTES * fields)
        budget.require(held + scan.points * _OWN_CELL_BYTES, f"its {scan.points:,} points")
        with e57_file(file) as image_file:
            columns = _read_points(image_file, scan, scan_index, report)
        most_cells = budget.cells_that_fit(_CELL_BYTES, besides_bytes=held)
        return _to_scan(file.stem, info, scan, columns, most_cells, origin)


def _chosen(info: E57Info, scan_index: int) -> E57ScanInfo:
    if not info.scans:
        other = f"only images ({len(info.images)})" if info.images else "nothing"
        raise FormatError(f"the E57 contains {other} and no scan; give one with points")
    if isinstance(scan_index, bool) or not 0 <= scan_index < len(info.scans):
        names = one_line(", ".join(f"{k} {scan.name!r}" for k, scan in enumerate(info.scans[:6])), 100)
        raise OptionError(
            f"there is no scan {scan_index}; the file contains {len(info.scans)} ({names}): choose by index"
        )
    return info.scans[scan_index]


def _require_fields(scan: E57ScanInfo) -> None:
    names = scan.field_names
    if not (names >= set(_CARTESIAN) or names >= set(_SPHERICAL)):
        raise FormatError(
            f"its points have {one_line(', '.join(sorted(names)), 80)}; Cartesian or spherical coordinates are needed"
        )
    if "intensity" not in names:
        extra = "; its colours come from a camera and are not an intensity" if set(_COLORS) <= names else ""
        raise FormatError(
            f"scan {scan.name!r} has no intensity, which is needed for matching{extra}: export it again with intensity"
        )
    if scan.points == 0:
        raise ShapeError(f"scan {scan.name!r} has no points; it needs measured ranges")


@contextmanager
def e57_file(path: Path) -> Iterator[Any]:
    """Open an E57 file; multi-line errors of the library are shortened to one line.

    Raises:
        DependencyError: if the library is not installed.
        FormatError: if the library cannot read the file.
    """
    try:
        from pye57 import libe57
    except ImportError as error:
        raise DependencyError(
            "reading E57 needs the package pye57, which is not installed: pip install pye57"
        ) from error
    try:
        image_file = libe57.ImageFile(str(path), "r")
        try:
            yield image_file
        finally:
            image_file.close()
    except libe57.E57Exception as error:
        first = str(error).strip().partition("\n")[0].partition(" (Error")[0]
        raise FormatError(f"the E57 is damaged: {one_line(first, 120)}; copy or export it again") from error


def _read_points(image_file: Any, scan: E57ScanInfo, scan_index: int, report: Report | None) -> dict[str, NDArray[Any]]:
    """Return the wanted fields by name, each (N,), read in chunks."""
    from pye57 import libe57

    position = _CARTESIAN if scan.field_names >= set(_CARTESIAN) else _SPHERICAL
    # Points without a grid may be in the coordinates of a survey, which float32 would round to decimetres.
    gridded = scan.field_names >= set(_INDICES)
    precision = np.float32 if position is _CARTESIAN and gridded else np.float64
    types: dict[str, tuple[str, Any]] = dict.fromkeys(position, ("d", precision))
    types |= {"intensity": ("d", np.float32)}
    types |= dict.fromkeys(_COLORS, ("d", np.float32))
    types |= dict.fromkeys(_INDICES, ("q", np.int64))
    types |= dict.fromkeys(_STATES, ("q", np.uint8))
    wanted = [name for name in types if name in scan.field_names]
    chunk = min(_CHUNK, scan.points)
    buffers = libe57.VectorSourceDestBuffer()
    parts = {name: np.zeros(chunk, types[name][0]) for name in wanted}
    for name, part in parts.items():
        buffers.append(libe57.SourceDestBuffer(image_file, name, part, chunk, True, True))
    columns = {name: np.zeros(scan.points, types[name][1]) for name in wanted}
    reader = image_file.root()["data3D"][scan_index]["points"].reader(buffers)
    done = 0
    try:
        while done < scan.points:
            if report is not None:
                report(Progress(done, scan.points, f"reading {scan.name}"))
            count = reader.read()
            if count == 0:
                raise FormatError(f"scan {scan.name!r} ends after {done:,} of {scan.points:,} points; it is truncated")
            count = min(count, scan.points - done)
            for name, part in parts.items():
                with np.errstate(over="ignore", invalid="ignore"):
                    columns[name][done : done + count] = part[:count]
            done += count
    finally:
        reader.close()
    if report is not None:
        report(Progress(done, scan.points, f"reading {scan.name}"))
    return columns


def _to_scan(
    name: str,
    info: E57Info,
    scan: E57ScanInfo,
    columns: dict[str, NDArray[Any]],
    most_cells: int,
    origin: tuple[float, float, float] | None,
) -> Scan:
    points, state = _positions(columns)
    intensity = columns["intensity"]
    if "isIntensityInvalid" in columns:
        intensity = np.where(columns["isIntensityInvalid"] != 0, np.nan, intensity).astype(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        ranges = np.linalg.norm(points, axis=-1)
    returned = np.isfinite(ranges) & (ranges > 0) & (state == 0)
    if not returned.any():
        raise ShapeError(f"scan {scan.name!r} has no returns: every point is invalid or zero; it needs measured ranges")
    ranges = as_float32(np.where(returned, ranges, np.nan))
    color = _color(columns, scan.color_largest)
    notes: list[str] = []
    if len(info.scans) > 1:
        notes.append(f"the file contains {len(info.scans)} scans; this is {scan.name!r}")
    if scan.pose_problem:
        notes.append(scan.pose_problem)
    if info.images:
        count = len(info.images)
        notes.append(f"the file contains {count} embedded image{'s' * (count > 1)} that can be extracted")
    most_cells = min(most_cells, LARGEST_GRID)
    grid = _grid_cells(columns, most_cells)
    if grid is None:
        keep = np.flatnonzero(returned)
        paint = None if color is None else color[keep]
        return scan_of_cloud(
            points[keep],
            intensity[keep],
            paint,
            name=name,
            origin=origin,
            coordinates="scanner",
            world_from_scanner=scan.world_from_scanner,
            most_cells=most_cells,
            notes=notes,
        )
    if any(origin or ()):
        raise OptionError(
            f"origin is {origin}, but scan {scan.name!r} has a grid, which is centred on its scanner; leave it out"
        )
    row, column, shape, thinned = grid
    if thinned > 1:
        notes.append(f"the grid was thinned to one row and one column in {thinned}")
    # State 1: the range is invalid but the direction is valid, and becomes the ray of the empty cell.
    directed = np.flatnonzero((state == 1) & (row >= 0))
    hit = np.flatnonzero(returned & (row >= 0))
    hit = hit[np.argsort(-ranges[hit], kind="stable")]  # the last write wins: the nearest of several returns
    rays = np.full((*shape, 3), np.nan)
    rays[row[directed], column[directed]] = points[directed]
    rays[row[hit], column[hit]] = points[hit]
    grid_ranges, grid_intensity = np.full(shape, np.nan, np.float32), np.zeros(shape, np.float32)
    grid_ranges[row[hit], column[hit]] = ranges[hit]
    grid_intensity[row[hit], column[hit]] = intensity[hit]
    paint = None
    if color is not None:
        paint = np.zeros((*shape, 3), np.uint8)
        paint[row[hit], column[hit]] = color[hit]
    rays = unit_rays(rays)
    turn = order_of(rays)
    return Scan(
        TabulatedGrid(turn.apply(rays)),
        turn.apply(grid_ranges),
        turn.apply(grid_intensity),
        color=None if paint is None else turn.apply(paint),
        world_from_scanner=scan.world_from_scanner,
        name=name,
        notes=(*notes, *unit_notes(grid_ranges)),
    )


def _positions(columns: dict[str, NDArray[Any]]) -> tuple[FloatArray, IntArray]:
    """Return points (N, 3), scanner frame, m, and their state (N,): 0 valid, 1 direction only, 2 invalid."""
    if _CARTESIAN[0] in columns:
        points = np.stack([columns[name] for name in _CARTESIAN], axis=-1)
        state = columns.get("cartesianInvalidState")
    else:
        distance, azimuth, elevation = (columns[name] for name in _SPHERICAL)
        with np.errstate(invalid="ignore", over="ignore"):
            level = distance * np.cos(elevation)
            points = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=-1)
        state = columns.get("sphericalInvalidState")
    return points, np.zeros(len(points), np.uint8) if state is None else state


def _color(columns: dict[str, NDArray[Any]], largest: float) -> ByteArray | None:
    if not set(_COLORS) <= set(columns):
        return None
    scale = 255 / largest if np.isfinite(largest) and largest > 0 else 1.0
    rgb = np.stack([columns[name] for name in _COLORS], axis=-1) * np.float32(scale)
    return np.clip(np.nan_to_num(rgb), 0, 255).round().astype(np.uint8)


def _grid_cells(
    columns: dict[str, NDArray[Any]], most_cells: int
) -> tuple[IntArray, IntArray, tuple[int, int], int] | None:
    """Return each point's row and column (-1 = thinned out), the grid's shape and the thinning; None without a grid.

    Indices are used only if most of them differ: some writers leave them all zero.
    """
    if not set(_INDICES) <= set(columns):
        return None
    row, column = (columns[name] - columns[name].min() for name in _INDICES)
    rows, width = int(row.max()) + 1, int(column.max()) + 1
    if min(rows, width) < 2 or rows * width > _CELLS_PER_POINT * len(row):
        return None
    if len(np.unique(row * width + column)) < _LEAST_UNIQUE * len(row):
        return None
    thin = int(np.ceil(np.sqrt(rows * width / most_cells)))
    if thin > 1:
        away: BoolArray = (row % thin != 0) | (column % thin != 0)
        row, column = np.where(away, -1, row // thin), np.where(away, -1, column // thin)
        rows, width = -(-rows // thin), -(-width // thin)
    return row, column, (rows, width), thin
