"""One sweep as a grid with a column for each line: both halves of lines that pass the zenith, nothing resampled.

The scanner's centre moves on a lever arm, so that a sweep has no single centre: each return is seen again from where
the axes cross, along a ray of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.pan_tilt import rays_of_line, turned_by_unit

_STEEPEST_NORMAL = 0.5  # a line's plane leans from the vertical by 30 degrees at most
_UNEVEN_STEPS = 0.3
_GAP_STEPS = 1.5
_SAME_STEPS = 0.4
_COLUMNS_AT_ONCE = 256
_FARTHEST_FOLD_CELLS = 64
_DEPTH_EDGE = 0.04
_POLE_SHARE = 0.05  # of a step: how far from the pole such rays end
_BEHIND = (0.02, 0.01)  # m, and share of the range
_MAX_EMPTY_COLUMNS = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class ColumnGrid:
    """A sweep seen from where the axes cross."""

    rays: NDArray[np.float32]
    """(H, W, 3) unit; those of cells without a return as if it were as far as the returns around it."""
    ranges_m: NDArray[np.float32]
    """(H, W) m from where the axes cross; NaN = no return."""
    intensity: NDArray[np.float32]
    """(H, W) in the unit of the sensor, 0 where the scanner has none."""
    folded: int
    """Returns dropped because a nearer surface hides them from where the axes cross."""
    repeated: int
    """Returns left out because another column shows the same direction."""


@dataclass(frozen=True, slots=True, eq=False)
class _Sides:
    """The rays of a line as two quarters of a great circle: down from the top ahead, and behind."""

    row: IntArray
    """(N,) row of each ray."""
    behind: BoolArray
    """(N,) on the side behind."""
    rows: int
    rays: NDArray[np.float64]
    """(2, H, 3) unit ray of each row, ahead and behind, in the unit's frame."""
    real: BoolArray
    """(2, H): rows that the line has on each side."""
    ahead_rad: float
    """Longitude of the side ahead at pan 0."""


def column_grid(sweep: LineSweep, unit_from_scanner: Rigid, *, latency_s: float = 0.0) -> ColumnGrid | None:
    """Return a pan sweep as a grid with a column for each line, column 0 on the left; None if it cannot be one.

    Lines that pass the zenith are split there: the part behind makes columns of its own for the directions which no
    line shows ahead, so that half a turn gives a full panorama. A gap in the pan angles is filled with columns without
    returns.

    Args:
        sweep: one pass.
        unit_from_scanner: the mount.
        latency_s: for a unit in motion.

    Returns:
        The grid; None if the line is not upright, its angles are uneven, the unit does not pan, or most columns would
        be empty.
    """
    sides = _sides(sweep, unit_from_scanner)
    columns = None if sides is None else _columns(sweep, sides)
    if sides is None or columns is None:
        return None
    line, side, pan = columns
    shape = sides.rows, len(line)
    ray = np.full((2, sides.rows), -1)
    ray[sides.behind.astype(int), sides.row] = np.arange(len(sides.row))
    tilt = np.interp(pan, *_rising(sweep.pan_rad, sweep.tilt_rad))

    native, rays = np.empty((*shape, 3), np.float32), np.empty((*shape, 3), np.float32)
    ranges, intensity = np.full(shape, np.nan, np.float32), np.zeros(shape, np.float32)
    lever = np.empty((*shape, 3), np.float32)
    for first in range(0, shape[1], _COLUMNS_AT_ONCE):
        part = slice(first, first + _COLUMNS_AT_ONCE)
        at_line, at_ray = np.broadcast_arrays(line[part], ray[side[part]].T)
        there = (at_line >= 0) & (at_ray >= 0)
        pan_of, tilt_of = (np.broadcast_to(a[part], at_line.shape).copy() for a in (pan, tilt))
        for out, own in zip((pan_of, tilt_of), sweep.positions(line[part], latency_s=latency_s), strict=True):
            of_rays = np.broadcast_to(own, (own.shape[0], len(sweep.angles_rad)))
            out[there] = of_rays[np.nonzero(there)[1], at_ray[there]]
        native[:, part] = turned_by_unit(sides.rays[side[part]].transpose(1, 0, 2), pan_of, tilt_of)
        lever[:, part] = turned_by_unit(unit_from_scanner.translation, pan_of, tilt_of)
        ranges[:, part][there] = sweep.ranges_m[at_line[there], at_ray[there]]
        if sweep.intensity is not None:
            intensity[:, part][there] = sweep.intensity[at_line[there], at_ray[there]]
    returns = int(np.count_nonzero(np.isfinite(sweep.ranges_m)))
    kept = int(np.count_nonzero(np.isfinite(ranges)))
    step = 2 * np.sin(np.median(np.abs(np.diff(sweep.angles_rad))) / 2)
    outward = pan + sides.ahead_rad + np.pi * side
    ahead = np.stack([np.cos(outward), np.sin(outward)], axis=-1).astype(np.float32)
    seen = _seen_again(native, lever, ranges, rays)
    crossed = _beyond_pole(rays, ahead) & np.isfinite(ranges)
    hidden = _hidden(native, rays, seen, float(step)) & ~crossed
    if hidden.any() or crossed.any():
        ranges[hidden | crossed] = np.nan
        seen = _seen_again(native, lever, ranges, rays)
    _stop_at_pole(rays, ahead, float(step))
    return ColumnGrid(rays, seen, intensity, int(hidden.sum()), returns - kept + int(crossed.sum()))


