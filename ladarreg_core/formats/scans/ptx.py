"""Reader of PTX scans: a text file of one or more blocks, each a grid of points with its registration.

A block has ten lines of header (columns, rows; the scanner's position and axes; a 4 x 4 matrix that is multiplied by
points from the left, so that `world_from_scanner` is its transpose), then a line per cell, column by column: x y z
intensity [r g b], where x = y = z = 0 is no return.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError, OptionError, ShapeError, UnderspecifiedError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.number_rows import numbers_of, row_parts
from ladarreg_core.formats.parsing.untrusted import PathLike, as_float32, one_line, reading, require_cells, unit_notes
from ladarreg_core.formats.scans.cloud import scan_of_cloud
from ladarreg_core.formats.scans.intensity import chosen_intensity, colors_as_bytes, require_intensity
from ladarreg_core.formats.scans.scan_request import IntensitySource
from ladarreg_core.formats.scans.world_pose import world_pose
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.progress import Report
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.cloud import in_world_note, moved_pose, where_it_stood
from ladarreg_core.scanner.grid_order import is_scan_grid, order_of, unit_rays
from ladarreg_core.scanner.grids import TabulatedGrid

_HEADER_LINES = 10
_LONGEST_LINE = 1 << 12
_MIN_ROW_BYTES = 6  # `0 0 0` and a line end
_MAX_BLOCKS = 10_000
_SAMPLE = 1 << 16
_PART = 4 << 20
_CELL_BYTES = 300
"""Measured peak memory of a read, bytes per cell."""
_WIDTHS = {3: "x y z", 4: "x y z intensity", 6: "x y z r g b", 7: "x y z intensity r g b"}
_SAME_POSE = 1e-3
_POSE = "the registration"
_DECIDING_CELLS = 1_000_000
_SAMPLED_COLUMNS = 200
_MIN_STEPS = 12
_CLEARLY = 0.5


@dataclass(frozen=True, slots=True)
class PtxBlock:
    """One scan of a PTX file, as its header states it."""

    rows: int
    columns: int
    station: NDArray[np.float64]
    """(4, 4) pose of the scanner, from the registration lines."""
    matrix: NDArray[np.float64]
    """(4, 4) transformation of the points, in the order in which it is printed."""
    width: int
    """Numbers in a line: 3, 4, 6 or 7."""
    begin: int
    """Position of the first point in the file, bytes."""
    end: int
    """Position after the last point."""
    lines: int
    """Lines that follow the header; fewer than cells if the file is truncated."""

    @property
    def has_intensity(self) -> bool:
        """Whether the points have an intensity."""
        return self.width in (4, 7)

    @property
    def has_color(self) -> bool:
        """Whether the points have colours."""
        return self.width in (6, 7)

    @property
    def position(self) -> NDArray[np.float64]:
        """Where the scanner stands in the world (3,), m."""
        return self.matrix[3, :3] if self.matrix[3, :3].any() else self.station[:3, 3]


def sniff_ptx(head: bytes) -> bool:
    """Return whether these are the first bytes of a PTX file."""
    lines = head.removeprefix(b"\xef\xbb\xbf").lstrip().splitlines()[:_HEADER_LINES]
    counts = [len(line.split()) for line in lines]
    if counts != [1, 1, 3, 3, 3, 3, 4, 4, 4, 4]:
        return False
    return all(line.strip().isdigit() for line in lines[:2])


def sniff_ptg(head: bytes) -> bool:
    """Return whether these are the first bytes of a PTG file."""
    return head.startswith(b"PTG\0")


def ptx_blocks(path: PathLike) -> tuple[PtxBlock, ...]:
    """Return the blocks of a PTX file without reading their points: lines are only counted.

    Raises:
        FormatError: if a header is damaged.
    """
    with reading(path) as file, open(file, "rb") as stream:
        size = file.stat().st_size
        blocks: list[PtxBlock] = []
        while (header := _header(stream, len(blocks))) is not None:
            rows, columns, station, matrix = header
            begin = stream.tell()
            if rows * columns * _MIN_ROW_BYTES > size - begin + 2:
                raise FormatError(
                    f"scan {len(blocks)} of the PTX claims {columns:,} x {rows:,} points, but only {size - begin:,} "
                    "bytes follow; the file is truncated"
                )
            width = _width(stream, rows * columns, len(blocks))
            stream.seek(begin)
            end, lines = _skip_lines(stream, rows * columns, size)
            blocks.append(PtxBlock(rows, columns, station, matrix, width, begin, end, lines))
            stream.seek(end)
            if len(blocks) > _MAX_BLOCKS:
                raise FormatError(f"it has more than {_MAX_BLOCKS:,} scans; it is damaged: split it")
        if not blocks:
            raise FormatError("it has no scan; export it again")
        return tuple(blocks)


def _header(stream: BinaryIO, index: int) -> tuple[int, int, NDArray[np.float64], NDArray[np.float64]] | None:
    """Return rows, columns, the scanner's pose and the matrix of the next block; None at the end of the file."""
    lines: list[list[bytes]] = []
    while len(lines) < _HEADER_LINES:
        line = stream.readline(_LONGEST_LINE)
        if not line:
            if not lines:
                return None
            raise FormatError(f"the header of scan {index} ends after {len(lines)} of 10 lines; the file is truncated")
        words = line.removeprefix(b"\xef\xbb\xbf").split()
        if words:
            lines.append(words)
    wanted = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
    for number, (words, count) in enumerate(zip(lines, wanted, strict=True), 1):
        if len(words) != count:
            found = one_line(b" ".join(words).decode("latin-1"), 50)
            raise FormatError(
                f"line {number} of the header of scan {index} is {found!r}; it must be {count} "
                f"number{'s' * (count > 1)}: it is damaged, or the scan before it has more points than it claims"
            )
    sides = []
    for words in lines[:2]:
        if not (words[0].isdigit() and len(words[0]) <= 9):
            found = one_line(words[0].decode("latin-1"), 30)
            raise FormatError(f"scan {index} claims {found!r} columns or rows; it must be a whole number")
        sides.append(int(words[0]))
    require_cells(sides[1], sides[0])
    try:
        values = [[float(word) for word in words] for words in lines[2:]]
    except ValueError:
        raise FormatError(f"the header of scan {index} has words among its numbers; it is damaged") from None
    position, *axes = values[:4]
    station = np.eye(4)
    station[:3, :3] = np.transpose(axes)
    station[:3, 3] = position
    return sides[1], sides[0], station, np.array(values[4:])


