"""Arranges the points of clouds without a grid in rows and columns, by spherical projection.

The rings of spinning scanners become rows, however unequally they are spaced; all other clouds get equal steps of
latitude and longitude, estimated from the cloud itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.arrays import BoolArray, ByteArray, FloatArray, IntArray, read_only
from ladarreg_core.errors import ShapeError
from ladarreg_core.formatting import format_percent
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, rotation_from_rotvec, wrap_angle
from ladarreg_core.scanner.grids import RingGrid, RotatedGrid, ScanGeometry, SphericalGrid, TabulatedGrid

LEAST_POINTS = 12
"""Least number of returns for a grid."""
LARGEST_GRID = 8_000_000
"""Cells; finer clouds are thinned to this size."""
_MOST_COLUMNS = 32_000  # cv2.remap refuses 32,767
_MOST_ROWS = 16_000
_CELLS_PER_POINT = 40  # a larger grid is nearly all holes, stretched by outliers
_SAMPLES = 3000
_NEIGHBOURS = 160
_STRIP = 0.3
_REGULAR = 0.5
_SEED = 20
_LEAST_RINGS = 4
_LEAST_ON_A_RING = 8
_MOST_OVERLAP = 0.25
_CLEAN_OVERLAP = 0.02
_LARGE = 1_000_000
_STRIP_POINTS = 500_000
_WINDOWS = 60
_WINDOW_POINTS = 6_000
_LEAST_STREWN = 5_000
_CLUSTERED = 0.3  # a tenth of strewn points have another one this close, in typical distances; of a raster, none
_POINTS_PER_CELL = (
    1.5  # one cell in five is empty by chance, and filled; 3 lose detail, 1 smears it: both register worse
)
_SPARSE = 80
_LEAST_AROUND = 5
_FRONT_M = 0.05
_FRONT = 0.01
_SAME_M = 0.1
_SAME = 0.03


@dataclass(frozen=True, eq=False)
class GriddedCloud:
    """A cloud on a grid; of several points in one cell, the nearest to the scanner is kept.

    Where points are strewn (sweeps of a scanner accumulated from one place), cells contain several points of a surface,
    and their mean.
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
    """Whether the points are strewn, so that cells contain the mean of several."""
    filled: int = 0
    """Cells of an accumulated cloud that no beam met, filled from the surface around them."""

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
                f"the cloud has no grid, and its points are strewn: arranged in {height} x {width} cells with rows and "
                f"columns of equal angle, of {self.points_in / self.points_kept:.1f} points on average, of which the "
                "mean is kept"
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
) -> GriddedCloud:
    """Arrange the points of a cloud in a grid.

    Args:
        points: (N, 3), scanner frame, m; points that are not finite or at the origin are no returns.
        intensity: (N,).
        color: (N, 3) uint8 RGB.
        ring: (N,) whole numbers, the beam of each point, if known; used if consistent with the latitudes.
        most_cells: size to which finer clouds are thinned; 8 M cells at most.

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
    if count < LEAST_POINTS:
        raise ShapeError(f"the cloud has {count} returns; a scan needs at least {LEAST_POINTS}")
    if count < len(p):
        p, distance, strength = p[use], distance[use], strength[use]
        paint, beam = (None if each is None else each[use] for each in (paint, beam))
    rotation = rotation_from_pole(((1 / distance) @ p / count)[None])
    latitude, longitude = _angles(p, distance, rotation)
    plan = _arranged(latitude, longitude, beam, min(most_cells, LARGEST_GRID))
    del latitude, longitude
    law = plan.law if rotation is None else RotatedGrid(plan.law, rotation)
    cells = _Cells.of(plan.cells, distance, law.shape)
    table = np.array(law.rays)
    fields = [distance, strength, *([] if paint is None else paint.T)]
    filled = 0
    if plan.accumulated:
        grids = [cells.mean_of(values) for values in fields]
        rays = np.stack([cells.mean_of(p[:, axis]) for axis in range(3)], axis=-1)[cells.taken]
        table[cells.taken] = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        filled = _fill_silence(grids)
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
    def of(flat: IntArray, distance: FloatArray, shape: tuple[int, int]) -> _Cells:
        least = np.full(shape[0] * shape[1], np.inf)
        np.minimum.at(least, flat, distance)
        behind = distance - least[flat]
        first = np.flatnonzero(behind == 0)
        first = first[np.unique(flat[first], return_index=True)[1]]  # of equal ranges, the first in the file
        merged = int(np.count_nonzero(behind <= np.maximum(_SAME_M, _SAME * (distance - behind)))) - len(first)
        front = np.asarray(behind <= np.maximum(_FRONT_M, _FRONT * (distance - behind)))
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


def _fill_silence(grids: list[FloatArray]) -> int:
    """Fill cells (grids (H, W): ranges first) that no beam happened to meet; return their number.

    Most of their eight neighbours have a return, all at about one range: a beam there would have met the same surface.
    Larger gaps are holes: nothing returned from there.
    """
    ranges = grids[0]
    height, width = ranges.shape
    row, column = np.nonzero(np.isnan(ranges))
    inside = (row > 0) & (row < height - 1) & (column > 0) & (column < width - 1)
    row, column = row[inside], column[inside]
    around = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    near = np.stack([ranges[row + i, column + j] for i, j in around])
    known = np.isfinite(near)
    lowest, highest = np.where(known, near, np.inf).min(axis=0), np.where(known, near, 0).max(axis=0)
    close = (known.sum(axis=0) >= _LEAST_AROUND) & (highest - lowest <= np.maximum(_SAME_M, _SAME * lowest))
    row, column, known = row[close], column[close], known[:, close]
    means = []
    for grid in grids:
        values = np.stack([grid[row + i, column + j] for i, j in around])
        means.append(np.where(known, values, 0).sum(axis=0) / known.sum(axis=0))
    for grid, mean in zip(grids, means, strict=True):
        grid[row, column] = mean
    return len(row)


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
    """Whether the points are strewn, as by sweeps added up: cells contain several, whose mean is taken."""


def _arranged(latitude: FloatArray, longitude: FloatArray, beam: IntArray | None, most_cells: int) -> _Plan:
    centre, span = _centre_of(longitude)
    longitude = wrap_angle(longitude - centre)
    labels = _rings_of(latitude, beam)
    if labels is not None:
        step = _step_along_rings(longitude, labels)
        if step is not None:
            ring_law, at = _on_rings(latitude, longitude, labels, step, centre, most_cells)
            return _Plan(ring_law, at[:, 0] * ring_law.shape[1] + at[:, 1], ring_law.shape[0])
    d_latitude, d_longitude, accumulated = _steps(longitude, latitude)
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
    values = np.unique(longitude if len(longitude) <= _LARGE else np.floor(longitude * 1e4) / 1e4)
    gaps = np.diff(np.append(values, values[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    if gaps[widest] < 0.1:  # a full turn with small holes: the seam belongs behind the scanner
        return 0.0, 2 * np.pi
    start = values[(widest + 1) % len(values)]
    span = 2 * np.pi - float(gaps[widest])
    return float(wrap_angle(start + span / 2)), span


def _rings_of(latitude: FloatArray, beam: IntArray | None) -> IntArray | None:
    """Return the row (N,) of each point, counted from the highest ring; None without rings."""
    if beam is not None:
        labels, overlap = _ordered_labels(latitude, np.unique(beam, return_inverse=True)[1])
        if overlap < _MOST_OVERLAP:
            return labels
    if len(latitude) > _LARGE:  # a share of them shows whether there are rings at all
        few = np.random.default_rng(_SEED).choice(latitude, _LARGE // 4)
        if _rings_of(few, None) is None:
            return None
    lowest, highest = float(latitude.min()), float(latitude.max())
    bins = int(np.clip(len(latitude) // 4, 64, 1 << 15))
    if highest - lowest < 1e-6:
        return None
    counts = np.histogram(latitude, bins=bins, range=(lowest, highest))[0].astype(np.float64)
    position = (latitude - lowest) / (highest - lowest) * bins
    best, least = None, _MOST_OVERLAP
    for sigma in (1.0, 2.0, 4.0, 8.0, 16.0, 32.0):
        bounds = _valleys(_smoothed(counts, sigma))
        if len(bounds) + 1 > len(latitude) / _LEAST_ON_A_RING:
            continue
        if len(bounds) + 1 < _LEAST_RINGS:
            break
        labels, overlap = _ordered_labels(latitude, np.searchsorted(bounds, position))
        if overlap < least:
            best, least = labels, overlap
        if least < _CLEAN_OVERLAP:
            break
    return best


def _smoothed(counts: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    reach = int(np.ceil(3 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.convolve(counts, kernel / kernel.sum(), mode="full")[reach : reach + len(counts)]


def _valleys(density: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bins that separate the peaks of the density; a valley must be below a third of both its peaks."""
    bounds: list[float] = []
    peak, low, low_from, low_to = 0.0, np.inf, 0, 0
    # A floor prevents stray points between the rings from counting as peaks.
    floor = 0.02 * float(np.percentile(density[density > 0], 95)) if (density > 0).any() else 0.0
    for k, value in enumerate(density.tolist()):
        if value > peak and low == np.inf:
            peak = value
        elif value < low and value < peak / 3:
            low, low_from, low_to = value, k, k
        elif value == low:
            low_to = k
        elif low < np.inf and value > 3 * low and value > floor:
            bounds.append((low_from + low_to + 1) / 2)
            peak, low = value, np.inf
    return np.array(bounds)


