"""Small triangles at the points of a scan without a surface, so that it can be shown with any texture."""

from __future__ import annotations

import numpy as np

from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import Mesh

_CORNERS_RAD = np.deg2rad([90.0, 210.0, 330.0])
_SIZE = 0.004
"""Radius of a facet relative to its range: as large as a point of a scan with a thousand columns."""


def point_facets(scan: Scan, *, max_vertices: int) -> Mesh:
    """Return a triangle facing the scanner at each of the returns, evenly thinned out to at most `max_vertices`."""
    cells = np.flatnonzero(scan.valid)
    cells = cells[:: max(1, -(-3 * len(cells) // max(max_vertices, 3)))]
    at = np.divmod(cells, scan.shape[1])
    rays = scan.geometry.ray_at(np.stack(at, axis=-1)).astype(np.float32)
    centres = (rays * scan.ranges[at][:, None]).astype(np.float64)
    ranges = np.linalg.norm(centres, axis=1, keepdims=True)
    toward = centres / np.maximum(ranges, 1e-12)
    aside = np.cross(toward, np.where(np.abs(toward[:, 2:]) < 0.9, [[0.0, 0, 1]], [[1.0, 0, 0]]))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    above = np.cross(aside, toward)
    corners = [centres + _SIZE * ranges * (np.cos(a) * aside + np.sin(a) * above) for a in _CORNERS_RAD]
    vertices = np.stack(corners, axis=1).reshape(-1, 3)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    grid = np.stack(np.divmod(np.repeat(cells, 3), scan.shape[1]), axis=-1)
    return Mesh(vertices.astype(np.float32), faces, grid.astype(np.int32), scan.shape)
