"""A mesh as a small stream of integers for the page's 3-D view, where a GLB would be five times as large."""

from __future__ import annotations

import gzip
import struct

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ExportError
from ladarreg_core.foundations.arrays import IntArray
from ladarreg_core.surface.mesh.grid_mesh import Mesh

MAGIC = b"LRM1"
_HEADER = "<4s4Id"  # magic, vertices, faces, rows, columns, unit in m: 28 bytes
_STEPS_PER_RANGE = 20_000
_FINEST_M = 1e-4
_COARSEST_STEP = 2**30
_COMPRESSION = 6


def packed_mesh(mesh: Mesh) -> bytes:
    """Return a mesh, compressed by gzip.

    Decompressed it is a header, then columns of 32-bit integers: x, y and z of the vertices in units, their rows, their
    columns, and the three corners of the faces. Positions and cells are differences to the preceding vertex; the first
    corner of a face is the difference to that of the preceding face, the other two are relative to it. The differences
    are zigzag-coded (0, -1, 1, -2 ... become 0, 1, 2, 3 ...), and stored byte by byte, all lowest bytes first.

    The unit is a 20,000th of the median distance, at least 0.1 mm: finer than the scanner's noise, and invisible.

    Raises:
        ExportError: if the mesh has no faces.
    """
    if not len(mesh.faces):
        raise ExportError("the scan has no surface: no three neighbouring cells are connected; no model is written")
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    typical = float(np.median(np.linalg.norm(vertices, axis=1)))
    farthest = float(np.abs(vertices).max())
    unit = max(typical / _STEPS_PER_RANGE, _FINEST_M, farthest / _COARSEST_STEP)
    columns = [
        *(_differences(column) for column in np.rint(vertices / unit).astype(np.int64).T),
        *(_differences(column) for column in mesh.cells.astype(np.int64).T),
    ]
    first, second, third = mesh.faces.astype(np.int64).T
    columns += [_differences(first), second - first, third - first]
    header = struct.pack(_HEADER, MAGIC, len(vertices), len(mesh.faces), *mesh.shape, unit)
    return gzip.compress(header + b"".join(_planes(column) for column in columns), _COMPRESSION, mtime=0)


def _differences(column: IntArray) -> NDArray[np.int64]:
    return np.diff(column, prepend=0)


def _planes(column: IntArray) -> bytes:
    zigzag = ((column << 1) ^ (column >> 63)).astype("<u4")
    return np.ascontiguousarray(zigzag.view(np.uint8).reshape(-1, 4).T).tobytes()
