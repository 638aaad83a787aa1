"""Scan files of one standpoint are read as one scan: their clouds are merged before the grid is made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ladarreg_core.errors import FormatError, ShapeError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.scans.cloud import clouds_kept, most_cells_of
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.accumulation import OneCloud, accumulate

_MAX_TURNED_RAD, _MAX_MOVED_M = np.radians(0.5), 0.1
_POINT_BYTES = 48


def read_accumulated(files: Sequence[Path], read: Callable[[Path], Scan], *, memory_bytes: int | None = None) -> Scan:
    """Return one scan of several files that were taken from one standpoint.

    Args:
        files: two or more; the frame and the name are those of the first.
        read: reads one of them.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.

    Raises:
        FormatError: if one cannot be read, they need more memory than they may use, or their files place the scanner
            differently in the world.
        ShapeError: if the ranges of one plainly show that it was taken from elsewhere, or not all are of one kind of
            intensity.
    """
    scans: list[Scan] = []
    clouds: list[OneCloud] = []
    budget = ReadBudget.of(sum(file.stat().st_size for file in files), memory_bytes)
    points = 0
    for file in files:
        with clouds_kept() as kept:
            scan = read(file)
        cloud = kept[-1] if kept else _cloud_of(scan)
        clouds.append(OneCloud(file.name, cloud.points, cloud.intensity, cloud.color, cloud.ring))
        scans.append(scan)
        points += len(cloud.points)
        most_cells = most_cells_of(budget, points, _POINT_BYTES)
    first = scans[0]
    for file, scan in zip(files[1:], scans[1:], strict=True):
        _require_one_place(file, scan.world_from_scanner, files[0], first.world_from_scanner)
        if scan.intensity_is != first.intensity_is:
            raise ShapeError(
                f"the intensity of {file.name} is {scan.intensity_is}, that of {files[0].name} {first.intensity_is}; "
                "accumulate clouds of one kind"
            )
    grid, notes = accumulate(clouds, most_cells=most_cells)
    own = tuple(note for note in first.notes if not note.startswith("the cloud has no grid"))
    return Scan(
        grid.geometry,
        grid.ranges,
        grid.intensity,
        color=grid.color,
        intensity_is=first.intensity_is,
        world_from_scanner=first.world_from_scanner,
        name=first.name,
        notes=(*own, *notes),
    )


def _cloud_of(scan: Scan) -> OneCloud:
    """Return the returns of a scan that had a grid in its file, the rows as rings."""
    color = None if scan.color is None else scan.color[scan.valid]
    rows = np.nonzero(scan.valid)[0].astype(np.int64)
    return OneCloud(scan.name, scan.points[scan.valid].astype(np.float64), scan.intensity[scan.valid], color, rows)


def _require_one_place(file: Path, here: Rigid | None, first_file: Path, there: Rigid | None) -> None:
    """Refuse a file that places the scanner elsewhere in the world than the first one does."""
    if here is None and there is None:
        return
    one, two = (Rigid.identity() if pose is None else pose for pose in (here, there))
    moved, turned = one.translation - two.translation, one.angle_to(two)
    if turned > _MAX_TURNED_RAD or np.linalg.norm(moved) > _MAX_MOVED_M:
        raise FormatError(
            f"{file.name} places the scanner {np.linalg.norm(moved):.2f} m and {np.degrees(turned):.1f} degrees from "
            f"where {first_file.name} does; accumulate clouds of one standpoint only"
        )