def _width(stream: BinaryIO, cells: int, index: int) -> int:
    """Return the count of numbers in the points' lines; cells without a return may have fewer."""
    lines = stream.read(_SAMPLE).splitlines()
    whole = lines[:-1] if len(lines) > 1 else lines
    widths = [len(line.split()) for line in whole[:cells]]
    width = max(widths, default=0)
    if width not in _WIDTHS:
        raise FormatError(
            f"the points of scan {index} have {width} numbers; a PTX has 4 (x y z intensity) or 7 (with r g b)"
        )
    return width


def _skip_lines(stream: BinaryIO, count: int, size: int) -> tuple[int, int]:
    """Return the position after so many lines, and how many there are."""
    done = 0
    while done < count:
        at = stream.tell()
        part = stream.read(_PART)
        if not part:
            break
        ends = part.count(b"\n")
        if done + ends >= count:
            breaks = np.flatnonzero(np.frombuffer(part, np.uint8) == ord("\n"))
            return at + int(breaks[count - done - 1]) + 1, count
        done += ends
        if at + len(part) == size and not part.endswith(b"\n"):  # the last line need not end
            done += 1
    return size, done


def read_ptx(
    path: PathLike,
    *,
    scan_index: int = 0,
    origin: tuple[float, float, float] | None = None,
    intensity: IntensitySource = "auto",
    memory_bytes: int | None = None,
    report: Report | None = None,
) -> Scan:
    """Read one scan of a PTX file.

    Args:
        path: the file.
        scan_index: index of the scan, from 0.
        origin: where the scanner stood in the points' coordinates, m, if they do not form a grid.
        intensity: `luma` takes the luminance of the colours.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress, in bytes.

    Returns:
        The scan in the scanner's frame; row 0 is the top and column 0 the left, whatever the file's order. Points that
        were written in world coordinates, with the scanner's position beside them, are taken back to the scanner.

    Raises:
        FormatError: if it is damaged or truncated, or the points lack what is asked for as the intensity.
        ShapeError: if there are no returns.
        OptionError: if there is no scan with that index.
    """
    with reading(path) as file:
        blocks = ptx_blocks(file)
        if isinstance(scan_index, bool) or not 0 <= scan_index < len(blocks):
            plural = "scan" if len(blocks) == 1 else f"scans, 0 to {len(blocks) - 1}"
            raise OptionError(f"there is no scan {scan_index}; the file contains {len(blocks)} {plural}")
        block = blocks[scan_index]
        require_intensity(
            intensity,
            has_intensity=block.has_intensity,
            has_color=block.has_color,
            what=f"the points of scan {scan_index}",
            fields=_WIDTHS[block.width],
        )
        budget = ReadBudget.of(file.stat().st_size, memory_bytes)
        budget.require_cells(block.rows, block.columns, _CELL_BYTES)
        table = _read_points(file, block, scan_index, report)
        notes: tuple[str, ...] = ()
        if len(blocks) > 1:
            notes = (f"the file contains {len(blocks)} scans; this is scan {scan_index} of 0 to {len(blocks) - 1}",)
        return _to_scan(file.stem, block, table, intensity, origin, budget, notes)


