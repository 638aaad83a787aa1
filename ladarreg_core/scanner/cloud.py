"""A cloud without a grid in the scanner's frame: where the scanner stood, and the grid of the points around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import ShapeError, UnderspecifiedError
from ladarreg_core.foundations.arrays import ByteArray, FloatArray, read_only
from ladarreg_core.foundations.formatting import format_percent
from ladarreg_core.frames import Rigid, describe_position
from ladarreg_core.scanner.gridding import LARGEST_GRID, MIN_POINTS, GriddedCloud, grid_points
from ladarreg_core.scanner.origin import FARTHEST_ZERO_M, estimate_origin

_MIN_KEPT = 0.9
_MAX_HIDDEN = 0.9  # share of the points; with more hidden from zero, the file's word for it is not believed
_SAME_PLACE_M = 0.5
_SAMPLES = 10_000
_COARSEST_M = 0.02  # of a step between coordinates


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
    origin: ArrayLike | None = None,
    stated: Sequence[tuple[str, ArrayLike]] = (),
    zero_is_stated: bool = False,
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
        origin: where the scanner stood in the coordinates of the points, (3,) m, if it is given; else it is found by
            the pattern of the points (`estimate_origin`).
        stated: places (3,), m, that the file may mean, each with the words for what states it (`VIEWPOINT`).
        zero_is_stated: whether the file says that the points are in the scanner's frame.
        ring: (N,) whole numbers, the beam of each point.
        world_from_scanner: pose of the coordinates of the points in the world.
        most_cells: size to which finer clouds are thinned.
        what: what the points come from, for notes and errors.

    Raises:
        ShapeError: if there are fewer than 12 returns, or all are in one row or column.
        UnderspecifiedError: if it is neither given nor clear where the scanner stood.
    """
    if len(points) < MIN_POINTS:
        raise ShapeError(f"the cloud has {len(points)} points; a scan needs at least {MIN_POINTS}")
    where, remarks = where_it_stood(points, origin=origin, stated=stated, zero_is_stated=zero_is_stated, what=what)
    moved = np.asarray(points, dtype=np.float64)
    if where.any():
        moved = moved - where
    world_from_scanner = moved_pose(world_from_scanner, where, stated)
    cloud = grid_points(moved, intensity, color, ring=ring, most_cells=most_cells)
    remarks.append(cloud.describe())
    kept = cloud.points_kept + (cloud.points_merged if cloud.accumulated else 0)
    if kept < _MIN_KEPT * cloud.points_in:
        merged, lost = (format_percent(share) for share in (cloud.points_merged / cloud.points_in, cloud.lost_share))
        remarks.append(
            f"{merged} of the points share a cell with one at the same range, as where sweeps are accumulated, and "
            f"{lost} lie behind others and were dropped: if the scanner did not stand at {describe_position(where)}, "
            "give where it stood by `origin`; if the cloud was taken from several places, export each scan by itself"
        )
    return LocatedCloud(cloud, world_from_scanner, where, tuple(remarks))


def moved_pose(
    pose: Rigid | None, where: NDArray[np.float64], stated: Sequence[tuple[str, ArrayLike]] = ()
) -> Rigid | None:
    """Return the scanner's pose in the world, given where it stood, (3,) in the coordinates of the points.

    Where that is the place of the stated pose, the points were in the world already, and the pose is not applied again.
    """
    if not where.any():
        return pose
    step = Rigid(np.eye(3), where)
    in_world = any(np.linalg.norm(where - np.asarray(place)) < _SAME_PLACE_M for _, place in stated)
    return step if pose is None or in_world else pose @ step


def in_world_note(words: str, place: NDArray[np.float64]) -> str:
    """Return the note on a grid of points in the world, which is one as seen from the stated place (3,)."""
    return f"the points are in the world; the scanner stood at {describe_position(place)}, as {words} says"


def where_it_stood(
    points: NDArray[np.floating],
    *,
    origin: ArrayLike | None = None,
    stated: Sequence[tuple[str, ArrayLike]] = (),
    zero_is_stated: bool = False,
    what: str = "the file",
) -> tuple[NDArray[np.float64], list[str]]:
    """Return where the scanner stood, (3,) in the coordinates of the points, and a note on how that is known.

    Arguments and errors as `locate_cloud`.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        returns = int(np.count_nonzero(np.isfinite(points).all(axis=1) & points.any(axis=1)))
    if returns < MIN_POINTS:
        raise ShapeError(f"the cloud has {returns} returns; a scan needs at least {MIN_POINTS}")
    own = "the file's coordinates" if what == "the file" else "the coordinates of the points"
    _require_fine_steps(points, what)
    if origin is not None:
        where = read_only(origin, np.float64, (3,), "the origin")
        if not np.isfinite(where).all():
            raise ShapeError("the origin contains NaN or infinity; it needs three coordinates in metres")
        return where, [f"the scanner stood at {describe_position(where)} in {own}, as given"]
    places = [(words, np.asarray(place, dtype=np.float64)) for words, place in stated]
    estimate = estimate_origin(points, stated=[place for _, place in places])
    if estimate.position is None:
        if zero_is_stated and estimate.hidden_from_centre < _MAX_HIDDEN:
            return np.zeros(3), [
                f"the zero point of {own} is the scanner's position, as the file says; the points do not show it"
            ]
        far = np.nanmedian(np.abs(points[:: max(1, len(points) // _SAMPLES)]), axis=0).max() > FARTHEST_ZERO_M
        millimetres = "; if they are in millimetres, convert them to metres" if far else ""
        raise UnderspecifiedError(
            f"{what} does not say where the scanner stood, and the pattern of the points does not show it: give "
            f"`origin` as x, y, z in {own} (0, 0, 0 if they are the scanner's own); export a cloud of several scans "
            f"scan by scan{millimetres}"
        )
    where = np.array(estimate.position)
    if not where.any():
        if not estimate.by_visibility_alone or zero_is_stated:
            return where, []
        return where, [
            f"the zero point of {own} was taken for the scanner's position only because little is hidden from it; if "
            "the scanner stood elsewhere, give its position by `origin`"
        ]
    if (words := next((words for words, place in places if np.array_equal(place, where)), None)) is not None:
        return where, [
            f"the points are not in the scanner's frame: the scanner stood at {describe_position(where)} in {own}, as "
            f"{words} says and the pattern of the points confirms"
        ]
    return where, [
        f"the scanner's position {describe_position(where)} in {own} was estimated from the pattern of the points; "
        "if it is known, give it by `origin`"
    ]


def _require_fine_steps(points: NDArray[np.floating], what: str) -> None:
    """Refuse coordinates of a map that were rounded to single precision: nothing restores the shape.

    Raises:
        ShapeError: if they were; it names the step.
    """
    known = points[:: max(1, len(points) // _SAMPLES)]
    with np.errstate(over="ignore", invalid="ignore"):
        known = known[np.isfinite(known).all(axis=1)]
        single = known.astype(np.float32)
    if not len(known) or not (single == known).all():
        return
    largest = float(np.median(np.abs(known), axis=0).max())
    step = float(np.spacing(np.float32(largest)))
    if step > _COARSEST_M:
        raise ShapeError(
            f"{what} has coordinates of a map, about {largest:,.0f} m, in single precision, whose steps are {step:g} m "
            "apart: the shape of what was scanned is lost; export it in double precision, or with an offset subtracted"
        )
