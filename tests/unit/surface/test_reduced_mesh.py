"""The reduced mesh stays within its tolerance, has no cracks, and keeps depth edges open."""

import numpy as np
import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid
from ladarreg_core.surface.mesh import grid_mesh as mesh_module
from ladarreg_core.surface.mesh.grid_mesh import grid_edges, scan_mesh
from ladarreg_core.surface.mesh.reduced_mesh import reduced_mesh

STEP = 0.004
GEOMETRY = SphericalGrid(170, 230, STEP, STEP, 0.1, 0.3)


def wall_with_a_panel(*, panel: bool = True) -> Scan:
    rays = GEOMETRY.rays
    wall, near = 4 / rays[..., 0], 2.5 / rays[..., 0]
    y, z = rays[..., 1] * near, rays[..., 2] * near
    hit = panel & (np.abs(y - 0.2) < 0.31) & (np.abs(z + 0.1) < 0.27)
    ranges = np.where(hit, near, wall) + np.random.default_rng(0).normal(0, 0.001, hit.shape)
    return Scan(GEOMETRY, ranges, np.ones(hit.shape))


def open_edges(mesh) -> np.ndarray:
    """The vertices (N, 2) of edges with one triangle; there must be none with more than two."""
    f = mesh.faces
    edges = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
    found, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() <= 2
    return found[count == 1]


def test_a_wall_has_far_fewer_triangles_no_cracks_and_is_within_the_tolerance():
    scan = wall_with_a_panel(panel=False)
    found = reduced_mesh(scan, tolerance_m=0.006)
    assert found.tolerance_m == 0.006
    mesh = found.mesh
    assert len(mesh.faces) < 0.1 * len(scan_mesh(scan).faces)
    rows, columns = mesh.cells[open_edges(mesh).ravel()].T
    assert ((rows == 0) | (rows == 169) | (columns == 0) | (columns == 229)).all()
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    inner = np.s_[1:-1, 1:-1]
    rays = scan.rays[inner].reshape(-1, 3)
    points, index, _ = solid.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    assert len(index) > 0.999 * len(rays)
    off = np.abs(np.linalg.norm(points, axis=1) - scan.ranges[inner].reshape(-1)[index])
    assert off.max() < 0.006 + 0.0015
    assert off.max() > 0.002


def test_depth_edges_stay_open_and_triangles_face_the_scanner():
    scan = wall_with_a_panel()
    mesh = reduced_mesh(scan).mesh
    depth = np.abs(np.diff(np.linalg.norm(mesh.vertices, axis=1)[mesh.faces], axis=1)).max()
    assert depth < 0.5
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    assert ((np.cross(b - a, c - a) * a).sum(axis=1) < 0).mean() > 0.999
    full = scan_mesh(scan)
    area = [np.linalg.norm(np.cross(*(m.vertices[m.faces[:, k]] - m.vertices[m.faces[:, 0]] for k in (1, 2))), axis=1)
            for m in (mesh, full)]  # fmt: skip
    assert area[0].sum() / 2 == pytest.approx(area[1].sum() / 2, rel=0.03)


def test_the_limit_is_kept_by_a_larger_tolerance_or_a_thinner_grid():
    scan = wall_with_a_panel()
    fine, coarse = reduced_mesh(scan), reduced_mesh(scan, most_faces=2500)
    assert len(coarse.mesh.faces) <= 2500 < len(fine.mesh.faces)
    assert coarse.mesh.shape == scan.shape
    rough = Scan(GEOMETRY, np.random.default_rng(0).uniform(3, 3.2, GEOMETRY.shape), np.ones(GEOMETRY.shape))
    assert len(reduced_mesh(rough, most_faces=2000).mesh.faces) <= 2000
    with pytest.raises(OptionError):
        reduced_mesh(scan, most_faces=10)


def test_edges_in_bands_are_those_of_the_whole(monkeypatch):
    whole = grid_edges(wall_with_a_panel())
    monkeypatch.setattr(mesh_module, "_LARGEST_WHOLE_SCAN", 9000)
    banded = grid_edges(wall_with_a_panel())
    assert np.mean(banded.right != whole.right) < 1e-3
    assert np.mean(banded.down != whole.down) < 1e-3
    assert banded.noise_m == pytest.approx(whole.noise_m, rel=0.2)
    assert not whole.right.all()
