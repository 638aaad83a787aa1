"""Arranges the points of clouds without a grid in rows and columns, by spherical projection.

The rings of spinning scanners become rows, however unequally they are spaced; all other clouds get equal steps of
latitude and longitude, estimated from the cloud itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.arrays import ByteArray, FloatArray, IntArray, read_only
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
_SAME_M = 0.1
_SAME = 0.03


@dataclass(frozen=True, eq=False)
class GriddedCloud:
    """A cloud on a grid; of several points in one cell, the nearest to the scanner is kept."""

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

    @property
    def lost_share(self) -> float:
        """Share of the returns that were dropped because they lie behind others."""
        return 1 - (self.points_kept + self.points_merged) / self.points_in

    def describe(self) -> str:
        """Return a sentence on the gridding, for the notes of the scan."""
        height, width = self.geometry.shape
        rows = f"with its {self.rings} rings as rows" if self.rings else "with rows and columns of equal angle"
        share = format_percent(self.points_kept / self.points_in)
        return f"the cloud has no grid: points arranged in {height} x {width} cells, {rows}; {share} of them kept"


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
        distance = np.linalg.norm(p, axis=1)
    returns = np.flatnonzero(np.isfinite(distance) & (distance > 0))
    if len(returns) < LEAST_POINTS:
        raise ShapeError(f"the cloud has {len(returns)} returns; a scan needs at least {LEAST_POINTS}")
    p, distance = p[returns], distance[returns]
    rays = p / distance[:, None]
    rotation = rotation_from_pole(rays)
    most_cells = min(most_cells, LARGEST_GRID)
    law, cells, rings = _arranged(
        rays if rotation is None else rays @ rotation.T, None if beam is None else beam[returns], most_cells
    )

    height, width = law.shape
    order = np.argsort(
        distance, kind="stable"
    )  # stable: the order of equal ranges must not depend on the sorting method
    flat = cells[order, 0] * width + cells[order, 1]
    _, first = np.unique(flat, return_index=True)
    kept = order[first]
    nearest = np.empty(height * width)
    nearest[flat[first]] = distance[kept]
    nearest = nearest[flat]
    merged = int(np.count_nonzero(distance[order] - nearest <= np.maximum(_SAME_M, _SAME * nearest))) - len(kept)
    row, column = cells[kept, 0], cells[kept, 1]
    table = np.array((law if rotation is None else RotatedGrid(law, rotation)).rays)
    table[row, column] = rays[kept]
    ranges = np.full((height, width), np.nan, np.float32)
    ranges[row, column] = distance[kept]
    out = np.zeros((height, width), np.float32)
    out[row, column] = strength[returns[kept]]
    rgb = None
    if paint is not None:
        rgb = np.zeros((height, width, 3), np.uint8)
        rgb[row, column] = paint[returns[kept]]
    geometry = TabulatedGrid(table, law=law if rotation is None else RotatedGrid(law, rotation))
    return GriddedCloud(geometry, ranges, out, rgb, len(returns), len(kept), merged, rings)


def rotation_from_pole(rays: FloatArray) -> FloatArray | None:
    """Return a rotation (3, 3) of a narrow cloud of unit rays (N, 3) from near the Z axis to the equator; None if the
    cloud is not there.

    Depth cameras write clouds in their optical frame (Z forward, Y down), where up in the image is -Y.
    """
    mean = rays.mean(axis=0)
    if np.linalg.norm(mean) < 0.8 or abs(mean[2]) < 0.7 * np.linalg.norm(mean):
        return None
    forward = np.asarray(CAMERA_AXES_FROM_SCANNER.T)
    return forward if mean[2] > 0 else np.asarray(forward @ rotation_from_rotvec([np.pi, 0.0, 0.0]))


def _arranged(rays: FloatArray, beam: IntArray | None, most_cells: int) -> tuple[ScanGeometry, IntArray, int]:
    """Return the law, the cell (N, 2) of each ray, and the number of rings (0: none)."""
    latitude = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    longitude = np.arctan2(rays[:, 1], rays[:, 0])
    centre, span = _centre_of(longitude)
    longitude = wrap_angle(longitude - centre)
    labels = _rings_of(latitude, beam)
    if labels is not None:
        step = _step_along_rings(longitude, labels)
        if step is not None:
            law, cells = _on_rings(latitude, longitude, labels, step, centre, most_cells)
            return law, cells, law.shape[0]
    d_latitude, d_longitude = _steps(longitude, latitude)
    top, low = float(latitude.max()), float(latitude.min())
    largest = min(most_cells, max(4096, _CELLS_PER_POINT * len(rays)))
    d_latitude, d_longitude = _bounded(top - low, span, d_latitude, d_longitude, largest)
    rows, columns = (int(np.floor(s / d + 1e-9)) + 1 for s, d in ((top - low, d_latitude), (span, d_longitude)))
    if min(rows, columns) < 2:
        raise ShapeError(
            f"the cloud's returns fill {rows} x {columns} cells; a scan needs at least 2 rows and 2 columns"
        )
    # Half of the remainder on each side: the outermost points are then inside the outermost cells.
    spare = ((rows - 1) * d_latitude - (top - low)) / 2
    law_ = SphericalGrid(rows, columns, d_longitude, d_latitude, centre, top + spare)
    cell = np.rint(law_.cell_of(rays)).astype(np.intp)
    return law_, np.clip(cell, 0, [rows - 1, columns - 1]), 0


def _centre_of(longitude: FloatArray) -> tuple[float, float]:
    """Return the centre and span of the longitudes, cut at the widest gap; a full turn is cut behind the scanner."""
    values = np.unique(longitude)
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


def _steps(longitude: FloatArray, latitude: FloatArray) -> tuple[float, float]:
    """Return (latitude step, longitude step), rad, from the spacing of the points.

    The density gives the product of the steps; a regular distance to the next point directly above, or beside, gives
    one of them; otherwise the steps are taken as equal.
    """
    from scipy.spatial import cKDTree

    plane = _distinct(np.stack([longitude, latitude], axis=-1))
    count = len(plane)
    if count < LEAST_POINTS:  # too few for spacings: use the spread
        spans = [max(float(np.ptp(angle)), 1e-9) for angle in (longitude, latitude)]
        return (float(np.sqrt(spans[0] * spans[1] / count)),) * 2
    generator = np.random.default_rng(_SEED)
    sample = plane if count <= _SAMPLES else plane[generator.choice(count, _SAMPLES, replace=False)]
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
        return typical, typical
    if min(up_regular, side_regular) >= _REGULAR and 0.5 < up * side / typical**2 < 2:
        return up, side
    return (up, typical**2 / up) if up_regular >= side_regular else (typical**2 / side, side)


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
