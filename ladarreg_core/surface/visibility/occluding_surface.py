"""The surface of a scan that hides what is behind it: its mesh, flat parts coarsely, and whole cells at depth edges."""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import GridEdges, grid_edges, grid_faces, whole_blocks
from ladarreg_core.surface.mesh.normals import grid_normals, range_slopes, ray_gradients

_BLOCKS = (16, 4)  # cells; a flat block of 16 x 16 is drawn as two triangles instead of 512
_WIDEST_BLOCK_RAD = 0.07  # a wider one would cut off 0.06 % of the range by its curvature on the grid
_BLOCK_RELATIVE = 0.001
_BLOCK_SIGMAS = 2.5
_STEEPEST_END = 2.0  # tan 63 deg


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """The occluding surface with its normals: everything that does not depend on the pose.

    Points and normals are stored as planes (3, H, W): passes over a million cells are then bound by memory alone.
    """

    vertices: FloatArray
    """(N, 3) m, scanner frame."""
    faces: IntArray
    """(F, 3) indices of vertices."""
    cells: IntArray
    """(N,) flat index of the cell of each of the first vertices; the others are corners of cells at depth edges."""
    faces_of_cells: int
    """Number of the first faces, those between cells."""
    points: FloatArray
    """(3, H, W) m, scanner frame."""
    normals: FloatArray
    """(3, H, W) unit vectors, towards the scanner."""
    distance: FloatArray
    """(H, W): normal times point: the distance of the plane from the scanner, negative."""
    edges: GridEdges
    """Which neighbouring cells lie on one surface."""


_surface_of_scan: WeakKeyDictionary[Scan, Surface] = WeakKeyDictionary()


def occluding_surface(scan: Scan) -> tuple[FloatArray, IntArray]:
    """Return the surface that hides what is behind it: vertices (N, 3), scanner frame, m, and faces (F, 3).

    It has the scan's mesh, flat parts of it coarsely, and whole cells on the near side of depth edges.
    """
    surface = surface_of(scan)
    return surface.vertices, surface.faces


def coarse_mesh(scan: Scan) -> tuple[FloatArray, IntArray, IntArray]:
    """Return the scan's mesh, flat parts of it coarsely: vertices (N, 3), faces (F, 3), and the cell of each vertex.

    Cells are flat indices (N,). It is part of the occluding surface, so that it costs nothing beside that one. Between
    blocks of two sizes there may be gaps of a pixel.
    """
    surface = surface_of(scan)
    return surface.vertices[: len(surface.cells)], surface.faces[: surface.faces_of_cells], surface.cells


def surface_of(scan: Scan) -> Surface:
    """Return the occluding surface of a scan; it is kept as long as the scan."""
    surface = _surface_of_scan.get(scan)
    if surface is None:
        edges = grid_edges(scan)
        slopes = range_slopes(scan, edges)
        rays = np.ascontiguousarray(np.moveaxis(scan.rays, -1, 0), dtype=np.float32)
        gradients = ray_gradients(rays)
        vertices, faces, cells, faces_of_cells = _occluder(scan, edges, slopes, rays, gradients)
        points = rays * scan.ranges
        normals = grid_normals(scan, rays, gradients, slopes)
        distance = normals[0] * points[0] + normals[1] * points[1] + normals[2] * points[2]
        surface = _surface_of_scan[scan] = Surface(
            vertices, faces, cells, faces_of_cells, points, normals, distance, edges
        )
    return surface


