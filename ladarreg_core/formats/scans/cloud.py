"""Files of clouds without a grid: the memory that they need, and their scans."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import unit_notes
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.accumulation import OneCloud
from ladarreg_core.scanner.cloud import locate_cloud
from ladarreg_core.scanner.gridding import LARGEST_GRID

_POINT_BYTES = 340  # measured peak of gridding, per point with its cell, beyond what the file's own data take
_HELD_BYTES = 120  # the same per point alone
_CELL_BYTES = 300  # the same per cell of a grid that is mostly empty
_kept: ContextVar[list[OneCloud] | None] = ContextVar("kept", default=None)


@contextmanager
def clouds_kept() -> Iterator[list[OneCloud]]:
    """Keep the points of clouds that are read until the block ends, as they were before they were gridded."""
    token = _kept.set([])
    try:
        found = _kept.get()
        assert found is not None
        yield found
    finally:
        _kept.reset(token)


def most_cells_of(budget: ReadBudget, points: int, bytes_per_point: float) -> int:
    """Return the size of grid that fits into memory, after refusing a cloud that does not.

    Args:
        budget: of the file.
        points: number of points that the file claims.
        bytes_per_point: memory that a point takes while it is read, bytes.

    Raises:
        FormatError: if the points do not fit.
    """
    budget.require(points * (bytes_per_point + _POINT_BYTES), f"its {points:,} points")
    return budget.cells_that_fit(_CELL_BYTES, besides_bytes=points * (bytes_per_point + _HELD_BYTES))


def scan_of_cloud(
    points: NDArray[np.floating],
    intensity: FloatArray,
    color: ByteArray | None = None,
    *,
    name: str,
    origin: ArrayLike | None = None,
    stated: Sequence[tuple[str, ArrayLike]] = (),
    zero_is_stated: bool = False,
    ring: NDArray[np.integer] | None = None,
    world_from_scanner: Rigid | None = None,
    most_cells: int = LARGEST_GRID,
    notes: Sequence[str] = (),
) -> Scan:
    """Return the scan of a cloud without a grid, in the scanner's frame: the cloud's axes, moved to the scanner.

    Args:
        points: (N, 3) float64, m; float32 only where the coordinates are small.
        intensity: (N,) float32.
        color: (N, 3) uint8 RGB.
        name: of the scan.
        origin: where the scanner stood in the coordinates of the points, (3,) m, if the operator says.
        stated: places that the file may mean, with the words for what states them; see `locate_cloud`.
        zero_is_stated: whether the file says that the points are in the scanner's frame.
        ring: (N,) whole numbers, the beam of each point.
        world_from_scanner: pose of the coordinates of the points in the world.
        most_cells: size to which finer clouds are thinned.
        notes: remarks on the file so far.

    Returns:
        The scan; its notes say where the scanner was taken to stand and what was dropped. `world_from_scanner` contains
        the origin, in double precision.

    Raises:
        ShapeError: if there are fewer than 12 returns, or all are in one row or column.
        UnderspecifiedError: if it is neither given nor clear where the scanner stood.
    """
    located = locate_cloud(
        points, intensity, color, origin=origin, stated=stated, zero_is_stated=zero_is_stated, ring=ring,
        world_from_scanner=world_from_scanner, most_cells=most_cells,
    )  # fmt: skip
    cloud = located.cloud
    kept = _kept.get()
    if kept is not None:
        moved = np.asarray(points, dtype=np.float64) - located.origin
        rings = None if ring is None else np.asarray(ring, dtype=np.int64)
        kept.append(OneCloud(name, moved, np.asarray(intensity, dtype=np.float32), color, rings))
    return Scan(
        cloud.geometry,
        cloud.ranges,
        cloud.intensity,
        color=cloud.color,
        world_from_scanner=located.world_from_scanner,
        name=name,
        notes=(*notes, *located.notes, *unit_notes(cloud.ranges)),
    )
