"""The surface of a scan of the full turn goes on across its seam, with its texture; that of no other scan does."""

import numpy as np
import pytest

from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid, TabulatedGrid
from ladarreg_core.surface.mesh.grid_mesh import Mesh, scan_mesh
from ladarreg_core.surface.mesh.reduced_mesh import reduced_mesh
from ladarreg_core.surface.texture.photo_model import photo_model

COLUMNS = 240
STEP = 2 * np.pi / COLUMNS
AROUND = SphericalGrid(60, COLUMNS, STEP, STEP, 0.0, 30 * STEP)


def scan_on(grid: SphericalGrid | TabulatedGrid) -> Scan:
    ranges = 3 + 0.4 * grid.rays[..., 0] + 0.3 * grid.rays[..., 1] ** 2
    return Scan(grid, ranges.astype(np.float32), np.ones(ranges.shape, np.float32))


def open_columns(mesh: Mesh) -> set[int]:
    """The columns of edges with one triangle, but for those in the first and the last row."""
    edges = np.sort(np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1)
    # The vertices beyond the seam are those of the first column once more.
    row, column = mesh.places
    same = np.unique(row * mesh.shape[1] + column, return_inverse=True)[1]
    found, count = np.unique(np.sort(same[edges], axis=1), axis=0, return_counts=True)
    assert count.max() <= 2
    place = np.zeros(len(same), int)
    place[same] = np.arange(len(same))
    ends = place[found[count == 1]]
    border = np.isin(row[ends], (row.min(), row.max())).all(axis=1)
    return {int(k) for k in column[ends[~border]].ravel()}


@pytest.mark.parametrize("step", [1, 3, 7])
def test_the_surface_of_a_full_turn_is_closed(step: int) -> None:
    scan = scan_on(AROUND)
    assert open_columns(scan_mesh(scan, step=step)) == {0, (COLUMNS - 1) // step * step}
    mesh = scan_mesh(scan, step=step, closed=True)
    assert open_columns(mesh) == set()
    assert mesh.cells[:, 1].max() == COLUMNS
    beyond = mesh.cells[:, 1] == COLUMNS
    np.testing.assert_array_equal(mesh.vertices[beyond], scan.points[mesh.cells[beyond, 0], 0])
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    assert ((np.cross(b - a, c - a) * a).sum(axis=-1) < 0).all()


def test_the_reduced_surface_is_closed_whatever_it_is_thinned_to() -> None:
    scan = scan_on(AROUND)
    for mesh in (reduced_mesh(scan).mesh, reduced_mesh(scan, tolerance_m=1e-6, most_faces=5000).mesh):
        assert open_columns(mesh) == set()
        assert mesh.cells[:, 1].max() == COLUMNS
        assert len(mesh.faces) < 2 * 60 * COLUMNS


@pytest.mark.parametrize("missing", [3, 7, 100])
def test_what_does_not_meet_stays_open(missing: int) -> None:
    part = scan_on(AROUND).window(slice(None), slice(0, COLUMNS - missing))
    mesh, plain = scan_mesh(part, closed=True), scan_mesh(part)
    if missing == 3:  # a gap of a few steps is closed within the grid, too
        assert open_columns(mesh) == set()
        return
    for name in ("vertices", "faces", "cells"):
        np.testing.assert_array_equal(getattr(mesh, name), getattr(plain, name))


def test_a_scanner_that_turned_too_far_is_not_joined_to_what_it_repeats() -> None:
    rays = AROUND.rays
    again = scan_on(TabulatedGrid(np.concatenate([rays, rays[:, :4]], axis=1)))
    assert len(scan_mesh(again, closed=True).faces) == len(scan_mesh(again).faces)


def test_a_depth_edge_at_the_seam_stays_open() -> None:
    ranges = scan_on(AROUND).ranges.copy()
    ranges[20:40, 0] = 0.7
    scan = Scan(AROUND, ranges, np.ones(ranges.shape, np.float32))
    mesh = scan_mesh(scan, closed=True)
    lengths = np.linalg.norm(np.diff(mesh.vertices[mesh.faces], axis=1), axis=-1)
    assert lengths.max() < 0.5


def test_the_textures_of_a_closed_surface_do_not_run_backwards() -> None:
    model = photo_model(scan_on(AROUND), [])
    assert sum(len(part.faces) for part in model.parts) == model.faces
    wide = max(float(np.ptp(part.pixels[part.faces][..., 0], axis=1).max()) for part in model.parts)
    assert wide <= 32  # the largest block of cells that is drawn as a whole
    assert max(float(part.pixels[:, 0].max()) for part in model.parts) == COLUMNS
