"""Sweeps of a line scanner as one scan, seen from where the axes of the unit cross."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.composition.sweep_columns import column_grid
from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import NO_INTENSITY_NOTE, Scan
from ladarreg_core.scanner.grids import SphericalGrid, TabulatedGrid

_FULL_TURN_GAP_RAD = float(np.radians(2.0))
_LONGITUDE_BINS = 1440
_BEHIND = (0.1, 1.15)
_STEEPEST_BASE = 0.85  # a base that leans by 30 deg at most
_MIN_BESIDE = 0.25  # cells from the centre, for a return to stand in the cell beside it


@dataclass(frozen=True, slots=True, eq=False)
class SweepComposition:
    """A scan made of sweeps, and how many of their returns were dropped."""

    scan: Scan
    """Origin where the axes cross; the axes of the unit's world, X ahead at pan 0, Z along the pan axis, levelled."""
    sweep_of_cell: NDArray[np.int16]
    """(H, W) the sweep that each return is from; -1 = no return."""
    folded: int
    """Returns dropped because a nearer surface hides them from where the axes cross."""
    repeated: int
    """Returns left out because another return of the same direction was kept."""
    columns_are_lines: bool
    """Each column is one line (or its half), every return of it at its own place; else the grid is spherical."""


def compose_sweeps(
    sweeps: Sequence[LineSweep], unit_from_scanner: Rigid, level_from_unit: Rigid | None = None, *,
    latency_s: float = 0.0, name: str = "sweep",
) -> SweepComposition:  # fmt: skip
    """Return sweeps as one scan with a ray of its own for each return; no range or intensity is resampled.

    One pan sweep of an upright line is a grid with a column for each line. Several sweeps, and those of a line that is
    not upright, share a spherical grid: each return is put into the cell of its direction, and of several in a cell the
    one nearest to the cell's centre is kept, unless a nearer surface hides it.

    Args:
        sweeps: the passes.
        unit_from_scanner: the mount.
        level_from_unit: how the unit itself is turned; None: upright.
        latency_s: of the unit's readings, for a unit in motion.
        name: display name of the scan.

    Raises:
        ShapeError: if there is no sweep, or no return.
    """
    if not sweeps:
        raise ShapeError("there is no line to compose; a sweep needs at least two")
    notes = () if any(sweep.intensity is not None for sweep in sweeps) else (NO_INTENSITY_NOTE,)
    level = level_from_unit or Rigid.identity()
    up = float(level.rotation[2, 2])
    # the lines of a unit that lies on its side are no columns of a level grid
    grid = column_grid(sweeps[0], unit_from_scanner, latency_s=latency_s) if len(sweeps) == 1 and _stands(up) else None
    if grid is not None:
        rays, ranges, intensity = grid.rays, grid.ranges_m, grid.intensity
        if level_from_unit is not None:
            rays = (rays @ level.rotation.T.astype(np.float32)).astype(np.float32)
        if up < 0:  # what is on top in the unit's world is at the bottom, and left is right
            rays, ranges, intensity = (np.ascontiguousarray(each[::-1, ::-1]) for each in (rays, ranges, intensity))
        scan = Scan(TabulatedGrid.taking_over(rays), ranges, intensity, name=name, notes=notes)
        return SweepComposition(
            scan, np.where(scan.valid, 0, -1).astype(np.int16), grid.folded, grid.repeated, columns_are_lines=True
        )
    return _on_sphere(sweeps, unit_from_scanner, level_from_unit, latency_s, name, notes)


def _stands(up: float) -> bool:
    """Return whether lines across a unit whose Z has this component upward, of 1, are upright enough for columns."""
    return abs(up) > _STEEPEST_BASE