def _sides(sweep: LineSweep, mount: Rigid) -> _Sides | None:
    """Return how the rays are split at the top of the line; None if it is not upright or its angles are uneven."""
    tilt = float(np.median(sweep.tilt_rad))
    normal, ahead_of_scanner = (turned_by_unit(mount.rotation @ axis, 0.0, tilt) for axis in np.eye(3)[[2, 0]])
    if abs(normal[2]) > _STEEPEST_NORMAL or len(sweep.angles_rad) < 2:
        return None
    top = np.array([0.0, 0.0, 1.0]) - normal * normal[2]
    top /= np.linalg.norm(top)
    ahead = np.cross(normal, top)
    if ahead @ ahead_of_scanner < 0:
        ahead = -ahead
    rays = turned_by_unit(rays_of_line(sweep.angles_rad) @ mount.rotation.T, 0.0, tilt)
    from_top = np.arctan2(rays @ ahead, rays @ top)  # positive ahead
    behind = from_top < 0
    step = float(np.median(np.abs(np.diff(sweep.angles_rad))))
    row = np.empty(len(rays), np.intp)
    fraction = np.zeros(2)
    for part, of in enumerate((~behind, behind)):
        if not of.any():
            continue
        steps = np.abs(from_top[of]) / step
        fraction[part] = np.angle(np.exp(2j * np.pi * steps).mean()) / (2 * np.pi)
        row[of] = np.rint(steps - fraction[part])
        if np.abs(steps - fraction[part] - row[of]).max() > _UNEVEN_STEPS or len(np.unique(row[of])) < of.sum():
            return None
    first, last = int(row.min()), int(row.max())
    angle = (np.arange(first, last + 1) + fraction[:, None]) * step * np.array([[1.0], [-1.0]])
    ideal = np.cos(angle)[..., None] * top + np.sin(angle)[..., None] * ahead
    real = np.zeros((2, last - first + 1), np.bool_)
    real[behind.astype(int), row - first] = True
    ideal[behind.astype(int), row - first] = rays
    unit_rays = turned_by_unit(ideal, 0.0, -tilt)
    return _Sides(row - first, behind, last - first + 1, unit_rays, real, float(np.arctan2(ahead[1], ahead[0])))


def _columns(sweep: LineSweep, sides: _Sides) -> tuple[IntArray, IntArray, NDArray[np.float64]] | None:
    """Return line (-1 for none), side and pan of each column from left to right.

    Lines at one position, or so close that the unit hardly moved, count once.
    """
    order = np.argsort(-np.asarray(sweep.pan_rad), kind="stable")
    pans = np.asarray(sweep.pan_rad)[order]
    steps = -np.diff(pans)
    moved = steps[steps > 1e-6]
    if not len(moved):
        return None
    step = float(np.median(moved))
    keep = [0]
    for i in range(1, len(pans)):
        if pans[keep[-1]] - pans[i] >= _SAME_STEPS * step and pans[0] - pans[i] < 2 * np.pi - step / 2:
            keep.append(i)
    order, pans = order[keep], pans[keep]
    ahead = sides.real[0].any()
    left, right = (pans[0], pans[-1]) if ahead else (-np.inf, np.inf)
    behind = np.flatnonzero((pans - np.pi < right - step / 2) & (pans - np.pi > left - 2 * np.pi + step / 2))
    if not sides.real[1].any():
        behind = behind[:0]
    front = np.arange(len(pans)) if ahead else behind[:0]
    line = np.concatenate([order[front], order[behind]])
    side = np.concatenate([np.zeros(len(front), np.intp), np.ones(len(behind), np.intp)])
    longitude = np.concatenate([pans[front], pans[behind] - np.pi])
    if len(line) < 2:
        return None
    gaps = -np.diff(longitude)
    blanks = np.where(gaps > _GAP_STEPS * step, np.rint(gaps / step).astype(int) - 1, 0)
    if blanks.sum() > _MAX_EMPTY_COLUMNS * len(line):
        return None
    at = np.arange(len(line)) + np.concatenate([[0], np.cumsum(blanks)])
    count = int(at[-1]) + 1
    all_lines, all_sides = np.full(count, -1), np.zeros(count, np.intp)
    all_lines[at], all_sides[at] = line, side
    along = np.interp(np.arange(count), at, longitude)
    return all_lines, all_sides, along + np.where(all_sides == 1, np.pi, 0.0)


