"""Reader of headerless .bin clouds of float32 x, y, z, intensity, as of KITTI; refused wherever that is not certain.

A file without a header is recognised by what its numbers mean: four columns, of which three are coordinates within the
reach of a scanner and the fourth is never negative. Columns counted wrongly mix coordinates into the intensity.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.budget import ReadBudget
from ladarreg_core.formats.cloud import most_cells_of, scan_of_cloud
from ladarreg_core.formats.untrusted import PathLike, reading
from ladarreg_core.progress import Progress, Report
from ladarreg_core.scan import Scan

_LEAST_POINTS = 12
_FARTHEST_M = 500.0
_LARGEST_INTENSITY = 65_535.0
_TINY = 1e-9  # integers read as floating point are smaller
_CHUNK = 500_000
_BYTES_PER_POINT = 40


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
    """Read a cloud of float32 x, y, z (m), intensity, without a header.

    Args:
        path: the file.
        origin: where the scanner stood, (3,) m in the file's coordinates; None: at their zero point, unless the pattern
            of the points says otherwise.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress, in points.

    Returns:
        The scan in the scanner's frame, whose axes are the file's.

    Raises:
        FormatError: if the numbers are not plausible as four columns, or are as five, too.
        ShapeError: if there are too few returns.
    """
    with reading(path) as file:
        budget = ReadBudget.of(file.stat().st_size, memory_bytes)
        count = budget.file_bytes // 16
        most_cells = most_cells_of(budget, count, _BYTES_PER_POINT)
        _require_four_columns(file, budget.file_bytes)
        values = np.empty((count, 4), np.float32)
        with open(file, "rb") as stream:
            for start in range(0, count, _CHUNK):
                if report is not None:
                    report(Progress(start, count, "reading the cloud"))
                part = np.frombuffer(stream.read(16 * _CHUNK), "<f4").reshape(-1, 4)
                values[start : start + len(part)] = part
        if report is not None:
            report(Progress(count, count, "reading the cloud"))
        if not _plausible(values):
            raise FormatError(
                "its numbers are not x, y, z (m, within 500 m) and an intensity in float32 throughout; it is damaged "
                "or another kind of file: export the cloud as PCD, PLY or LAS"
            )
        return scan_of_cloud(
            values[:, :3],
            values[:, 3],
            name=file.stem,
            coordinates="scanner",
            origin=origin,
            most_cells=most_cells,
            notes=["the file has no header: it was read as float32 x, y, z, intensity, as its numbers suggest"],
        )


def _require_four_columns(file: Path, size: int) -> None:
    """Refuse a file whose first numbers are not four columns, or could be five."""
    with open(file, "rb") as stream:
        head = stream.read(16 * _CHUNK)
    four = size % 16 == 0 and _plausible(_table(head, 4))
    five = size % 20 == 0 and _plausible(_table(head, 5))
    if four and not five:
        return
    if five:
        also = "four or five columns" if four else "five columns (x, y, z, intensity, ring)"
        raise FormatError(
            f"its numbers could be {also} of float32, and only four (x, y, z, intensity) are read from a file without "
            "a header: export the cloud as PCD, PLY or LAS"
        )
    raise FormatError(
        "its numbers are not four columns (x, y, z, intensity) of float32, the only cloud that is read without a "
        "header: export it as PCD, PLY or LAS"
    )


def _table(data: bytes, columns: int) -> NDArray[np.float32]:
    """Return the whole rows at the start of data."""
    rows = len(data) // (4 * columns)
    return np.frombuffer(data[: rows * 4 * columns], "<f4").reshape(rows, columns)


def _plausible(table: NDArray[np.float32]) -> bool:
    """Return whether rows are coordinates, an intensity and, in a fifth column, the number of a ring."""
    if len(table) < _LEAST_POINTS or not np.isfinite(table).all():
        return False
    sizes = np.abs(table)
    if sizes[:, :3].max() > _FARTHEST_M or table[:, 3].min() < 0 or table[:, 3].max() > _LARGEST_INTENSITY:
        return False
    if np.mean((sizes > 0) & (sizes < _TINY)) > 0.01:
        return False
    if table.shape[1] == 5 and (table[:, 4].min() < 0 or table[:, 4].max() > 255 or (table[:, 4] % 1).any()):
        return False
    returns = table[sizes[:, :3].max(axis=1) > 0, :3]
    if len(returns) < _LEAST_POINTS or (table[:, 3] == table[0, 3]).all():
        return False
    # Two axes at least spread over decimetres, on both sides of zero or all on one.
    return bool((np.ptp(returns, axis=0) > 0.1).sum() >= 2)
