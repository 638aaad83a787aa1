"""Reader of E57 scans: structured grids with one ray per point, and clouds gridded by spherical projection."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError, OptionError, ShapeError
from ladarreg_core.formats.e57.header import E57Info, E57ScanInfo, contents_of
from ladarreg_core.formats.e57.records import read_records
from ladarreg_core.formats.e57.tree import E57File, open_e57
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import LARGEST_GRID_CELLS, PathLike, one_line, reading, unit_notes
from ladarreg_core.formats.scans.cloud import scan_of_cloud
from ladarreg_core.formats.scans.grid_assembly import GridAssembly
from ladarreg_core.formats.scans.intensity import require_intensity
from ladarreg_core.formats.scans.scan_request import IntensitySource
from ladarreg_core.foundations.arrays import ByteArray, FloatArray, IntArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.scan import LUMA_NOTE, NO_INTENSITY_NOTE, Scan, luma
from ladarreg_core.scanner.cloud import moved_pose, where_it_stood
from ladarreg_core.scanner.grid_order import is_scan_grid
from ladarreg_core.scanner.gridding import LARGEST_GRID
from ladarreg_core.scanner.ray_table import MAX_FITTED_CELLS

_CHUNK = 131_072  # arrays of a chunk stay in the processor's cache
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_INDICES = ("rowIndex", "columnIndex")
_STATES = ("cartesianInvalidState", "sphericalInvalidState", "isIntensityInvalid")
_MIN_UNIQUE = 0.6
_CELLS_PER_POINT = 200
# Measured peak memory of a read: per point, per field of a point, per point's cell where the grid is full, and per cell
# of a grid that is mostly empty.
_POINT_BYTES = 220
_FIELD_BYTES = 8
_OWN_CELL_BYTES = 200
_CELL_BYTES = 300
# Of a grid with indices: per cell, per cell of the part that is fitted to fill its holes, and per point of a chunk.
_GRID_CELL_BYTES = 32
_FIT_CELL_BYTES = 170
_CHUNK_POINT_BYTES = 330
_DECIDING_CELLS = 1_000_000
_SAMPLED_POINTS = 600_000


def read_e57(
    path: PathLike,
    *,
    scan_index: int = 0,
    origin: tuple[float, float, float] | None = None,
    intensity: IntensitySource = "auto",
    memory_bytes: int | None = None,
    report: Report | None = None,
) -> Scan:
    """Read one scan of an E57 file.

    Args:
        path: the file.
        scan_index: index of the scan, from 0.
        origin: where the scanner stood in the scan's coordinates, (3,) m, for a scan without a grid, or one whose
            points are in the world; None: as the pattern of the points says.
        intensity: `luma` takes the luminance of the colours.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress, in points.

    Returns:
        The scan in the scanner's frame. Row 0 is the top and column 0 the left, whatever the file's order. Points
        without row and column indices are gridded, in at most 8 million cells. A grid of the file's own is kept as it
        is up to 100 million cells, if the memory allows, and thinned beyond.

    Raises:
        FormatError: if it is damaged, has no scan or lacks the intensity asked for, or would need more memory than
            it may use.
        ShapeError: if there are no returns.
        OptionError: if there is no scan with that index.
    """
    with reading(path) as file, open_e57(file) as opened:
        info = contents_of(opened)
        scan = _chosen(info, scan_index)
        _require_fields(scan, intensity)
        budget = ReadBudget.of(file.stat().st_size, memory_bytes)
        fields = len(scan.field_names & {*_CARTESIAN, *_SPHERICAL, *_COLORS, *_INDICES, *_STATES})
        held = scan.points * (_POINT_BYTES + _FIELD_BYTES * fields)
        has_indices = set(_INDICES) <= scan.field_names
        needed = _grid_bytes(scan.points) if has_indices else held + scan.points * _OWN_CELL_BYTES
        budget.require(needed, f"its {scan.points:,} points")
        records = _Records(opened, scan, scan_index, report, intensity)
        if has_indices:
            grid = _assembled(records, budget)
            if grid is not None:
                where, said = _centre_of(grid[0], records, origin)
                if where.any():
                    records.origin = where
                    grid = _assembled(records, budget)
                    assert grid is not None, "its indices made a grid before"
                return _gridded(file.stem, [*_notes(info, scan, intensity), *said], scan, *grid, where)
        budget.require(held + scan.points * _OWN_CELL_BYTES, f"its {scan.points:,} points")
        columns = records.all_columns()
        most_cells = budget.cells_that_fit(_CELL_BYTES, besides_bytes=held)
        return _from_cloud(file.stem, _notes(info, scan, intensity), scan, columns, most_cells, origin)


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


def _require_fields(scan: E57ScanInfo, intensity: IntensitySource) -> None:
    names = scan.field_names
    if not (names >= set(_CARTESIAN) or names >= set(_SPHERICAL)):
        raise FormatError(
            f"its points have {one_line(', '.join(sorted(names)), 80)}; Cartesian or spherical coordinates are needed"
        )
    require_intensity(
        intensity,
        has_intensity="intensity" in names,
        has_color=set(_COLORS) <= names,
        what=f"the points of scan {scan.name!r}",
    )
    if scan.points == 0:
        raise ShapeError(f"scan {scan.name!r} has no points; it needs measured ranges")


class _Records:
    """The point records of one scan, read in chunks.

    Args:
        file: the open file.
        scan: the scan.
        scan_index: its index.
        report: receives the progress, in points.
        intensity: what is read as the intensity.
    """

    def __init__(
        self,
        file: E57File,
        scan: E57ScanInfo,
        scan_index: int,
        report: Report | None,
        intensity: IntensitySource,
    ) -> None:
        self.scan = scan
        self.origin = np.zeros(3)  # where the scanner stood in the coordinates of the points, m
        self._file, self._scan_index, self._report = file, scan_index, report
        position = _CARTESIAN if scan.field_names >= set(_CARTESIAN) else _SPHERICAL
        wanted = (*position, "intensity", *_COLORS, *_INDICES, *_STATES)
        left_out = ("intensity", "isIntensityInvalid") if intensity == "luma" else ()
        self.names = [name for name in wanted if name in scan.field_names and name not in left_out]

    def chunks(self, names: Sequence[str]) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
        """Yield the index of the first point and the fields by name, each (n,); the arrays are used again.

        Indices and states are int64; other fields are float32 if that holds them, else float64.
        """
        scan = self.scan
        stored = {field.name: field.stored for field in scan.fields}
        size = min(_CHUNK, scan.points)
        parts = {}
        for name in names:
            short = stored[name] == "single" or (stored[name] == "integer" and name in _COLORS)
            parts[name] = np.zeros(size, "q" if name in (*_INDICES, *_STATES) else "f" if short else "d")
        points = self._file.scan(self._scan_index).child("points")
        assert points is not None, "the table of contents has it"
        done = 0
        self._say(done)
        for count in read_records(self._file.pages, points, parts, f"scan {scan.name!r}", scaled=True):
            yield done, {name: part[:count] for name, part in parts.items()}
            done += count
            self._say(done)

    def all_columns(self) -> dict[str, NDArray[Any]]:
        """Return the wanted fields by name, each (N,), except the indices."""
        # Points without a grid may be in the coordinates of a survey, which float32 would round to decimetres.
        types: dict[str, Any] = dict.fromkeys((*_CARTESIAN, *_SPHERICAL), np.float64)
        types |= dict.fromkeys(("intensity", *_COLORS), np.float32) | dict.fromkeys(_STATES, np.uint8)
        columns = {name: np.zeros(self.scan.points, types[name]) for name in self.names if name in types}
        for first, parts in self.chunks(list(columns)):
            for name, part in parts.items():
                with np.errstate(over="ignore", invalid="ignore"):
                    columns[name][first : first + len(part)] = part
        return columns

    def _say(self, done: int) -> None:
        if self._report is not None:
            self._report(Progress(done, self.scan.points, f"reading {self.scan.name}"))


def _centre_of(
    grid: GridAssembly, records: _Records, origin: tuple[float, float, float] | None
) -> tuple[NDArray[np.float64], list[str]]:
    """Return where the scanner stood in the coordinates of a grid's points, (3,), which may be the world's, and notes.

    Raises:
        OptionError: if an origin is given to a grid that is centred on its scanner.
        ShapeError: if the coordinates are a map's in single precision.
        UnderspecifiedError: if the points are not seen from zero, and it is not clear from where.
    """
    if not grid.has_returns:
        raise _no_returns(records.scan)
    stride = max(1, int(np.sqrt(grid.rays.shape[0] * grid.rays.shape[1] / _DECIDING_CELLS)))
    rays = grid.rays[::stride, ::stride].astype(np.float64)
    rays[~rays.any(axis=-1)] = np.nan
    if is_scan_grid(rays):
        if origin is not None and any(origin):
            raise OptionError(
                f"origin is {origin}, but scan {records.scan.name!r} has a grid, which is centred on its scanner; "
                "leave it out"
            )
        return np.zeros(3), []
    parts = []
    stride = max(1, records.scan.points // _SAMPLED_POINTS)
    position = [name for name in records.names if name in (*_CARTESIAN, *_SPHERICAL, *_STATES)]
    for _, part in records.chunks(position):
        planes, state = _positions(part)
        points = np.stack([np.asarray(plane, dtype=np.float64) for plane in planes], axis=-1)
        parts.append((points if state is None else points[state == 0])[::stride])
    points = np.concatenate(parts)
    if not len(points):
        return np.zeros(3), []
    return where_it_stood(
        points, origin=origin, stated=_stated(records.scan), zero_is_stated=bool(_stated(records.scan))
    )


def _stated(scan: E57ScanInfo) -> list[tuple[str, FloatArray]]:
    """Return where the scanner stood if the points are in the world already, beside their pose."""
    pose = scan.world_from_scanner
    if pose is None or np.array_equal(pose.matrix, np.eye(4)):  # the identity is written where nothing is known
        return []
    return [("the pose of the scan", pose.translation)]


def _grid_bytes(points: int) -> int:
    """Return the peak memory of reading a full grid of so many points."""
    fitted = min(points, MAX_FITTED_CELLS)
    return points * _GRID_CELL_BYTES + fitted * _FIT_CELL_BYTES + min(points, _CHUNK) * _CHUNK_POINT_BYTES


def _assembled(records: _Records, budget: ReadBudget) -> tuple[GridAssembly, int] | None:
    """Return the filled grid and its thinning; None if the row and column indices are of no use.

    Indices are used only if most of them differ: some writers leave them all zero. The bounds in the header decide on
    the size; if they are missing or wrong, the indices are read twice.
    """
    scan = records.scan
    bounds = None if scan.grid is None else (scan.first_cell, scan.grid)
    for known in (bounds, None):
        first, shape = known or _index_bounds(records)
        if min(shape) < 2 or shape[0] * shape[1] > _CELLS_PER_POINT * scan.points:
            if known is None:
                return None
            continue
        spare = _grid_bytes(scan.points) - scan.points * _GRID_CELL_BYTES
        most = min(budget.cells_that_fit(_GRID_CELL_BYTES, besides_bytes=spare), LARGEST_GRID_CELLS)
        thin = int(np.ceil(np.sqrt(shape[0] * shape[1] / most)))
        try:
            grid = _filled(records, first, shape, thin)
        except IndexError:
            continue
        return None if grid is None else (grid, thin)
    return None


def _index_bounds(records: _Records) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the smallest row and column, and the number of rows and columns."""
    low, high = [2**62, 2**62], [-(2**62), -(2**62)]
    for _, part in records.chunks(_INDICES):
        for k, name in enumerate(_INDICES):
            low[k], high[k] = min(low[k], int(part[name].min())), max(high[k], int(part[name].max()))
    return (low[0], low[1]), (high[0] - low[0] + 1, high[1] - low[1] + 1)


