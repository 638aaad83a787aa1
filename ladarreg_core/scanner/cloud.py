"""A cloud without a grid in the scanner's frame: where the scanner stood, and the grid of the points around it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.arrays import ByteArray, FloatArray, read_only
from ladarreg_core.errors import ShapeError, UnderspecifiedError
from ladarreg_core.formatting import format_percent
from ladarreg_core.frames import Rigid, describe_position
from ladarreg_core.scanner.gridding import LARGEST_GRID, LEAST_POINTS, GriddedCloud, grid_points
from ladarreg_core.scanner.origin import estimate_origin

Coordinates = Literal["scanner", "local", "any"]
_LEAST_KEPT = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class LocatedCloud:
    """The grid of a cloud around its scanner."""

    cloud: GriddedCloud
    """The grid, scanner frame."""
    world_from_scanner: Rigid | None
    """The scanner in the world, which contains where it stood; None: it stood at zero and no world is known."""
    origin: NDArray[np.float64]
    """Where the scanner stood in the coordinates of the points, (3,) m."""
    notes: tuple[str, ...]
    """Where the scanner was taken to stand, how the points were arranged and what was dropped."""


def locate_cloud(
    points: NDArray[np.floating],
    intensity: FloatArray,
    color: ByteArray | None = None,
    *,
    coordinates: Coordinates,
    origin: ArrayLike | None = None,
    ring: NDArray[np.integer] | None = None,
    world_from_scanner: Rigid | None = None,
    most_cells: int = LARGEST_GRID,
    what: str = "the file",
) -> LocatedCloud:
    """Arrange a cloud in a grid around its scanner: the cloud's axes, moved to where the scanner stood.

    Args:
        points: (N, 3) float64, m; float32 only where the coordinates are small.
        intensity: (N,) float32.
        color: (N, 3) uint8 RGB.
        coordinates: those that the points usually have. `scanner`: zero is the scanner unless the points clearly say
            otherwise. `local`: the same, and said where the points do not say. `any`: refused where the points do not
            say where the scanner stood.
        origin: where the scanner stood in the coordinates of the points, (3,) m, if known.
        ring: (N,) whole numbers, the beam of each point.
        world_from_scanner: pose of the coordinates of the points in the world.
        most_cells: size to which finer clouds are thinned.
        what: what the points come from, for notes and errors.

    Raises:
        ShapeError: if there are fewer than 12 returns, or all are in one row or column.
        UnderspecifiedError: if `coordinates` is `any` and it is neither given nor clear where the scanner stood.
    """
    if len(points) < LEAST_POINTS:
        raise ShapeError(f"the cloud has {len(points)} points; a scan needs at least {LEAST_POINTS}")
    where, remarks = _located(points, coordinates, origin, what)
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
            "give where it stood by `origin`; if the cloud was taken from several places, export each scan by itself"
        )
    return LocatedCloud(cloud, world_from_scanner, where, tuple(remarks))


def _located(
    points: NDArray[np.floating], coordinates: Coordinates, origin: ArrayLike | None, what: str
) -> tuple[NDArray[np.float64], list[str]]:
    """Return where the scanner stood, (3,) in the coordinates of the points, and a note on how that is known."""
    own = "the file's coordinates" if what == "the file" else "the coordinates of the points"
    if origin is not None:
        where = read_only(origin, np.float64, (3,), "the origin")
        if not np.isfinite(where).all():
            raise ShapeError("the origin contains NaN or infinity; it needs three coordinates in metres")
        return where, [f"the scanner stood at {describe_position(where)} in {own}, as given"]
    estimate = estimate_origin(points)
    if estimate.position is None:
        if coordinates == "any":
            raise UnderspecifiedError(
                f"{what} does not say where the scanner stood, and the pattern of the points does not show it: give "
                f"`origin` as x, y, z in {own} (0, 0, 0 if they are the scanner's own); a cloud of several scans is to "
                "be exported scan by scan"
            )
        if coordinates == "local":
            return np.zeros(3), [
                f"where the scanner stood is not in {what}, and the points do not show it: the zero point of the "
                "coordinates was taken; if that is wrong, give it by `origin`"
            ]
        return np.zeros(3), []
    where = np.array(estimate.position)
    if estimate.may_be_centre and coordinates != "any":
        return np.zeros(3), [
            f"the zero point of {own} was taken for the scanner's position; the pattern of the points would also agree "
            f"with {describe_position(where)}: if the scanner stood elsewhere, give it by `origin`"
        ]
    if where.any():
        return where, [
            f"the scanner's position {describe_position(where)} in {own} was estimated from the pattern of the points; "
            "if it is known, give it by `origin`"
        ]
    if coordinates == "any":
        return where, [f"the scanner stood at the zero point of {own}, as the pattern of the points says"]
    return where, []