def _ordered_labels(latitude: FloatArray, group: IntArray) -> tuple[IntArray, float]:
    """Return the groups numbered from the highest latitude, and their overlap.

    The overlap is the interquartile range of a group in units of the distance to its nearest neighbour: .5 for evenly
    spread latitudes, infinite if the groups cannot be ordered.
    """
    sorting = np.lexsort((latitude, group))
    values, groups = latitude[sorting], group[sorting]
    starts = np.flatnonzero(np.diff(groups, prepend=-1))
    sizes = np.diff(np.append(starts, len(groups)))
    if len(starts) < 2:
        return group, np.inf

    def quantile(q: float) -> FloatArray:
        return np.asarray(values[starts + np.floor(q * (sizes - 1)).astype(np.intp)])

    middle, spread = quantile(0.5), quantile(0.75) - quantile(0.25)
    order = np.argsort(-middle, kind="stable")
    steps = -np.diff(middle[order])
    if steps.min() <= 0:
        return group, np.inf
    nearest = np.minimum(np.append(np.inf, steps), np.append(steps, np.inf))
    overlap = float(np.average(spread[order] / nearest, weights=sizes[order]))
    row_of = np.empty(len(order), np.intp)
    row_of[order] = np.arange(len(order))
    labels = np.empty(len(groups), np.intp)
    labels[sorting] = row_of[np.cumsum(np.diff(groups, prepend=groups[0]) != 0)]
    return labels, overlap