def _read_points(file: Path, block: PtxBlock, index: int, report: Report | None) -> NDArray[np.float64]:
    """Return the points' numbers (cells, width)."""
    cells = block.rows * block.columns
    table = np.empty((cells, block.width))
    done = 0
    short = {7: 4, 6: 3}.get(block.width, 0)
    with open(file, "rb") as stream:
        stream.seek(block.begin)
        for part in row_parts(stream, block.end, report=report, label="reading the points"):
            rows = numbers_of(part, block.width, short=short)
            if done + len(rows) > cells:
                raise FormatError(f"scan {index} has more points than the {cells:,} that it claims; it is damaged")
            table[done : done + len(rows)] = rows
            done += len(rows)
    if done < cells:
        raise FormatError(
            f"scan {index} claims {block.columns:,} x {block.rows:,} points and has {done:,}; the file is truncated: "
            "copy or export it again"
        )
    return table


def _to_scan(
    name: str,
    block: PtxBlock,
    table: NDArray[np.float64],
    source: IntensitySource,
    origin: tuple[float, float, float] | None,
    budget: ReadBudget,
    notes: tuple[str, ...],
) -> Scan:
    shape = block.columns, block.rows  # column by column
    points: FloatArray = table[:, :3].reshape(*shape, 3)
    points[~points.any(axis=-1)] = np.nan
    if not np.isfinite(points).any():
        raise ShapeError("the scan has no returns: every point is zero; it needs measured points")
    points, pose, said = _in_scanner_frame(points, block)
    strength = table[:, 3].reshape(shape) if block.has_intensity else None
    color = None
    if block.has_color:
        color = colors_as_bytes([table[:, k] for k in range(block.width - 3, block.width)]).reshape(*shape, 3)
    del table
    points, pose, more_said = _around_scanner(points, pose, origin)
    said += more_said
    rays = unit_rays(points)
    value, more = chosen_intensity(source, strength, color, shape)
    if not _is_grid(rays):
        header = f"the header says {shape[0]:,} x {shape[1]:,}, but the points are not in this order"
        return scan_of_cloud(
            points.reshape(-1, 3),
            value.ravel(),
            None if color is None else color.reshape(-1, 3),
            name=name,
            origin=origin,
            zero_is_stated=pose is not None,
            stated=_stated(pose),
            world_from_scanner=pose,
            most_cells=budget.most_cells,
            notes=(*notes, *said, header, *more),
        )
    with np.errstate(over="ignore", invalid="ignore"):
        ranges = as_float32(np.linalg.norm(points, axis=-1))
    order = order_of(rays)
    return Scan(
        TabulatedGrid(order.apply(rays)),
        order.apply(ranges),
        order.apply(value),
        color=None if color is None else order.apply(color),
        world_from_scanner=pose,
        name=name,
        notes=(*notes, *said, *more, *unit_notes(ranges)),
    )


