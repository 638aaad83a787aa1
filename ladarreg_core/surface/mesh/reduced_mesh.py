"""The mesh of a large scan reduced by error: flat parts of its grid become large triangles, without cracks.

The grid is divided into square blocks, from the largest size down: a block in which all neighbours are one surface, and
whose inverse ranges are bilinear to a tolerance, is drawn as a whole. A block is a fan around its centre over every
vertex that a neighbour has on its border, so that blocks of different sizes meet without cracks.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.foundations.validation import require_int
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import (
    GridEdges,
    Mesh,
    across_seam,
    continued,
    grid_edges,
    grid_faces,
    typical_range,
    whole_blocks,
)

MAX_FACES = 4_000_000
"""Triangles of the largest model that is written by default."""
_SIZES = (32, 16, 8, 4, 2)
_NOISE_SIGMAS = 4.0
_MIN_RELATIVE = 0.0005
_COARSER = 1.5
_MAX_ROUNDS = 8
_ROWS_AT_ONCE = 512  # a multiple of the largest size
_BLOCKS_AT_ONCE = 2_000_000  # cells


@dataclass(frozen=True, slots=True, eq=False)
class ReducedMesh:
    """A mesh and the error that it was reduced by."""

    mesh: Mesh
    """The mesh."""
    tolerance_m: float
    """Largest difference along the ray between the mesh and a measured range within it, m; 0: not reduced."""


def reduced_mesh(
    scan: Scan, *, tolerance_m: float | None = None, most_faces: int = MAX_FACES, groups: IntArray | None = None
) -> ReducedMesh:
    """Return the surface of a scan, across the seam of a full turn, with as few triangles as a tolerance allows.

    Args:
        scan: the scan.
        tolerance_m: largest difference along the ray, m; None: four times the range noise, at least a 2000th of the
            median range.
        most_faces: largest number of triangles; the tolerance is increased, and at last the grid thinned, until there
            are no more.
        groups: (H, W) whole numbers; only cells of one group are drawn together, so that a triangle with corners of
            two groups is as small as a cell. None: all are one group.

    Raises:
        OptionError: if `most_faces` is below 1000.
    """
    require_int(most_faces, "most_faces", least=1000)
    part, stride = scan, 1
    while True:
        edges = grid_edges(part)
        if tolerance_m is None:
            tolerance_m = max(_NOISE_SIGMAS * edges.noise_m, _MIN_RELATIVE * typical_range(part.ranges))
        ranges, grouped = part.ranges, None if groups is None else groups[::stride, ::stride]
        seam = across_seam(part, edges)
        if seam is not None:
            ranges, edges = continued(ranges, edges, seam)
            grouped = None if grouped is None else np.concatenate([grouped, grouped[:, :1]], axis=1)
        for _ in range(_MAX_ROUNDS):
            blocks = _Blocks(ranges, edges, tolerance_m, grouped)
            if blocks.least_faces > most_faces:
                break  # the rest is not flat at any tolerance: only thinning helps
            faces = blocks.faces()
            if len(faces) <= most_faces:
                return ReducedMesh(_mesh_of(part, faces, stride, scan.shape, columns=ranges.shape[1]), tolerance_m)
            tolerance_m *= _COARSER
        stride += 1
        part = scan.window(slice(None, None, stride), slice(None, None, stride))


def _mesh_of(scan: Scan, faces: IntArray, stride: int, shape: tuple[int, int], *, columns: int) -> Mesh:
    """Return the mesh of triangles on a grid of so many columns, which has one more than the scan across a seam."""
    used = np.zeros(scan.shape[0] * columns, np.bool_)
    used[faces] = True
    kept = np.flatnonzero(used)
    index = np.zeros(len(used), np.int32)
    index[kept] = np.arange(len(kept), dtype=np.int32)
    faces = index.take(faces)
    del used, index
    row, column = np.divmod(kept, columns)
    vertices = np.empty((len(kept), 3), np.float32)
    starts = np.searchsorted(row, np.arange(0, scan.shape[0] + _ROWS_AT_ONCE, _ROWS_AT_ONCE))
    for k, (first, last) in enumerate(pairwise(starts)):
        top = k * _ROWS_AT_ONCE
        points = scan.points_at(slice(top, top + _ROWS_AT_ONCE), slice(None)).reshape(-1, 3)
        cells = (row[first:last] - top) * scan.shape[1] + column[first:last] % scan.shape[1]
        vertices[first:last] = points.take(cells, axis=0)
    faces = _toward_scanner(faces, vertices)
    cells = np.stack([row, column], axis=-1).astype(np.int32) * np.int32(stride)
    if columns > scan.shape[1]:
        np.minimum(cells[:, 1], shape[1], out=cells[:, 1])
    for array in (vertices, faces, cells):
        array.flags.writeable = False  # handed over, not copied
    return Mesh(vertices, faces, cells, shape)


def _toward_scanner(faces: IntArray, vertices: FloatArray) -> IntArray:
    if not len(faces):
        return faces
    sample = faces[:: max(1, len(faces) // 2000)]
    a, b, c = (vertices[sample[:, k]].astype(np.float64) for k in range(3))
    outward = (np.cross(b - a, c - a) * a).sum(axis=-1)
    return np.ascontiguousarray(faces[:, ::-1]) if np.count_nonzero(outward > 0) * 2 > len(sample) else faces


class _Blocks:
    """Division of a grid into flat blocks and single cells."""

    def __init__(self, ranges: FloatArray, edges: GridEdges, tolerance_m: float, groups: IntArray | None) -> None:
        self._ranges, self._edges, self._groups = ranges, edges, groups
        self._height, self._width = ranges.shape
        self._single = np.ones((self._height - 1, self._width - 1), np.bool_)
        self._corners: dict[int, IntArray] = {}
        found: dict[int, list[IntArray]] = {size: [] for size in _SIZES}
        for top in range(0, self._height - 1, _ROWS_AT_ONCE):
            for size, corners in self._band(top, tolerance_m).items():
                found[size].append(corners)
        self._corners = {size: np.concatenate(parts) for size, parts in found.items() if parts}

    @property
    def least_faces(self) -> int:
        """Triangles of the cells in no block, at most two each, where their edges are surface."""
        whole = self._single & self._edges.right[:-1] & self._edges.down[:, :-1]
        return int(2 * np.count_nonzero(whole)) if self._corners else 0

    def faces(self) -> NDArray[np.int32]:
        """Return the triangles (F, 3), flat cell indices, all of one orientation on the grid."""
        single = []
        for top in range(0, self._height - 1, _ROWS_AT_ONCE):
            bottom = min(top + _ROWS_AT_ONCE, self._height - 1)
            rows = slice(top, bottom + 1)
            edges = GridEdges(self._edges.right[rows], self._edges.down[top:bottom], self._edges.noise_m)
            part = grid_faces(self._ranges[rows], edges, wanted=self._single[top:bottom])
            single.append(part + np.int32(top * self._width))
        faces = np.concatenate(single)
        vertex = np.zeros(self._height * self._width, np.bool_)
        vertex[faces] = True
        for size, corners in self._corners.items():
            for offset in (0, size, size * self._width, size * (self._width + 1)):
                vertex[corners + offset] = True
        fans = [self._fans(corners, size, vertex) for size, corners in self._corners.items()]
        return np.concatenate([faces, *fans])

    def _band(self, top: int, tolerance_m: float) -> dict[int, IntArray]:
        """Find the blocks below a row; return the flat index of their upper left corners by size."""
        bottom = min(top + _ROWS_AT_ONCE, self._height - 1)
        right, down = self._edges.right[top : bottom + 1], self._edges.down[top:bottom]
        whole: BoolArray = right[:-1] & right[1:] & down[:, :-1] & down[:, 1:]
        if self._groups is not None:
            group = self._groups[top : bottom + 1]
            beside, below = group[:, 1:] == group[:, :-1], group[1:, :-1] == group[:-1, :-1]
            whole &= beside[:-1] & beside[1:] & below
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            q = np.float32(1) / self._ranges[top : bottom + 1]
        found = {}
        for size in _SIZES:
            height, width = (n // size for n in whole.shape)
            if not (height and width):
                continue
            row, column = (axis * size for axis in np.nonzero(whole_blocks(whole, size)))
            flat = self._is_flat(q, row, column, size, tolerance_m)
            row, column = row[flat], column[flat]
            found[size] = ((row + top) * self._width + column).astype(np.int32)
            taken = np.zeros((height, width), np.bool_)
            taken[row // size, column // size] = True
            drawn = np.repeat(np.repeat(taken, size, axis=0), size, axis=1)
            whole[: height * size, : width * size] &= ~drawn
            self._single[top : top + height * size, : width * size] &= ~drawn
        return found

    @staticmethod
    def _is_flat(q: FloatArray, row: IntArray, column: IntArray, size: int, tolerance_m: float) -> BoolArray:
        """Return which blocks are bilinear in inverse range, to a tolerance of range; the centre is checked first."""
        flat = np.ones(len(row), np.bool_)
        steps = np.arange(size + 1)
        for checked in (np.array([0, size // 2, size]), steps):
            left = np.flatnonzero(flat)
            weight = (checked / size).astype(np.float32)
            at_once = max(1, _BLOCKS_AT_ONCE // len(checked) ** 2)
            for first in range(0, len(left), at_once):
                some = left[first : first + at_once]
                corner = row[some] * q.shape[1] + column[some]
                values = q.take(corner[:, None, None] + (checked[:, None] * q.shape[1] + checked))
                upper = values[:, :1, :1] + (values[:, :1, -1:] - values[:, :1, :1]) * weight
                lower = values[:, -1:, :1] + (values[:, -1:, -1:] - values[:, -1:, :1]) * weight
                linear = upper + (lower - upper) * weight[:, None]
                error = np.abs(values - linear)
                flat[some] = (error <= np.float32(tolerance_m) * np.square(values)).all(axis=(1, 2))
        return flat

    def _fans(self, corners: IntArray, size: int, vertex: BoolArray) -> NDArray[np.int32]:
        """Return the triangles of blocks of one size."""
        ring = _ring(size, self._width)
        half = np.int32(size // 2 * (self._width + 1))
        parts = [np.zeros((0, 3), np.int32)]
        at_once = max(1, _BLOCKS_AT_ONCE // len(ring))
        for first in range(0, len(corners), at_once):
            some = corners[first : first + at_once]
            border = some[:, None] + ring
            present = vertex.take(border)
            plain = present.sum(axis=1) == 4
            a, b, c, d = (some[plain] + np.int32(offset) for offset in _corner_offsets(size, self._width))
            parts += [np.stack([a, c, b], axis=-1), np.stack([d, b, c], axis=-1)]
            border, present, centre = border[~plain], present[~plain], some[~plain] + half
            following = _next_present(present)
            block, place = np.nonzero(present)
            ends = border[block, following[block, place]]
            parts.append(np.stack([centre[block], ends, border[block, place]], axis=-1))
        return np.concatenate(parts).astype(np.int32)


def _corner_offsets(size: int, width: int) -> tuple[int, int, int, int]:
    return 0, size, size * width, size * (width + 1)


def _ring(size: int, width: int) -> NDArray[np.int32]:
    """Return the offsets of the border of a block, clockwise from its upper left corner."""
    along = np.arange(size)
    right = along + 0 * width
    down = size + along * width
    left = size * width + size - along
    up = (size - along) * width
    return np.concatenate([right, down, left, up]).astype(np.int32)


def _next_present(present: BoolArray) -> IntArray:
    """Return, for each place of a ring (N, K), the next place that is present."""
    count = present.shape[1]
    place = np.where(
        np.concatenate([present, present], axis=1), np.arange(2 * count, dtype=np.int32), np.int32(4 * count)
    )
    nearest = np.minimum.accumulate(place[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(nearest[:, 1 : count + 1] % count)
