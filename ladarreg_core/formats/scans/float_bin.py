"""Reader of headerless .bin clouds of float32 x, y, z, intensity, as of KITTI, with a ring behind them in nuScenes.

A file without a header is recognised by what its numbers mean: three coordinates within the reach of a scanner, an
intensity that is never negative and, in a fifth column, whole numbers. Columns counted wrongly mix coordinates into the
intensity. What is not certain is refused.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import PathLike, reading
from ladarreg_core.formats.scans.cloud import most_cells_of, scan_of_cloud
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.scan import Scan

_MIN_POINTS = 12
_FARTHEST_M = 500.0
_LARGEST_INTENSITY = 65_535.0
_TINY = 1e-9  # integers read as floating point are smaller
_CHUNK = 500_000
_BYTES_PER_POINT = 40
_FOUR, _FIVE = "x, y, z, intensity", "x, y, z, intensity, ring"


def sniff_float_bin(head: bytes, file: Path) -> bool:
    """Return whether a file may be a cloud of float32, by its extension, its size and its first numbers.

    Args:
        head: its first bytes.
        file: its path.
    """
    if file.suffix.lower() != ".bin":
        return False
    size = file.stat().st_size
    return any(size % (4 * columns) == 0 and _plausible(_table(head, columns)) for columns in (4, 5))


def read_float_bin(
    path: PathLike,
    *,
    origin: tuple[float, float, float] | None = None,
    memory_bytes: int | None = None,
    report: Report | None = None,
) -> Scan:
    """Read a cloud of float32 x, y, z (m), intensity and perhaps ring, without a header.

    Args:
        path: the file.
        origin: where the scanner stood, (3,) m in the file's coordinates; None: at their zero point, unless the pattern
            of the points says otherwise.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress, in points.

    Returns:
        The scan in the scanner's frame, whose axes are the file's.

    Raises:
        FormatError: if the numbers are not plausible as four or five columns, or are as both.
        ShapeError: if there are too few returns.
    """
    with reading(path) as file:
        budget = ReadBudget.of(file.stat().st_size, memory_bytes)
        columns = _columns_of(file, budget.file_bytes)
        row_bytes = 4 * columns
        count = budget.file_bytes // row_bytes
        most_cells = most_cells_of(budget, count, _BYTES_PER_POINT)
        values = np.empty((count, columns), np.float32)
        with open(file, "rb") as stream:
            for start in range(0, count, _CHUNK):
                if report is not None:
                    report(Progress(start, count, "reading the cloud"))
                part = np.frombuffer(stream.read(row_bytes * _CHUNK), "<f4").reshape(-1, columns)
                values[start : start + len(part)] = part
        if report is not None:
            report(Progress(count, count, "reading the cloud"))
        if not _plausible(values):
            raise FormatError(
                "its numbers are not x, y, z (m, within 500 m) and an intensity in float32 throughout; it is damaged "
                "or another kind of file: export the cloud as PCD, PLY or LAS"
            )
        what = _FOUR if columns == 4 else _FIVE
        return scan_of_cloud(
            values[:, :3],
            values[:, 3],
            name=file.stem,
            origin=origin,
            ring=values[:, 4].astype(np.int64) if columns == 5 else None,
            most_cells=most_cells,
            notes=[f"the file has no header: it was read as float32 {what}, as its numbers suggest"],
        )


def _columns_of(file: Path, size: int) -> int:
    """Return how many columns the first numbers of a file are: 4 or 5.

    Raises:
        FormatError: if they are neither, or could be both.
    """
    with open(file, "rb") as stream:
        head = stream.read(16 * _CHUNK)
    found = [columns for columns in (4, 5) if size % (4 * columns) == 0 and _plausible(_table(head, columns))]
    if len(found) == 1:
        return found[0]
    what = f"could be both {_FOUR} and {_FIVE}" if found else f"are neither {_FOUR} nor {_FIVE}"
    raise FormatError(
        f"its numbers {what} in float32, which is all that is read without a header: export the cloud as PCD, PLY or "
        "LAS"
    )


def _table(data: bytes, columns: int) -> NDArray[np.float32]:
    """Return the whole rows at the start of data."""
    rows = len(data) // (4 * columns)
    return np.frombuffer(data[: rows * 4 * columns], "<f4").reshape(rows, columns)


def _plausible(table: NDArray[np.float32]) -> bool:
    """Return whether rows are coordinates, an intensity and, in a fifth column, the number of a ring."""
    if len(table) < _MIN_POINTS or not np.isfinite(table).all():
        return False
    sizes = np.abs(table)
    if sizes[:, :3].max() > _FARTHEST_M or table[:, 3].min() < 0 or table[:, 3].max() > _LARGEST_INTENSITY:
        return False
    if np.mean((sizes > 0) & (sizes < _TINY)) > 0.01:
        return False
    if table.shape[1] == 5 and (table[:, 4].min() < 0 or table[:, 4].max() > 255 or (table[:, 4] % 1).any()):
        return False
    returns = table[sizes[:, :3].max(axis=1) > 0, :3]
    if len(returns) < _MIN_POINTS or (table[:, 3] == table[0, 3]).all():
        return False
    # Two axes at least spread over decimetres, on both sides of zero or all on one.
    return bool((np.ptp(returns, axis=0) > 0.1).sum() >= 2)