def _in_scanner_frame(points: FloatArray, block: PtxBlock) -> tuple[FloatArray, Rigid | None, tuple[str, ...]]:
    """Return the points in the scanner's frame, the scanner's pose (None: not registered) and a note on both.

    Both the registration lines and the matrix state the pose. Where they differ, programs have written either the
    points in world coordinates, with the scanner's position in the registration lines, or no registration lines to
    speak of; the points decide, since only as seen from the scanner are their steps equal.
    """
    by_matrix, by_lines = (_rigid(matrix) for matrix in (block.matrix.T, block.station))
    if by_matrix is None:
        return points, by_lines, ("the registration matrix is not a rotation and a translation; it was left out",)
    if by_lines is None or np.allclose(by_matrix.matrix, by_lines.matrix, atol=_SAME_POSE):
        return points, None if np.array_equal(by_matrix.matrix, np.eye(4)) else by_matrix, ()
    moved: FloatArray = (by_lines.inverse @ by_matrix) @ points
    if _unevenness(moved) < _CLEARLY * _unevenness(points):
        x, y, z = by_lines.translation
        said = f"the points are in world coordinates; the scanner stood at {x:.3f}, {y:.3f}, {z:.3f} m, as stated"
        return moved, by_lines, (said,)
    return points, by_matrix, ()


def _around_scanner(
    points: FloatArray, pose: Rigid | None, origin: tuple[float, float, float] | None
) -> tuple[FloatArray, Rigid | None, tuple[str, ...]]:
    """Return points (C, R, 3) relative to the scanner, its pose, and notes, if they are a grid as seen from there.

    Some programs write points of the world with an identity as the registration, or with the pose beside them.

    Raises:
        OptionError: if an origin is given to a grid that is centred on its scanner.
    """
    if _is_grid(unit_rays(points)):
        if origin is not None and any(origin):
            raise OptionError("origin is given, but the points are a scanner's grid, centred on it; leave it out")
        return points, pose, ()
    stated = _stated(pose)
    known = points.reshape(-1, 3)
    known = known[np.isfinite(known).all(axis=1)]
    if origin is None and not any(_is_grid(unit_rays(points - place)) for _, place in stated):
        try:
            where, said = where_it_stood(known, stated=stated, zero_is_stated=pose is not None)
        except UnderspecifiedError:  # it is asked for when the points are gridded as a cloud
            return points, pose, ()
    else:
        given = origin if origin is not None else stated[0][1]
        where, said = where_it_stood(known, origin=given)
        if origin is None:
            said = [in_world_note(_POSE, where)]
    moved = points - where
    if not where.any() or not _is_grid(unit_rays(moved)):
        return points, pose, ()
    return moved, moved_pose(pose, where, stated), tuple(said)


def _stated(pose: Rigid | None) -> list[tuple[str, FloatArray]]:
    """Return where the scanner stood if the points are in the world already, beside their registration."""
    return [] if pose is None else [(_POSE, pose.translation)]


def _unevenness(points: FloatArray) -> float:
    """Return how much the angular steps along the columns differ, relative to their median."""
    rays = unit_rays(points[:: max(1, len(points) // _SAMPLED_COLUMNS)])
    steps = np.linalg.norm(np.diff(rays, axis=1), axis=-1)
    steps = steps[np.isfinite(steps)]
    if len(steps) < _MIN_STEPS:
        return np.inf
    middle = float(np.median(steps))
    return float(np.median(np.abs(steps - middle))) / middle if middle > 0 else np.inf


def _is_grid(rays: FloatArray) -> bool:
    """Return whether rays (C, R, 3) form a grid; of large ones, the columns in the middle decide if they can."""
    middle, half = len(rays) // 2, max(2, _DECIDING_CELLS // (2 * rays.shape[1]))
    if half < middle and is_scan_grid(rays[middle - half : middle + half]):
        return True
    return is_scan_grid(rays)


def _rigid(matrix: NDArray[np.float64]) -> Rigid | None:
    try:
        return world_pose(matrix, "the registration")
    except FormatError:
        return None