def _filled(records: _Records, first: tuple[int, int], shape: tuple[int, int], thin: int) -> GridAssembly | None:
    """Return the grid of all points; None if too few of their indices differ.

    Raises:
        IndexError: if a point is outside of the grid.
    """
    scan = records.scan
    with_color = set(_COLORS) <= scan.field_names
    grid = GridAssembly((-(-shape[0] // thin), -(-shape[1] // thin)), with_color=with_color)
    low, high, kept = [2**62, 2**62], [-1, -1], 0
    for _, part in records.chunks(records.names):
        cells = []
        for k, name in enumerate(_INDICES):
            index = part[name] - first[k]
            least, most = int(index.min()), int(index.max())
            if least < 0 or most >= shape[k]:
                raise IndexError(name)
            low[k], high[k] = min(low[k], least), max(high[k], most)
            cells.append(index)
        if thin > 1:
            keep = np.flatnonzero((cells[0] % thin == 0) & (cells[1] % thin == 0))
            part = {name: values[keep] for name, values in part.items()}
            cells = [index[keep] // thin for index in cells]
        kept += len(cells[0])
        if not len(cells[0]):
            continue
        points, state = _positions(part)
        if records.origin.any():
            x, y, z = (np.asarray(axis, dtype=np.float64) - at for axis, at in zip(points, records.origin, strict=True))
            points = (x, y, z)
        color = _color_planes(part, scan.color_largest) if with_color else None
        intensity = _strength(part, color, len(cells[0]))
        grid.add(cells[0], cells[1], points, state=state, intensity=intensity, color=color)
    if grid.filled < _MIN_UNIQUE * kept:
        return None
    rows, columns = (slice(low[k] // thin, high[k] // thin + 1) for k in (0, 1))
    if min(high[0] // thin - low[0] // thin, high[1] // thin - low[1] // thin) < 1:
        return None
    whole = (rows.start, rows.stop, columns.start, columns.stop) == (0, grid.shape[0], 0, grid.shape[1])
    return grid if whole else grid.cropped(rows, columns)


def _gridded(
    name: str, notes: list[str], scan: E57ScanInfo, grid: GridAssembly, thin: int, where: NDArray[np.float64]
) -> Scan:
    if thin > 1:
        notes.append(f"the grid was thinned to one row and one column in {thin}")
    geometry, ranges, intensity, color = grid.finish()
    return Scan(
        geometry,
        ranges,
        intensity,
        color=color,
        world_from_scanner=moved_pose(scan.world_from_scanner, where, _stated(scan)),
        name=name,
        notes=(*notes, *unit_notes(ranges)),
    )


def _from_cloud(
    name: str,
    notes: list[str],
    scan: E57ScanInfo,
    columns: dict[str, NDArray[Any]],
    most_cells: int,
    origin: tuple[float, float, float] | None,
) -> Scan:
    """Return the scan of points without usable indices."""
    planes, state = _positions(columns)
    points = np.stack(planes, axis=-1)
    del planes
    for axis in (*_CARTESIAN, *_SPHERICAL):
        columns.pop(axis, None)
    colors = _color_planes(columns, scan.color_largest) if set(_COLORS) <= set(columns) else None
    intensity = _strength(columns, colors, len(points))
    with np.errstate(over="ignore", invalid="ignore"):
        ranges = np.linalg.norm(points, axis=-1)
    returned = np.isfinite(ranges) & (ranges > 0)
    if state is not None:
        returned &= state == 0
    if not returned.any():
        raise _no_returns(scan)
    color = None if colors is None else np.stack(colors, axis=-1)
    keep = np.flatnonzero(returned)
    paint = None if color is None else color[keep]
    return scan_of_cloud(
        points[keep],
        intensity[keep],
        paint,
        name=name,
        origin=origin,
        stated=_stated(scan),
        zero_is_stated=bool(_stated(scan)),
        world_from_scanner=scan.world_from_scanner,
        most_cells=min(most_cells, LARGEST_GRID),
        notes=notes,
    )


def _notes(info: E57Info, scan: E57ScanInfo, intensity: IntensitySource) -> list[str]:
    notes = [LUMA_NOTE] if intensity == "luma" else []
    if intensity == "auto" and "intensity" not in scan.field_names:
        notes.append(NO_INTENSITY_NOTE)
    if len(info.scans) > 1:
        notes.append(f"the file contains {len(info.scans)} scans; this is {scan.name!r}")
    if scan.pose_problem:
        notes.append(scan.pose_problem)
    if info.images:
        count = len(info.images)
        notes.append(f"the file contains {count} embedded image{'s' * (count > 1)} that can be extracted")
    return notes


def _no_returns(scan: E57ScanInfo) -> ShapeError:
    return ShapeError(f"scan {scan.name!r} has no returns: every point is invalid or zero; it needs measured ranges")


def _positions(
    columns: dict[str, NDArray[Any]],
) -> tuple[tuple[FloatArray, FloatArray, FloatArray], IntArray | None]:
    """Return x, y and z (N,), scanner frame, m, and the state (N,): 0 valid, 1 direction only, 2 invalid."""
    if _CARTESIAN[0] in columns:
        x, y, z = (columns[name] for name in _CARTESIAN)
        return (x, y, z), columns.get("cartesianInvalidState")
    distance, azimuth, elevation = (columns[name] for name in _SPHERICAL)
    with np.errstate(invalid="ignore", over="ignore"):
        level = distance * np.cos(elevation)
        x, y, z = level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)
    return (x, y, z), columns.get("sphericalInvalidState")


def _strength(
    columns: dict[str, NDArray[Any]], color: tuple[ByteArray, ByteArray, ByteArray] | None, count: int
) -> NDArray[np.floating]:
    """Return the intensity (N,), NaN where it is invalid; if it was not read, the luminance of the colours, or 0."""
    if "intensity" not in columns:
        if color is None:
            return np.zeros(count, np.float32)
        return luma(np.stack(color, axis=-1))
    if "isIntensityInvalid" not in columns:
        return columns["intensity"]
    return np.where(columns["isIntensityInvalid"] != 0, np.nan, columns["intensity"]).astype(np.float32)


def _color_planes(columns: dict[str, NDArray[Any]], largest: float) -> tuple[ByteArray, ByteArray, ByteArray]:
    scale = 255 / largest if np.isfinite(largest) and largest > 0 else 1.0
    planes = []
    for name in _COLORS:
        values = columns[name]
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.fmin(np.fmax(values if scale == 1 else values * np.float32(scale), 0), 255)  # 0 for NaN
        planes.append(np.rint(values).astype(np.uint8))
    return planes[0], planes[1], planes[2]
