"""Arranges the points of clouds without a grid in rows and columns, by spherical projection.

The rings of spinning scanners become rows, however unequally they are spaced; all other clouds get equal steps of
latitude and longitude, estimated from the cloud itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray, IntArray, read_only
from ladarreg_core.foundations.formatting import format_percent
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, rotation_from_rotvec, wrap_angle
from ladarreg_core.scanner.filling import fill_silence, range_tolerance
from ladarreg_core.scanner.grids import RotatedGrid, ScanGeometry, SphericalGrid, TabulatedGrid
from ladarreg_core.scanner.point_spacing import LARGE_CLOUD, steps_of
from ladarreg_core.scanner.rings import MAX_COLUMNS, ring_grid

MIN_POINTS = 12
"""Least number of returns for a grid."""
LARGEST_GRID = 8_000_000
"""Cells; finer clouds are thinned to this size."""
_MAX_ROWS = 16_000
_CELLS_PER_POINT = 40  # a larger grid is nearly all holes, stretched by outliers
_STRIP_POINTS = 500_000
_FRONT_M = 0.05
_FRONT = 0.01


@dataclass(frozen=True, eq=False)
class GriddedCloud:
    """A cloud on a grid; of several points in one cell, the nearest to the scanner is kept.

    Where points are unordered (sweeps accumulated from one place), cells contain several points of a surface, and their
    mean.
    """

    geometry: TabulatedGrid
    """The ray of each cell: that of its point, or the law's without a point."""
    ranges: FloatArray
    """(H, W) float32, m; NaN = no return."""
    intensity: FloatArray
    """(H, W) float32."""
    color: ByteArray | None
    """(H, W, 3) uint8 RGB."""
    points_in: int
    """Returns given."""
    points_kept: int
    """Returns with a cell of their own."""
    points_merged: int
    """Returns that share the cell of a kept one at about its range: nothing is lost but their density."""
    rings: int
    """Rings found; 0: none, rows are equal steps."""
    accumulated: bool = False
    """Whether the points are unordered, so that cells contain the mean of several."""
    filled: int = 0
    """Cells of an accumulated cloud without a return, interpolated from the surface around them."""

    @property
    def lost_share(self) -> float:
        """Share of the returns that were dropped because they lie behind others."""
        return 1 - (self.points_kept + self.points_merged) / self.points_in

    def describe(self) -> str:
        """Return a sentence on the gridding, for the notes of the scan."""
        height, width = self.geometry.shape
        rows = f"with its {self.rings} rings as rows" if self.rings else "with rows and columns of equal angle"
        share = format_percent(self.points_kept / self.points_in)
        text = f"the cloud has no grid: points arranged in {height} x {width} cells, {rows}; {share} of them kept"
        if self.accumulated:
            text = (
                f"the cloud has no grid, and its points are unordered: arranged in {height} x {width} cells with rows "
                f"and columns of equal angle, of {self.points_in / self.points_kept:.1f} points on average, of which "
                "the mean is kept"
            )
            if self.filled:
                text += f"; {self.filled:,} cells between points of one surface were filled"
        return text