def _rising(pan: FloatArray, tilt: FloatArray) -> tuple[FloatArray, FloatArray]:
    order = np.argsort(pan, kind="stable")
    return np.asarray(pan)[order], np.asarray(tilt)[order]


def _seen_again(
    native: NDArray[np.float32], lever: NDArray[np.float32], ranges: NDArray[np.float32], rays: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Fill the rays from where the axes cross, and return the ranges from there.

    A cell without a return has the inverse range of the returns above and below it, so that neighbours stay neighbours.
    """
    out = np.empty_like(ranges)
    rows = np.arange(len(ranges))
    nearness = 1 / ranges
    usual = float(np.nanmedian(nearness)) if np.isfinite(nearness).any() else 0.0
    for column in range(ranges.shape[1]):
        near = nearness[:, column]
        known = np.isfinite(near)
        if not known.all():
            near[~known] = np.interp(rows[~known], rows[known], near[known]) if known.any() else usual
        to = native[:, column].astype(np.float64) + lever[:, column] * near[:, None].astype(np.float64)
        length = np.linalg.norm(to, axis=-1)
        rays[:, column] = to / length[:, None]
        out[:, column] = length * ranges[:, column]
    return out


def _beyond_pole(rays: NDArray[np.float32], ahead: NDArray[np.float32]) -> BoolArray:
    """Return the cells (H, W) whose rays have crossed the zenith or the nadir, which other columns show as well."""
    return np.asarray(rays[..., 0] * ahead[:, 0] + rays[..., 1] * ahead[:, 1] < 0)


def _stop_at_pole(rays: NDArray[np.float32], ahead: NDArray[np.float32], step: float) -> None:
    """Let the rays of cells without a return end at the zenith and the nadir, in order, so that no cell is folded."""
    row, column = np.nonzero(_beyond_pole(rays, ahead))
    up = np.where(rays[row, column, 2] > 0, 1.0, -1.0)
    from_end = np.where(up > 0, row, len(rays) - 1 - row)
    off = step * _POLE_SHARE * (1 + from_end / len(rays))
    pole = np.stack([ahead[column, 0] * off, ahead[column, 1] * off, up], axis=-1)
    rays[row, column] = pole / np.linalg.norm(pole, axis=-1, keepdims=True)


def _hidden(
    native: NDArray[np.float32], rays: NDArray[np.float32], ranges: NDArray[np.float32], step: float
) -> BoolArray:
    """Return the returns (H, W) that have changed places with a nearer one along their row or column."""
    hidden = np.zeros(ranges.shape, np.bool_)
    valid = np.isfinite(ranges)
    if not valid.any():
        return hidden
    shift = np.abs(rays - native).max(axis=-1)
    reach = int(min(np.ceil(shift[valid].max() / step) + 1, _FARTHEST_FOLD_CELLS))
    for axis in (0, 1):
        near = np.log(np.where(valid, ranges, np.nan))
        edge = np.abs(np.diff(near, axis=axis))
        edge = np.where(np.isnan(edge), np.inf, edge) > _DEPTH_EDGE
        reached = np.flatnonzero(_within(edge, axis, reach, ranges.shape) & valid)
        stride = ranges.shape[1] if axis == 0 else 1
        place = reached // ranges.shape[1] if axis == 0 else reached % ranges.shape[1]
        flat, d, n = ranges.reshape(-1), rays.reshape(-1, 3), native.reshape(-1, 3)
        for offset in (sign * k for k in range(1, reach + 1) for sign in (1, -1)):
            inside = (place + offset >= 0) & (place + offset < ranges.shape[axis])
            a = reached[inside]
            b = a + offset * stride
            with np.errstate(invalid="ignore"):
                behind = flat[a] > flat[b] * (1 + _BEHIND[1]) + _BEHIND[0]
            a, b = a[behind], b[behind]
            exchanged = ((d[b] - d[a]) * (n[b] - n[a])).sum(-1) < 0
            hidden.reshape(-1)[a[exchanged]] = True
    return hidden


def _within(edge: BoolArray, axis: int, reach: int, shape: tuple[int, ...]) -> BoolArray:
    """Return the cells within some cells of an edge between neighbours along an axis."""
    counts = np.zeros((shape[0] + 1, shape[1]) if axis == 0 else (shape[0], shape[1] + 1), np.int32)
    np.cumsum(edge, axis=axis, out=counts[1:-1] if axis == 0 else counts[:, 1:-1])
    last = counts[-2:-1] if axis == 0 else counts[:, -2:-1]
    if axis == 0:
        counts[-1:] = last
    else:
        counts[:, -1:] = last
    index = np.arange(shape[axis])
    low, high = np.clip(index - reach, 0, None), np.clip(index + reach, None, shape[axis])
    return np.asarray(np.take(counts, high, axis) > np.take(counts, low, axis))
