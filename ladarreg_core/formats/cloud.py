"""A cloud without a grid becomes a scan: where its scanner stood, its points moved there, and their grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.arrays import ByteArray, FloatArray
from ladarreg_core.errors import ShapeError, UnderspecifiedError
from ladarreg_core.formats.budget import ReadBudget
from ladarreg_core.formats.untrusted import unit_notes
from ladarreg_core.formatting import format_percent
from ladarreg_core.frames import Rigid, describe_position
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.gridding import LARGEST_GRID, LEAST_POINTS, grid_points
from ladarreg_core.scanner.origin import estimate_origin

Coordinates = Literal["scanner", "local", "any"]
_POINT_BYTES = 340  # measured peak of gridding, per point with its cell, beyond what the file's own data take
_HELD_BYTES = 120  # the same per point alone
_CELL_BYTES = 300  # the same per cell of a grid that is mostly empty
_FAR_M = 1000.0
_SAMPLES = 10_000
_LEAST_KEPT = 0.9


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


def coordinates_of(points: NDArray[np.floating]) -> Coordinates:
    """Return which coordinates points (N, 3) probably have, in files that may have any: maps have large numbers."""
    known = points[:: max(1, len(points) // _SAMPLES)]
    known = known[np.isfinite(known).all(axis=1)]
    return "any" if len(known) and np.abs(np.median(known, axis=0)).max() > _FAR_M else "local"


def scan_of_cloud(
    points: NDArray[np.floating],
    intensity: FloatArray,
    color: ByteArray | None = None,
    *,
    name: str,
    coordinates: Coordinates,
    origin: ArrayLike | None = None,
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
        coordinates: those that the format usually has. `scanner`: zero is the scanner unless the points clearly say
            otherwise. `local`: the same, and said where the points do not say. `any`: refused where the points do not
            say where the scanner stood.
        origin: where the scanner stood in the coordinates of the points, (3,) m, if the file or the operator says.
        ring: (N,) whole numbers, the beam of each point.
        world_from_scanner: pose of the coordinates of the points in the world.
        most_cells: size to which finer clouds are thinned.
        notes: remarks on the file so far.

    Returns:
        The scan; its notes say where the scanner was taken to stand and what was dropped. `world_from_scanner` contains
        the origin, in double precision.

    Raises:
        ShapeError: if there are fewer than 12 returns, or all are in one row or column.
        UnderspecifiedError: if `coordinates` is `any` and it is neither given nor clear where the scanner stood.
    """
    if len(points) < LEAST_POINTS:
        raise ShapeError(f"the cloud has {len(points)} points; a scan needs at least {LEAST_POINTS}")
    where, remarks = _located(points, coordinates, origin)
    moved = np.asarray(points, dtype=np.float64)
    if where.any():
        moved = moved - where
        step = Rigid(np.eye(3), where)
        world_from_scanner = step if world_from_scanner is None else world_from_scanner @ step
    cloud = grid_points(moved, intensity, color, ring=ring, most_cells=most_cells)
    remarks.append(cloud.describe())
    kept = cloud.points_kept + (cloud.points_merged if cloud.accumulated else 0)
    if kept < _LEAST_KEPT * cloud.points_in:
        merged, lost = (format_percent(share) for share in (cloud.points_merged / cloud.points_in, cloud.lost_share))
        remarks.append(
            f"{merged} of the points share a cell with one at the same range, as where sweeps are accumulated, and "
            f"{lost} lie behind others and were dropped: if the scanner did not stand at {describe_position(where)}, "
            "give where it stood with --origin x,y,z; if the cloud was taken from several places, export each scan by "
            "itself"
        )
    return Scan(
        cloud.geometry,
        cloud.ranges,
        cloud.intensity,
        color=cloud.color,
        world_from_scanner=world_from_scanner,
        name=name,
        notes=(*notes, *remarks, *unit_notes(cloud.ranges)),
    )


def _located(
    points: NDArray[np.floating], coordinates: Coordinates, origin: ArrayLike | None
) -> tuple[NDArray[np.float64], list[str]]:
    """Return where the scanner stood, (3,) in the coordinates of the points, and a note on how that is known."""
    if origin is not None:
        where = np.asarray(origin, dtype=np.float64).reshape(3)
        return where, [f"the scanner stood at {describe_position(where)} in the file's coordinates, as given"]
    estimate = estimate_origin(points)
    if estimate.position is None:
        if coordinates == "any":
            raise UnderspecifiedError(
                "the file does not say where the scanner stood, and the pattern of the points does not show it: give "
                "--origin x,y,z in the file's coordinates (0,0,0 if they are the scanner's own); a cloud of several "
                "scans is to be exported scan by scan"
            )
        if coordinates == "local":
            return np.zeros(3), [
                "where the scanner stood is not in the file, and the points do not show it: the zero point of the "
                "coordinates was taken; if that is wrong, give it with --origin x,y,z"
            ]
        return np.zeros(3), []
    where = np.array(estimate.position)
    if where.any():
        return where, [
            f"the scanner's position {describe_position(where)} in the file's coordinates was estimated from the "
            "pattern of the points; if it is known, give it with --origin x,y,z"
        ]
    if coordinates == "any":
        return where, [
            "the scanner stood at the zero point of the file's coordinates, as the pattern of the points says"
        ]
    return where, []