def grid_points(
    points: ArrayLike,
    intensity: ArrayLike,
    color: ArrayLike | None = None,
    *,
    ring: ArrayLike | None = None,
    most_cells: int = LARGEST_GRID,
    turns_of: int = 0,
) -> GriddedCloud:
    """Arrange the points of a cloud in a grid.

    Args:
        points: (N, 3), scanner frame, m; points that are not finite or at the origin are no returns.
        intensity: (N,).
        color: (N, 3) uint8 RGB.
        ring: (N,) whole numbers, the beam of each point, if known; used if consistent with the latitudes.
        most_cells: size to which finer clouds are thinned; 8 M cells at most.
        turns_of: the points are those of several clouds of one standpoint, the first of which has so many: the steps
            along rings are its own, and a cell that several clouds met contains their mean. 0: it is one cloud.

    Returns:
        The grid: row 0 is the highest latitude, column 0 the largest longitude; a full turn is cut at its widest gap.

    Raises:
        ShapeError: if the arrays do not match, there are fewer than 12 returns, or all are in one row or column.
    """
    p = read_only(points, np.float64, (None, 3), "the cloud's points")
    strength = read_only(intensity, np.float32, (len(p),), "the cloud's intensity")
    paint = None if color is None else read_only(color, np.uint8, (len(p), 3), "the cloud's colour")
    beam = None if ring is None else read_only(ring, np.int64, (len(p),), "the cloud's rings")
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.sqrt(np.einsum("ij,ij->i", p, p))
    use = np.isfinite(distance) & (distance > 0)
    count = int(np.count_nonzero(use))
    turns_of = int(np.count_nonzero(use[:turns_of]))
    if count < MIN_POINTS:
        raise ShapeError(f"the cloud has {count} returns; a scan needs at least {MIN_POINTS}")
    if count < len(p):
        p, distance, strength = p[use], distance[use], strength[use]
        paint, beam = (None if each is None else each[use] for each in (paint, beam))
    rotation = rotation_from_pole(((1 / distance) @ p / count)[None])
    latitude, longitude = _angles(p, distance, rotation)
    plan = _arranged(latitude, longitude, beam, min(most_cells, LARGEST_GRID), turns_of or count)
    del latitude, longitude
    law = plan.law if rotation is None else RotatedGrid(plan.law, rotation)
    cells = _Cells.of(plan.cells, distance, law.shape, several=turns_of > 0 and not plan.accumulated)
    table = np.array(law.rays)
    fields = [distance, strength, *([] if paint is None else paint.T)]
    filled = 0
    if plan.accumulated or turns_of:
        grids = [cells.mean_of(values) for values in fields]
        rays = np.stack([cells.mean_of(p[:, axis]) for axis in range(3)], axis=-1)[cells.taken]
        table[cells.taken] = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        filled = fill_silence(grids) if plan.accumulated else 0
    else:
        grids = [cells.nearest_of(values) for values in fields]
        table[cells.taken] = p[cells.nearest] / distance[cells.nearest, None]
    rgb = None if paint is None else np.rint(np.nan_to_num(np.stack(grids[2:], axis=-1))).astype(np.uint8)
    geometry = TabulatedGrid(table, law=law)
    return GriddedCloud(
        geometry,
        grids[0],
        np.nan_to_num(grids[1]),
        rgb,
        count,
        len(cells.nearest),
        cells.merged,
        plan.rings,
        plan.accumulated,
        filled,
    )


@dataclass(frozen=True, eq=False)
class _Cells:
    """Which points fall into which cell."""

    flat: IntArray
    """(N,): the cell of each point, row by row."""
    front: BoolArray
    """(N,): whether the point is on the surface of the nearest point of its cell."""
    nearest: IntArray
    """(K,): the nearest point of each cell with points, in the order of the cells."""
    taken: BoolArray
    """(H, W): the cells with points."""
    merged: int
    """Number of points at about the range of the nearest one of their cell, besides that."""

    @staticmethod
    def of(flat: IntArray, distance: FloatArray, shape: tuple[int, int], *, several: bool) -> _Cells:
        """Return the cells; `several`: they contain the same surface measured again, with the noise of its ranges."""
        least = np.full(shape[0] * shape[1], np.inf)
        np.minimum.at(least, flat, distance)
        behind = distance - least[flat]
        first = np.flatnonzero(behind == 0)
        first = first[np.unique(flat[first], return_index=True)[1]]  # of equal ranges, the first in the file
        same = np.asarray(behind <= range_tolerance(distance - behind))
        merged = int(np.count_nonzero(same)) - len(first)
        front = same if several else np.asarray(behind <= np.maximum(_FRONT_M, _FRONT * (distance - behind)))
        return _Cells(flat, front, first, np.isfinite(least).reshape(shape), merged)

    def nearest_of(self, values: NDArray[Any]) -> FloatArray:
        """Return the value of the nearest point of each cell, (H, W) float32; NaN without a point."""
        grid = np.full(self.taken.shape, np.nan, np.float32)
        grid[self.taken] = values[self.nearest]
        return grid

    def mean_of(self, values: NDArray[Any]) -> FloatArray:
        """Return the mean over the front surface of each cell, (H, W) float32; NaN without a point."""
        chosen = self.flat[self.front]
        with np.errstate(invalid="ignore"):
            mean = np.bincount(chosen, values[self.front], self.taken.size) / np.bincount(
                chosen, minlength=self.taken.size
            )
        return np.asarray(mean.reshape(self.taken.shape), dtype=np.float32)