def _occluder(
    scan: Scan,
    edges: GridEdges,
    slopes: tuple[FloatArray, FloatArray],
    rays: FloatArray,
    gradients: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, IntArray, IntArray, int]:
    """Return the occluding triangles: the scan's mesh, flat blocks drawn coarsely, and whole cells at depth edges.

    They are followed by the cells of the mesh's vertices and the number of its faces, as in `Surface`.
    """
    points = scan.points.reshape(-1, 3)
    height, width = scan.shape
    undrawn = np.ones((height - 1, width - 1), dtype=np.bool_)
    parts = []
    for size in _BLOCKS:
        if size * max(scan.geometry.step_rad) > _WIDEST_BLOCK_RAD:
            continue
        flat = _flat_blocks(scan.ranges, edges, undrawn, size)
        row, column = np.nonzero(flat)
        a = (row * size * width + column * size).astype(np.int32)
        b, c, d = a + size, a + size * width, a + size * (width + 1)
        parts += [np.stack([a, c, b], axis=-1), np.stack([d, b, c], axis=-1)]
        drawn = np.repeat(np.repeat(flat, size, axis=0), size, axis=1)
        undrawn[: drawn.shape[0], : drawn.shape[1]] &= ~drawn
    faces = np.concatenate([grid_faces(scan.ranges, edges, wanted=undrawn), *parts])
    used = np.zeros(len(points), dtype=np.bool_)
    used[faces] = True
    kept = np.flatnonzero(used)
    index = np.zeros(len(points), dtype=np.int32)
    index[kept] = np.arange(len(kept), dtype=np.int32)

    # A cell seen by the scanner at a slant is not drawn whole: its extent is unknown.
    upright = [
        np.abs(slope) <= _STEEPEST_END * step for slope, step in zip(slopes, scan.geometry.step_rad, strict=True)
    ]
    row, column = np.nonzero(_near_side(scan.ranges, edges) & upright[0] & upright[1])
    ray, r = rays[:, row, column], scan.ranges[row, column]
    corners = []
    for i, j in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)):
        change = i * slopes[0][row, column] + j * slopes[1][row, column]
        direction = ray + i * gradients[0][:, row, column] + j * gradients[1][:, row, column]
        corners.append((direction * (r * np.exp(change))).T)
    n = len(row)
    first = len(kept) + np.arange(n, dtype=np.int32)
    whole = [np.stack([first, first + k * n, first + (k + 1) * n], axis=-1) for k in (1, 2)]
    vertices = np.concatenate([points.take(kept, axis=0), *corners]).astype(np.float32, copy=False)
    return vertices, np.concatenate([index.take(faces), *whole]).astype(np.int32, copy=False), kept, len(faces)


def _flat_blocks(ranges: FloatArray, edges: GridEdges, wanted: BoolArray, size: int) -> BoolArray:
    """Return which blocks of size x size wanted cells are one flat surface, (block rows, block columns)."""
    n = size
    height, width = ((length - 1) // n for length in ranges.shape)
    if height == 0 or width == 0:
        return np.zeros((height, width), dtype=np.bool_)
    whole = wanted & edges.right[:-1] & edges.right[1:] & edges.down[:, :-1] & edges.down[:, 1:]
    flat = whole_blocks(whole, n)
    with np.errstate(over="ignore", invalid="ignore"):
        q = 1 / ranges[: height * n + 1, : width * n + 1]
        corners = np.ascontiguousarray(q[::n, ::n])
        weight = np.arange(n, dtype=np.float32) / np.float32(n)
        top, bottom = corners[:-1], corners[1:]
        limit = _BLOCK_RELATIVE * top[:, :-1] + np.float32(_BLOCK_SIGMAS * edges.noise_m) * top[:, :-1] ** 2
        for k in range(n):
            line = top + weight[k] * (bottom - top)
            for m in range(n):
                linear = line[:, :-1] + weight[m] * (line[:, 1:] - line[:, :-1])
                flat &= np.abs(q[k:-1:n, m:-1:n] - linear) <= limit
    return flat


def _near_side(ranges: FloatArray, edges: GridEdges) -> BoolArray:
    """Return the cells (H, W) on the near side of a depth edge or beside a cell without return.

    A cell without surface around it counts only if no neighbour is nearer: one between near and far is a mixed pixel,
    with nothing at its position.
    """
    shape = ranges.shape
    at_edge, has_nearer, has_surface = (np.zeros(shape, dtype=np.bool_) for _ in range(3))
    before_after = (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None)), edges.right),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None)), edges.down),
    )
    with np.errstate(invalid="ignore"):
        for before, after, together in before_after:
            for here, there in ((before, after), (after, before)):
                has_surface[here] |= together
                at_edge[here] |= ~together & ~(ranges[there] < ranges[here])
                has_nearer[here] |= ~together & (ranges[there] < ranges[here])
    return np.asarray(np.isfinite(ranges) & at_edge & (has_surface | ~has_nearer))