def _on_sphere(
    sweeps: Sequence[LineSweep], mount: Rigid, level: Rigid | None, latency_s: float, name: str, notes: tuple[str, ...]
) -> SweepComposition:
    parts = []
    for sweep in sweeps:
        points = sweep.points_in_world(mount, latency_s=latency_s)
        if level is not None:
            points = points @ level.rotation.T
        there = np.isfinite(points[..., 0])
        light = np.zeros(there.shape, np.float32) if sweep.intensity is None else sweep.intensity
        parts.append((points[there].astype(np.float32), light[there]))
    points = np.concatenate([part[0] for part in parts])
    light = np.concatenate([part[1] for part in parts])
    source = np.repeat(np.arange(len(sweeps), dtype=np.int16), [len(part[0]) for part in parts])
    del parts
    if not len(points):
        raise ShapeError("the sweeps have no return at all; check the scanner's window and its least and most range")
    ranges = np.linalg.norm(points, axis=-1)
    law = _sphere_around(points, _step_of(sweeps))
    cells = law.cell_of(points)
    rows, columns = law.shape
    nearest = np.rint(cells).astype(np.int64)
    nearest[:, 0] = np.clip(nearest[:, 0], 0, rows - 1)
    nearest[:, 1] %= columns
    hidden = _hidden(nearest, ranges, law.shape)
    index = nearest[:, 0] * columns + nearest[:, 1]
    off_centre = np.abs(cells - np.rint(cells)).max(axis=-1)
    chosen = np.full(rows * columns, -1)
    seen = np.flatnonzero(~hidden)
    _claim(chosen, index[seen], off_centre[seen], seen)
    # What another return of its cell has displaced fills an empty cell beside it, if it lies on that side.
    spare = np.flatnonzero(~hidden & (chosen[index] != np.arange(len(index))))
    beyond = cells[spare] - np.rint(cells[spare])
    along = np.abs(beyond).argmax(axis=-1)
    next_cell = nearest[spare].copy()
    next_cell[np.arange(len(spare)), along] += np.sign(beyond[np.arange(len(spare)), along]).astype(np.int64)
    next_cell[:, 1] %= columns
    next_index = np.clip(next_cell[:, 0], 0, rows - 1) * columns + next_cell[:, 1]
    free = (chosen[next_index] < 0) & (np.abs(beyond[np.arange(len(spare)), along]) > _MIN_BESIDE)
    _claim(chosen, next_index[free], -off_centre[spare[free]], spare[free])

    full = np.flatnonzero(chosen >= 0)
    of = chosen[full]
    table = np.full((rows * columns, 3), np.nan)
    table[full] = points[of] / ranges[of, None]
    out, shown = np.full(rows * columns, np.nan, np.float32), np.zeros(rows * columns, np.float32)
    out[full], shown[full] = ranges[of], light[of]
    who = np.full(rows * columns, -1, np.int16)
    who[full] = source[of]
    grid = TabulatedGrid(table.reshape(rows, columns, 3), law)
    scan = Scan(grid, out.reshape(law.shape), shown.reshape(law.shape), name=name, notes=notes)
    folded = int(hidden.sum())
    return SweepComposition(
        scan, who.reshape(law.shape), folded, len(points) - len(full) - folded, columns_are_lines=False
    )


def _claim(chosen: IntArray, index: IntArray, cost: FloatArray, candidates: IntArray) -> None:
    """Give each cell, `index` (N,), to the one of its candidates (N,) with the least cost (N,)."""
    order = np.lexsort((-cost, index))
    # Of several assignments the last one holds.
    chosen[index[order]] = candidates[order]


def _step_of(sweeps: Sequence[LineSweep]) -> tuple[float, float]:
    """Return the steps (latitude, longitude), rad, between neighbouring rays and between neighbouring lines."""
    rays = [float(np.median(np.abs(np.diff(sweep.angles_rad)))) for sweep in sweeps if len(sweep.angles_rad) > 1]
    lines = []
    for sweep in sweeps:
        moved = np.hypot(np.diff(sweep.pan_rad), np.diff(sweep.tilt_rad))
        if (moved > 1e-6).any():
            lines.append(float(np.median(moved[moved > 1e-6])))
    if not rays or not lines:
        raise ShapeError("the sweeps have one line or one ray only; a scan needs at least two of each")
    return float(np.median(rays)), float(np.median(lines))


def _sphere_around(points: FloatArray, step: tuple[float, float]) -> SphericalGrid:
    """Return the spherical grid that holds all points, open where the largest gap in longitude is."""
    latitude = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    longitude = np.arctan2(points[:, 1], points[:, 0])
    used = np.bincount(
        ((longitude + np.pi) / (2 * np.pi) * _LONGITUDE_BINS).astype(int) % _LONGITUDE_BINS, minlength=_LONGITUDE_BINS
    )
    at = np.flatnonzero(used)
    gaps = np.diff(np.append(at, at[0] + _LONGITUDE_BINS))
    widest = int(gaps.argmax())
    bin_rad = 2 * np.pi / _LONGITUDE_BINS
    empty = (int(gaps[widest]) - 1) * bin_rad
    top, bottom = float(latitude.max()), float(latitude.min())
    rows = max(2, round((top - bottom) / step[0]) + 1)
    if empty < _FULL_TURN_GAP_RAD:
        columns = max(2, round(2 * np.pi / step[1]))
        return SphericalGrid(rows, columns, 2 * np.pi / columns, step[0], 0.0, top)
    first = (at[(widest + 1) % len(at)]) * bin_rad - np.pi  # right edge of the part that is used
    width = 2 * np.pi - empty
    return SphericalGrid(rows, max(2, round(width / step[1]) + 1), step[1], step[0], first + width / 2, top)


def _hidden(cells: IntArray, ranges: FloatArray, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the returns (N,) that lie far behind another one of their cell or of those around it."""
    nearest = np.full(shape, np.inf, np.float32)
    np.minimum.at(nearest, (cells[:, 0], cells[:, 1]), ranges.astype(np.float32))
    around = nearest.copy()
    for turn in (-1, 1):
        np.minimum(around, np.roll(nearest, turn, axis=1), out=around)
    rows = around.copy()
    np.minimum(around[1:], rows[:-1], out=around[1:])
    np.minimum(around[:-1], rows[1:], out=around[:-1])
    return np.asarray(ranges > around[cells[:, 0], cells[:, 1]] * _BEHIND[1] + _BEHIND[0])