def _angles(
    p: NDArray[np.float64], distance: FloatArray, rotation: FloatArray | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return latitude and longitude (N,) of points (N, 3) after a rotation; by strips, since clouds are large."""
    latitude, longitude = np.empty(len(p)), np.empty(len(p))
    for start in range(0, len(p), _STRIP_POINTS):
        part = slice(start, start + _STRIP_POINTS)
        rays = p[part] / distance[part, None]
        if rotation is not None:
            rays = rays @ rotation.T
        latitude[part] = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
        longitude[part] = np.arctan2(rays[:, 1], rays[:, 0])
    return latitude, longitude


def rotation_from_pole(rays: FloatArray) -> FloatArray | None:
    """Return a rotation (3, 3) of a narrow cloud of unit rays (N, 3), or of their mean (1, 3), from near the Z axis to
    the equator; None if the cloud is not there.

    Depth cameras write clouds in their optical frame (Z forward, Y down), where up in the image is -Y.
    """
    mean = rays.mean(axis=0)
    if np.linalg.norm(mean) < 0.8 or abs(mean[2]) < 0.7 * np.linalg.norm(mean):
        return None
    forward = np.asarray(CAMERA_AXES_FROM_SCANNER.T)
    return forward if mean[2] > 0 else np.asarray(forward @ rotation_from_rotvec([np.pi, 0.0, 0.0]))


@dataclass(frozen=True, eq=False)
class _Plan:
    """The grid of a cloud, and the place of its points in it."""

    law: ScanGeometry
    cells: IntArray
    """(N,): the cell of each point, row by row."""
    rings: int = 0
    """Rings found; 0: none."""
    accumulated: bool = False
    """Whether the points are unordered, as in accumulated sweeps: cells contain several, whose mean is taken."""


def _arranged(
    latitude: FloatArray, longitude: FloatArray, beam: IntArray | None, most_cells: int, one_turn: int
) -> _Plan:
    """Return the grid; the step along rings is that of the first `one_turn` points."""
    centre, span = _centre_of(longitude)
    longitude = wrap_angle(longitude - centre)
    on_rings = ring_grid(latitude, longitude, beam, centre=centre, most_cells=most_cells, one_turn=one_turn)
    if on_rings is not None:
        return _Plan(*on_rings, on_rings[0].shape[0])
    d_latitude, d_longitude, accumulated = steps_of(longitude, latitude)
    top, low = float(latitude.max()), float(latitude.min())
    largest = min(most_cells, max(4096, _CELLS_PER_POINT * len(latitude)))
    d_latitude, d_longitude = _bounded(top - low, span, d_latitude, d_longitude, largest)
    rows, columns = (int(np.floor(s / d + 1e-9)) + 1 for s, d in ((top - low, d_latitude), (span, d_longitude)))
    if min(rows, columns) < 2:
        raise ShapeError(
            f"the cloud's returns fill {rows} x {columns} cells; a scan needs at least 2 rows and 2 columns"
        )
    # Half of the remainder on each side: the outermost points are then inside the outermost cells.
    spare = ((rows - 1) * d_latitude - (top - low)) / 2
    law = SphericalGrid(rows, columns, d_longitude, d_latitude, centre, top + spare)
    row = np.rint((top + spare - latitude) / d_latitude).clip(0, rows - 1).astype(np.intp)
    column = np.rint((columns - 1) / 2 - longitude / d_longitude).clip(0, columns - 1).astype(np.intp)
    return _Plan(law, row * columns + column, 0, accumulated)


def _centre_of(longitude: FloatArray) -> tuple[float, float]:
    """Return the centre and span of the longitudes, cut at the widest gap; a full turn is cut behind the scanner."""
    values = np.unique(longitude if len(longitude) <= LARGE_CLOUD else np.floor(longitude * 1e4) / 1e4)
    gaps = np.diff(np.append(values, values[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    if gaps[widest] < 0.1:  # a full turn with small holes: the seam belongs behind the scanner
        return 0.0, 2 * np.pi
    start = values[(widest + 1) % len(values)]
    span = 2 * np.pi - float(gaps[widest])
    return float(wrap_angle(start + span / 2)), span


def _bounded(
    height_rad: float, width_rad: float, d_latitude: float, d_longitude: float, most_cells: int
) -> tuple[float, float]:
    """Increase the steps until the grid is within the size limits."""
    d_latitude = min(max(d_latitude, height_rad / _MAX_ROWS, 1e-6), 0.49)
    d_longitude = min(max(d_longitude, width_rad / MAX_COLUMNS, 1e-6), 0.49)
    cells = (height_rad / d_latitude + 1) * (width_rad / d_longitude + 1)
    factor = float(np.sqrt(max(1.0, cells / most_cells)))
    return min(d_latitude * factor, 0.49), min(d_longitude * factor, 0.49)