def _step_along_rings(longitude: FloatArray, labels: IntArray) -> float | None:
    """Return the longitude step of the beams, rad; None if the rings are not sequences of equal steps."""
    order = np.lexsort((longitude, labels))
    gaps = np.diff(longitude[order])[np.diff(labels[order]) == 0]
    gaps = gaps[gaps > 1e-7]
    if len(gaps) < LEAST_POINTS:
        return None
    step = float(np.median(gaps))
    for _ in range(3):  # gaps are whole multiples of the step
        whole = np.rint(gaps / step)
        near = (whole >= 1) & (whole <= 4)
        if not near.any():
            return None
        step = float(np.median(gaps[near] / whole[near]))
    return step if step < 0.4 else None


def _on_rings(
    latitude: FloatArray, longitude: FloatArray, labels: IntArray, step: float, centre: float, most_cells: int
) -> tuple[RingGrid, IntArray]:
    rows = int(labels.max()) + 1
    sizes = np.bincount(labels, minlength=rows)
    order = np.lexsort((latitude, labels))
    starts = np.append(0, np.cumsum(sizes)[:-1])
    middle = latitude[order][starts + sizes // 2]
    full = float(np.ptp(longitude)) > 2 * np.pi - 4 * step
    if full:  # a full turn has a whole number of columns
        step = 2 * np.pi / max(2, round(2 * np.pi / step))
    step = max(step, 2 * np.pi / _MOST_COLUMNS, float(np.ptp(longitude)) * rows / most_cells)

    position = -longitude / step
    spin = np.exp(2j * np.pi * position)
    common = np.angle(spin.sum()) / (2 * np.pi)
    per_ring = np.bincount(labels, spin.real, rows) + 1j * np.bincount(labels, spin.imag, rows)
    phases = np.angle(per_ring * np.exp(-2j * np.pi * common)) / (2 * np.pi)
    phases[np.abs(per_ring) < 0.3 * sizes] = 0.0  # no phase: the ring's points are not at equal steps
    index = position - common - phases[labels]
    column = np.rint(index).astype(np.intp)
    if full:
        columns = max(2, round(2 * np.pi / step))
        half = (columns - 1) // 2
        column = (column + half) % columns
        offset = half
    else:
        offset = -int(column.min())
        columns = max(2, int(column.max()) + offset + 1)
        column = column + offset
    column = _spread_collisions(labels, column, index - np.rint(index), columns)
    # The law's centre is the longitude of column (W - 1)/2 at phase 0.
    law_centre = centre - ((columns - 1) / 2 - offset + common) * step
    law = RingGrid(middle, phases, columns, step, float(wrap_angle(law_centre)))
    return law, np.stack([labels, column], axis=-1)


def _spread_collisions(rows: IntArray, column: IntArray, rest: FloatArray, columns: int) -> IntArray:
    """Move the second point of a cell into the empty neighbour on its side: jitter causes such pairs."""
    result = column.copy()
    for direction in (1, -1):
        flat = rows.astype(np.int64) * columns + result
        order = np.lexsort((rest * direction, flat))
        last = np.append(np.diff(flat[order]) != 0, True)
        crowded = np.append(False, np.diff(flat[order]) == 0)
        movers = order[last & crowded]
        movers = movers[(rest[movers] * direction > 0) & (result[movers] + direction < columns)]
        movers = movers[result[movers] + direction >= 0]
        taken = np.unique(flat)
        target = flat[movers] + direction
        at = np.minimum(np.searchsorted(taken, target), len(taken) - 1)
        movers = movers[taken[at] != target]
        result[movers] += direction
    return result


def _steps(longitude: FloatArray, latitude: FloatArray) -> tuple[float, float, bool]:
    """Return (latitude step, longitude step), rad, from the spacing of the points, and whether these are strewn.

    The density gives the product of the steps; a regular distance to the next point directly above, or beside, gives
    one of them; otherwise the steps are taken as equal. Strewn points come in clusters and gaps: cells that hold
    several of them even where they are sparse are the finest that they support.
    """
    from scipy.spatial import cKDTree

    plane, sample = _windows(_distinct(np.stack([longitude, latitude], axis=-1)))
    count = len(plane)
    if count < LEAST_POINTS:  # too few for spacings: use the spread
        spans = [max(float(np.ptp(angle)), 1e-9) for angle in (longitude, latitude)]
        return float(np.sqrt(spans[0] * spans[1] / count)), float(np.sqrt(spans[0] * spans[1] / count)), False
    neighbours = min(_NEIGHBOURS, count - 1)
    distance, index = cKDTree(plane).query(sample, k=neighbours + 1)
    few = min(16, neighbours)
    area = np.pi * distance[:, few] ** 2 / few
    typical = float(np.sqrt(np.median(area)))
    if not typical > 0:  # most points very nearly coincide
        spans = [max(float(np.ptp(angle)), 1e-9) for angle in (longitude, latitude)]
        typical = float(np.sqrt(spans[0] * spans[1] / count))
    offsets = plane[index] - sample[:, None, :]
    up, up_regular = _next_along(offsets[..., 1], offsets[..., 0], typical)
    side, side_regular = _next_along(offsets[..., 0], offsets[..., 1], typical)
    if max(up_regular, side_regular) < _REGULAR:
        own = np.sqrt(area)
        if len(longitude) >= _LEAST_STREWN and np.percentile(distance[:, 1] / own.clip(1e-12), 10) < _CLUSTERED:
            step = float(np.sqrt(_POINTS_PER_CELL * np.percentile(area, _SPARSE)))
            return step, step, True
        return typical, typical, False
    if min(up_regular, side_regular) >= _REGULAR and 0.5 < up * side / typical**2 < 2:
        return up, side, False
    return (up, typical**2 / up, False) if up_regular >= side_regular else (typical**2 / side, side, False)


def _windows(plane: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points (N, 2) and a sample of them (K, 2) whose neighbours are among them.

    Of a large cloud, these are the points of some windows of the view: a tree of all points would take half a minute.
    """
    generator = np.random.default_rng(_SEED)
    count = len(plane)
    if count <= _LARGE:
        return plane, plane if count <= _SAMPLES else plane[generator.choice(count, _SAMPLES, replace=False)]
    low, span = plane.min(axis=0), np.ptp(plane, axis=0)
    side = np.sqrt(span[0] * span[1] * _WINDOW_POINTS / count)
    place = (plane - low) / side
    across = int(place[:, 0].max()) + 1
    window = place[:, 1].astype(np.intp) * across + place[:, 0].astype(np.intp)
    chosen = np.unique(window[generator.choice(count, _WINDOWS)])
    inside = np.isin(window, chosen)
    place, plane = place[inside] % 1, plane[inside]
    inner = np.flatnonzero((np.abs(place - 0.5) < 0.2).all(axis=1))
    if not len(inner):
        inner = np.arange(len(plane))
    return plane, plane[generator.choice(inner, min(_SAMPLES, len(inner)), replace=False)]


def _distinct(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distinct rows, in their order: a tree is of no use with many coincident points."""
    first = np.unique(plane.view(np.complex128)[:, 0], return_index=True)[1]
    return plane if len(first) == len(plane) else plane[np.sort(first)]


def _next_along(along: FloatArray, across: FloatArray, typical: float) -> tuple[float, float]:
    """Return the median distance to the next point along an axis, and the share of points within 10 % of it."""
    beside = (np.abs(across) < _STRIP * typical) & (along > 1e-3 * typical)
    nearest = np.where(beside, along, np.inf).min(axis=1)
    found = nearest[np.isfinite(nearest)]
    if len(found) < 0.5 * len(nearest):
        return typical, 0.0
    middle = float(np.median(found))
    return middle, float(np.mean(np.abs(nearest - middle) < 0.1 * middle))


def _bounded(
    height_rad: float, width_rad: float, d_latitude: float, d_longitude: float, most_cells: int
) -> tuple[float, float]:
    """Increase the steps until the grid is within the size limits."""
    d_latitude = min(max(d_latitude, height_rad / _MOST_ROWS, 1e-6), 0.49)
    d_longitude = min(max(d_longitude, width_rad / _MOST_COLUMNS, 1e-6), 0.49)
    cells = (height_rad / d_latitude + 1) * (width_rad / d_longitude + 1)
    factor = float(np.sqrt(max(1.0, cells / most_cells)))
    return min(d_latitude * factor, 0.49), min(d_longitude * factor, 0.49)
