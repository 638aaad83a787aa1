"""The 2.5-D mesh of a scan: triangles over its grid, open at depth edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray, read_only
from ladarreg_core.foundations.validation import require_int
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grid_window import grid_rays

_ALWAYS_SURFACE = 1.0  # tan 45 deg: steeper isolated steps are depth edges
_SURFACE_IF_SUPPORTED = 3.7  # tan 75 deg: steeper surfaces need three equal steps in a row
_SUPPORT = 0.35
_SAME_SLOPE = 0.3
_MIN_SHARE = 0.5
_NOISE_SIGMAS = 6.0
_RELATIVE_NOISE = 0.002
_LARGEST_NOISE = 0.01
_LARGEST_GAP_STEPS = 6.0
_LARGEST_GAP_RAD = 0.35
_NOISE_SAMPLES = 200_000
_LARGEST_WHOLE_SCAN = 4_000_000  # cells; larger scans are processed in bands of rows
_BAND_MARGIN = 4
_SEAM_COLUMNS = 3  # on either side of the seam, which show how the surface goes on
_MIN_SEAM_STEP = 0.25  # of the step before: a scanner that turned farther repeats its first columns


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles over the cells of a scan grid, facing the scanner (counter-clockwise as seen from it)."""

    vertices: FloatArray
    """(N, 3) float32, scanner frame, m."""
    faces: IntArray
    """(F, 3) int32, indices of vertices."""
    cells: IntArray
    """(N, 2) int32, the grid cell (row, column) of each vertex; beyond a full turn's seam, column W is the first."""
    shape: tuple[int, int]
    """(H, W), cells of the full grid."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", read_only(self.vertices, np.float32, (None, 3), "the mesh's vertices"))
        object.__setattr__(self, "faces", read_only(self.faces, np.int32, (None, 3), "the mesh's faces"))
        object.__setattr__(self, "cells", read_only(self.cells, np.int32, (len(self.vertices), 2), "the mesh's cells"))

    @property
    def places(self) -> tuple[IntArray, IntArray]:
        """The row and the column (N,) of each vertex, within the grid."""
        return self.cells[:, 0], self.cells[:, 1] % np.int32(self.shape[1])

    @property
    def uv(self) -> NDArray[np.float32]:
        """(N, 2) texture coordinates of a picture on the full grid: u right, v down, (0, 0) its outer top-left corner.

        The centre of cell (row, column) is ((column + .5)/W, (row + .5)/H); beyond the seam, u is larger than 1.
        """
        size = np.array(self.shape[::-1], dtype=np.float32)
        return np.asarray((self.cells[:, ::-1].astype(np.float32) + np.float32(0.5)) / size)


@dataclass(frozen=True, slots=True, eq=False)
class GridEdges:
    """Whether neighbouring cells lie on one surface; False also if either has no return."""

    right: BoolArray
    """(H, W - 1) bool: cells (i, j) and (i, j + 1)."""
    down: BoolArray
    """(H - 1, W) bool: cells (i, j) and (i + 1, j)."""
    noise_m: float
    """Range noise allowed for, one sigma, estimated from the scan."""


_edges_of_scan: WeakKeyDictionary[Scan, GridEdges] = WeakKeyDictionary()
_mesh_of_scan: WeakKeyDictionary[Scan, Mesh] = WeakKeyDictionary()
_MAX_CELLS_KEPT = 2_000_000  # whose mesh has some 90 MB


def grid_edges(scan: Scan) -> GridEdges:
    """Classify the steps between all neighbouring cells of a scan as surface or depth edge.

    On a plane the inverse range is linear along the grid, at any incidence, so a step in it is compared with the steps
    beside it: a flat step is surface; a steeper one needs a neighbour of the same sign; one steeper than 75 degrees
    needs three equal steps in a row, which mixed pixels between two surfaces do not produce.

    Returns:
        The edges, cached for the lifetime of the scan, which is immutable.
    """
    edges = _edges_of_scan.get(scan)
    if edges is None:
        whole = scan.ranges.size <= _LARGEST_WHOLE_SCAN
        edges = _surface_edges(scan.ranges, scan.rays) if whole else _edges_by_bands(scan)
        _edges_of_scan[scan] = edges
    return edges


def _edges_by_bands(scan: Scan) -> GridEdges:
    """Return the edges of a large scan, from bands of rows with a margin; the noise is the median of the bands."""
    height, width = scan.shape
    right, down = np.zeros((height, width - 1), np.bool_), np.zeros((height - 1, width), np.bool_)
    noise = []
    rows = max(8, _LARGEST_WHOLE_SCAN // 2 // width)
    for first in range(0, height, rows):
        last = min(first + rows, height)
        outer = slice(max(0, first - _BAND_MARGIN), min(height, last + _BAND_MARGIN))
        if not scan.valid[outer].any():
            continue
        part = _surface_edges(scan.ranges[outer], grid_rays(scan.geometry, outer, slice(None)))
        inner = first - outer.start
        right[first:last] = part.right[inner : inner + last - first]
        below = min(last, height - 1)
        down[first:below] = part.down[inner : inner + below - first]
        noise.append(part.noise_m)
    return GridEdges(right, down, float(np.median(noise)))


def across_seam(scan: Scan, edges: GridEdges, columns: IntArray | None = None) -> BoolArray | None:
    """Return where the last column of a scan of the full turn lies on one surface with the first.

    Args:
        scan: the scan.
        edges: its edges, for their noise.
        columns: the columns in use, ascending; None: all.

    Returns:
        (H,) bool; None if that is nowhere so, as with every scan whose ends do not meet.
    """
    if columns is None:
        columns = np.arange(scan.shape[1])
    if len(columns) < 2 * _SEAM_COLUMNS:
        return None
    beside = np.concatenate([columns[-_SEAM_COLUMNS:], columns[:_SEAM_COLUMNS]])
    row, column = np.meshgrid(np.arange(scan.shape[0]), beside, indexing="ij")
    rays = scan.geometry.ray_at(np.stack([row, column], axis=-1)).astype(np.float32)
    before, over = (rays[:, _SEAM_COLUMNS - 1 + k] - rays[:, _SEAM_COLUMNS - 2 + k] for k in (0, 1))
    with np.errstate(over="ignore", invalid="ignore"):
        usual = np.square(before).sum(axis=-1)
        goes_on = (before * over).sum(axis=-1) > _MIN_SEAM_STEP * usual
        goes_on &= np.square(over).sum(axis=-1) <= _LARGEST_GAP_STEPS**2 * usual
        if not goes_on.any():
            return None
        q = (1 / scan.ranges[:, beside]).astype(np.float32)
    planes = np.ascontiguousarray(np.moveaxis(rays, -1, 0))
    joined: BoolArray = _line_edges(q, planes, 1, edges.noise_m)[:, _SEAM_COLUMNS - 1] & goes_on
    return joined if joined.any() else None


def continued(ranges: FloatArray, edges: GridEdges, seam: BoolArray) -> tuple[FloatArray, GridEdges]:
    """Return the ranges (H, W + 1) and edges of a grid whose first column follows once more behind the last."""
    right = np.concatenate([edges.right, seam[:, None]], axis=1)
    down = np.concatenate([edges.down, edges.down[:, :1]], axis=1)
    return np.concatenate([ranges, ranges[:, :1]], axis=1), GridEdges(right, down, edges.noise_m)


def scan_mesh(
    scan: Scan, *, step: int | tuple[int, int] = 1, max_vertices: int | None = None, closed: bool = False
) -> Mesh:
    """Return the surface of a scan, without triangles across depth edges or cells without return.

    Args:
        scan: the scan.
        step: use every n-th cell, one number for both or (rows, columns).
        max_vertices: increase the step, first on the axis with the finer angle, until there are at most this many
            vertices; None: keep the step.

    Returns:
        The mesh, without faces if no three neighbouring cells have returns.

    Raises:
        OptionError: if a step is below 1 or `max_vertices` below 4.
    """
    steps = step if isinstance(step, tuple) else (step, step)
    if len(steps) != 2:
        raise OptionError(f"the mesh's step has {len(steps)} numbers; give one, or two for rows and columns")
    for size in steps:
        require_int(size, "the mesh's step", least=1, unit="cells")
    if max_vertices is not None:
        require_int(max_vertices, "max_vertices", least=4)
    whole = steps == (1, 1) and max_vertices is None and not closed and scan.ranges.size <= _MAX_CELLS_KEPT
    if whole and (kept_mesh := _mesh_of_scan.get(scan)) is not None:
        return kept_mesh
    rows, columns = _decimate(scan, (int(steps[0]), int(steps[1])), max_vertices)
    if len(rows) == scan.shape[0] and len(columns) == scan.shape[1]:
        edges = grid_edges(scan)
        ranges, points = scan.ranges, scan.points
    else:
        every = tuple(slice(None, None, int(chosen[1]) if len(chosen) > 1 else None) for chosen in (rows, columns))
        ranges = scan.ranges[every]
        rays = grid_rays(scan.geometry, *every)  # of these cells alone: those of all might not fit into memory
        points = rays.astype(np.float32) * ranges[..., None]
        edges = _surface_edges(ranges, rays)
    seam = across_seam(scan, edges, columns) if closed else None
    if seam is not None:
        ranges, edges = continued(ranges, edges, seam[rows])
        points = np.concatenate([points, points[:, :1]], axis=1)
        columns = np.append(columns, scan.shape[1])
    faces = _faces_toward_scanner(grid_faces(ranges, edges), points)
    used = np.zeros(ranges.size, dtype=np.bool_)
    used[faces] = True
    kept = np.flatnonzero(used)
    index = np.zeros(ranges.size, dtype=np.int32)
    index[kept] = np.arange(len(kept), dtype=np.int32)
    i, j = np.nonzero(used.reshape(ranges.shape))
    cells = np.empty((len(kept), 2), dtype=np.int32)
    cells[:, 0], cells[:, 1] = rows[i], columns[j]
    vertices, triangles = points.reshape(-1, 3)[kept], index[faces]
    for array in (vertices, triangles, cells):
        array.flags.writeable = False  # handed over, not copied
    mesh = Mesh(vertices, triangles, cells, scan.shape)
    if whole:
        _mesh_of_scan[scan] = mesh
    return mesh


def _decimate(scan: Scan, steps: tuple[int, int], max_vertices: int | None) -> tuple[IntArray, IntArray]:
    (height, width), angles = scan.shape, scan.geometry.step_rad
    row_step, column_step = min(steps[0], height - 1), min(steps[1], width - 1)
    valid = scan.valid
    while max_vertices is not None and np.count_nonzero(valid[::row_step, ::column_step]) > max_vertices:
        can_rows, can_columns = row_step < height - 1, column_step < width - 1
        if can_rows and (row_step * angles[0] <= column_step * angles[1] or not can_columns):
            row_step += 1
        elif can_columns:
            column_step += 1
        else:
            break
    return np.arange(0, height, row_step), np.arange(0, width, column_step)


def grid_faces(ranges: FloatArray, edges: GridEdges, *, wanted: BoolArray | None = None) -> IntArray:
    """Return the triangles of a grid, as flat cell indices, all of one orientation on the grid.

    A triangle is identified by its right-angled corner and exists if the two edges at that corner do. Of the two
    diagonals of a quad, the one that keeps more triangles is used, then the one with the smaller step.

    Args:
        ranges: (H, W) m; NaN = no return.
        edges: surface between neighbours.
        wanted: (H - 1, W - 1) bool, quads to use; None: all.

    Returns:
        faces (F, 3) int32.
    """
    height, width = ranges.shape
    top, bottom, left, right = edges.right[:-1], edges.right[1:], edges.down[:, :-1], edges.down[:, 1:]
    at_00, at_01, at_10, at_11 = top & left, top & right, bottom & left, bottom & right
    with np.errstate(invalid="ignore"):
        step_a = np.abs(ranges[:-1, 1:] - ranges[1:, :-1])  # diagonal of the corners 00 and 11
        step_b = np.abs(ranges[:-1, :-1] - ranges[1:, 1:])
        nearer_a = ~(step_b < step_a)
    count_a, count_b = at_00.view(np.int8) + at_11.view(np.int8), at_01.view(np.int8) + at_10.view(np.int8)
    use_a = (count_a > count_b) | ((count_a == count_b) & nearer_a)
    use_b = ~use_a
    if wanted is not None:
        use_a, use_b = use_a & wanted, use_b & wanted
    corner = np.arange(height * width, dtype=np.int32).reshape(height, width)[:-1, :-1]
    corner, triangles = corner.ravel(), []
    for present, offsets in (
        (at_00 & use_a, (0, width, 1)),
        (at_11 & use_a, (width + 1, 1, width)),
        (at_01 & use_b, (1, 0, width + 1)),
        (at_10 & use_b, (width, width + 1, 0)),
    ):
        at = corner.take(np.flatnonzero(present))
        triangles.append(np.stack([at + np.int32(offset) for offset in offsets], axis=-1))
    return np.concatenate(triangles)


def _faces_toward_scanner(faces: IntArray, points: FloatArray) -> IntArray:
    """Flip all triangles if most of them face away from the scanner: grids may run either way."""
    if not len(faces):
        return faces
    sample = faces[:: max(1, len(faces) // 2000)]
    a, b, c = (points.reshape(-1, 3)[sample[:, k]].astype(np.float64) for k in range(3))
    outward = (np.cross(b - a, c - a) * a).sum(axis=-1)
    return faces[:, ::-1] if np.count_nonzero(outward > 0) * 2 > len(sample) else faces


def whole_blocks(flags: BoolArray, size: int) -> BoolArray:
    """Return in which blocks of `size` x `size` cells all flags (H, W) hold; an incomplete last one is left out."""
    height, width = (n // size * size for n in flags.shape)
    rows = np.ones((height // size, width), np.bool_)
    for k in range(size):
        rows &= flags[k:height:size, :width]
    whole = np.ones((height // size, width // size), np.bool_)
    for k in range(size):
        whole &= rows[:, k::size]
    return whole


def typical_range(ranges: FloatArray) -> float:
    """Return the median range, m, of an evenly spread sample of the returns; 0 where there are none."""
    returns = ranges[np.isfinite(ranges)]
    return float(np.median(returns[:: max(1, returns.size // _NOISE_SAMPLES)])) if len(returns) else 0.0


def _surface_edges(ranges: FloatArray, rays: FloatArray) -> GridEdges:
    with np.errstate(over="ignore"):
        q = (1 / ranges).astype(np.float32)  # ranges are never zero; NaN stays
    noise = _range_noise(ranges, q)
    planes = np.ascontiguousarray(np.moveaxis(rays, -1, 0), dtype=np.float32)
    return GridEdges(_line_edges(q, planes, 1, noise), _line_edges(q, planes, 0, noise), noise)


def _line_edges(q: FloatArray, planes: FloatArray, axis: int, noise_m: float) -> BoolArray:
    """Return which steps along an axis are surface, from inverse ranges q (H, W) and rays (3, H, W)."""
    first, second = ((np.s_[..., :-1], np.s_[..., 1:]), (np.s_[..., :-1, :], np.s_[..., 1:, :]))[1 - axis]
    gap = np.zeros(q[first].shape, dtype=np.float32)
    for plane in planes:
        gap += np.square(plane[second] - plane[first])
    np.sqrt(gap, out=gap)
    step = q[second] - q[first]
    smaller = np.minimum(q[second], q[first])
    larger = np.maximum(q[second], q[first])
    allowance = np.float32(_RELATIVE_NOISE) + np.float32(_NOISE_SIGMAS * noise_m) * larger
    with np.errstate(invalid="ignore"):
        steepness = np.abs(step) / smaller - allowance  # relative to the nearer range, less the noise
        surface = np.asarray(steepness <= np.float32(_ALWAYS_SURFACE) * gap)
        steep = np.nonzero((steepness > np.float32(_ALWAYS_SURFACE) * gap) & np.isfinite(step))
    here = step[steep]
    around = [_beside(step, steep, axis, offset) for offset in (-2, -1, 1, 2)]
    tolerance = allowance[steep] * smaller[steep]
    supported = _is_supported(here, around[1], around[2])
    straight = _is_straight(here, around, tolerance)
    gentle = steepness[steep] <= _SURFACE_IF_SUPPORTED * gap[steep]
    surface[steep] = (gentle & supported) | straight
    usual = float(np.median(gap.ravel()[:: max(1, gap.size // 4096)]))
    surface &= gap <= min(max(_LARGEST_GAP_STEPS * usual, 1e-6), _LARGEST_GAP_RAD)
    return surface


def _beside(step: FloatArray, at: tuple[IntArray, ...], axis: int, offset: int) -> FloatArray:
    """Return the steps `offset` cells further along the axis; NaN outside the grid."""
    index = list(at)
    index[axis] = at[axis] + offset
    inside = (index[axis] >= 0) & (index[axis] < step.shape[axis])
    index[axis] = np.clip(index[axis], 0, step.shape[axis] - 1)
    return np.asarray(np.where(inside, step[tuple(index)], np.nan))


def _is_supported(here: FloatArray, before: FloatArray, after: FloatArray) -> BoolArray:
    """Return whether a neighbouring step has the same sign and a third of the size, or there is no neighbour."""
    with np.errstate(invalid="ignore"):
        least = _SUPPORT * np.abs(here)
        by_before, by_after = before * np.sign(here) >= least, after * np.sign(here) >= least
    return np.asarray(by_before | by_after | (np.isnan(before) & np.isnan(after)))


def _is_straight(here: FloatArray, around: Sequence[FloatArray], tolerance: FloatArray) -> BoolArray:
    """Return whether a step is one of three equal ones in a row, as on a plane at any incidence."""

    def equal(a: FloatArray, b: FloatArray) -> Any:
        smaller, larger = np.minimum(np.abs(a), np.abs(b)), np.maximum(np.abs(a), np.abs(b))
        # The share prevents noise from making a flat neighbour of a jump look like its continuation.
        return (larger - smaller <= _SAME_SLOPE * larger + tolerance) & (smaller >= _MIN_SHARE * larger) & (a * b > 0)

    two_before, before, after, two_after = around
    with np.errstate(invalid="ignore"):
        left, right = equal(here, before), equal(here, after)
        result = (left & right) | (left & equal(before, two_before)) | (right & equal(after, two_after))
    return np.asarray(result, dtype=np.bool_)


def _range_noise(ranges: FloatArray, q: FloatArray) -> float:
    """Estimate the range noise, one sigma, m, from second differences of the inverse range, which vanish on planes.

    The smaller estimate of the two axes is used, since the coarser axis also measures the shape of the scene. The range
    quantum of a scanner counts as noise although most of its second differences are zero.
    """
    typical = typical_range(ranges)
    estimates = []
    for axis in (0, 1):
        if q.shape[axis] < 3:
            continue
        lines = q if axis == 1 else q.T
        lines = lines[:: max(1, lines.size // _NOISE_SAMPLES)]
        with np.errstate(invalid="ignore"):
            second = lines[:, 2:] - 2 * lines[:, 1:-1] + lines[:, :-2]
            bend_m = np.abs(second) / lines[:, 1:-1] ** 2
        bend_m = bend_m[np.isfinite(bend_m)]
        if len(bend_m):
            inner = bend_m[bend_m <= np.quantile(bend_m, 0.9)]
            estimates.append(1.3 * float(np.sqrt(np.mean(np.square(inner, dtype=np.float64)))) / np.sqrt(6))
    noise = min(estimates, default=0.0)
    line_steps = np.abs(np.diff(ranges[:: max(1, ranges.size // _NOISE_SAMPLES)], axis=1))
    line_steps = line_steps[line_steps > 4e-6 * typical]
    quantum = float(np.quantile(line_steps, 0.01)) if len(line_steps) else 0.0
    return float(min(max(noise, quantum / np.sqrt(12)), _LARGEST_NOISE * typical))
