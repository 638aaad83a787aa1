import gzip
import struct

import numpy as np
import pytest

from ladarreg_core.errors import ExportError
from ladarreg_core.export.models.packed_mesh import MAGIC, packed_mesh
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.mesh.facets import point_facets
from ladarreg_core.surface.mesh.grid_mesh import Mesh, scan_mesh


def unpacked(data):
    """Decode as static/js/panels/model/model_parts.js does."""
    plain = gzip.decompress(data)
    magic, vertices, faces, rows, columns, unit = struct.unpack_from("<4s4Id", plain)
    assert magic == MAGIC
    at, found = 28, []
    for count in [vertices] * 5 + [faces] * 3:
        planes = np.frombuffer(plain, np.uint8, 4 * count, at).reshape(4, count).astype(np.uint32)
        zigzag = planes[0] | planes[1] << 8 | planes[2] << 16 | planes[3] << 24
        found.append((zigzag >> 1).astype(np.int64) ^ -(zigzag & 1).astype(np.int64))
        at += 4 * count
    assert at == len(plain)
    x, y, z, row, column, first = (np.cumsum(values) for values in found[:6])
    corners = np.stack([first, first + found[6], first + found[7]], axis=-1)
    return np.stack([x, y, z], axis=-1) * unit, np.stack([row, column], axis=-1), corners, (rows, columns), unit


def test_a_mesh_survives_within_half_a_unit(scan):
    mesh = scan_mesh(scan)
    vertices, cells, faces, shape, unit = unpacked(packed_mesh(mesh))
    np.testing.assert_array_equal(faces, mesh.faces)
    np.testing.assert_array_equal(cells, mesh.cells)
    assert shape == mesh.shape
    assert np.abs(vertices - mesh.vertices).max() <= 0.5001 * unit
    assert 1e-4 <= unit < 1e-3


def test_a_far_vertex_does_not_overflow(scan):
    mesh = scan_mesh(scan)
    moved = np.array(mesh.vertices)
    moved[0] = [2e6, -2e6, 1]
    vertices, *_ = unpacked(packed_mesh(Mesh(moved, mesh.faces, mesh.cells, mesh.shape)))
    np.testing.assert_allclose(vertices[0], moved[0], rtol=1e-6, atol=0.01)


def test_it_is_much_smaller_than_its_arrays():
    geometry = AzimuthElevation(200, 300, 0.003, 0.003)
    noise = np.random.default_rng(0).normal(0, 0.005, (200, 300))
    mesh = scan_mesh(Scan(geometry, 3 / geometry.rays[..., 0] + noise, np.ones((200, 300))))
    arrays = mesh.vertices.nbytes + mesh.uv.nbytes + mesh.faces.nbytes
    assert len(packed_mesh(mesh)) < arrays / 5


def test_a_scan_without_surface_becomes_facets_that_face_the_scanner():
    geometry = AzimuthElevation(40, 60, 0.01, 0.01)
    ranges = np.full((40, 60), np.nan)
    ranges[::4, ::4] = 3.0
    scan = Scan(geometry, ranges, np.ones((40, 60)))
    with pytest.raises(ExportError):
        packed_mesh(scan_mesh(scan))
    mesh = point_facets(scan, max_vertices=10_000)
    assert len(mesh.faces) == np.isfinite(ranges).sum()
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    centres = (a + b + c) / 3
    np.testing.assert_allclose(centres, scan.points[scan.valid], atol=1e-5)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), centres) < 0).all()
    assert len(point_facets(scan, max_vertices=90).vertices) <= 90
    unpacked(packed_mesh(mesh))
