import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.errors import OptionError
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, SphericalGrid, TabulatedGrid
from ladarreg_core.surface.mesh.grid_mesh import grid_edges, scan_mesh, whole_blocks
from ladarreg_core.surface.mesh.normals import cell_normals
from ladarreg_core.surface.visibility.occluding_surface import occluding_surface


def plane_ranges(rays, normal, distance):
    along = rays @ np.asarray(normal, dtype=float)
    with np.errstate(divide="ignore"):
        r = distance / along
    return np.where((along > 0) & (r < 60), r, np.nan)


def scan_of(geometry, ranges, *, noise_m=0.0, seed=0):
    noisy = ranges + np.random.default_rng(seed).normal(size=ranges.shape) * noise_m
    return Scan(geometry, noisy, np.ones(geometry.shape))


def full_face_count(valid):
    """Two triangles a quad, one where a corner is missing."""
    corners = valid[:-1, :-1].astype(int) + valid[:-1, 1:] + valid[1:, :-1] + valid[1:, 1:]
    return 2 * np.count_nonzero(corners == 4) + np.count_nonzero(corners == 3)


@given(
    pan=st.floats(-1.2, 1.2),
    tilt=st.floats(-1.45, 1.45),
    step=st.sampled_from([0.0005, 0.002, 0.008]),
    noise_m=st.sampled_from([0.0, 0.002, 0.01]),
    seed=st.integers(0, 99),
)
def test_a_plane_is_never_torn_however_grazing(pan, tilt, step, noise_m, seed):
    geometry = AzimuthElevation(40, 50, step, step)
    normal = np.array([np.cos(pan) * np.cos(tilt), np.sin(pan) * np.cos(tilt), np.sin(tilt)])
    ranges = plane_ranges(geometry.rays, normal, 1.5)
    if np.count_nonzero(ranges < 30) < 100:
        return
    ranges = np.where(ranges < 30, ranges, np.nan)
    scan = scan_of(geometry, ranges, noise_m=noise_m, seed=seed)
    # Noise may tear a hair of what it makes unrecognisable; a noise-free plane not at all.
    missing = full_face_count(scan.valid) - len(scan_mesh(scan).faces)
    assert 0 <= missing <= (0.002 * full_face_count(scan.valid) if noise_m else 0)


def test_a_floor_out_to_the_horizon_that_meets_a_wall_is_one_surface():
    geometry = AzimuthElevation(300, 60, 0.001, 0.001, elevation_offset_rad=-0.1)
    rays = geometry.rays
    floor, wall = plane_ranges(rays, (0, 0, -1), 1.6), 25.0 / rays[..., 0]
    scan = scan_of(geometry, np.fmin(floor, wall), noise_m=0.003)
    assert len(scan_mesh(scan).faces) >= 0.998 * full_face_count(scan.valid)


@given(
    gap_m=st.floats(0.05, 5.0),
    step=st.sampled_from([0.001, 0.003]),
    noise_m=st.sampled_from([0.0, 0.003]),
    mixed=st.booleans(),
)
def test_no_triangle_spans_a_depth_edge(gap_m, step, noise_m, mixed):
    """A panel before a wall: every triangle lies on the one or the other, mixed pixels between them or not."""
    geometry = AzimuthElevation(60, 80, step, step)
    rays = geometry.rays
    # What a jump must stand out by; a mixed pixel divides it in two, and a few cm between cells of 9 mm may be a slope.
    gap_m += 20 * noise_m + 0.1 * mixed
    near, far = 3.0 / rays[..., 0], (3.0 + gap_m) / rays[..., 0]
    ranges = far.copy()
    ranges[20:40, 25:55] = near[20:40, 25:55]
    if mixed:
        ranges[20:40, 24] = (near + 0.6 * (far - near))[20:40, 24]
    scan = scan_of(geometry, ranges, noise_m=noise_m)
    mesh = scan_mesh(scan)
    x = mesh.vertices[mesh.faces][..., 0]
    spread = x.max(axis=1) - x.min(axis=1)
    assert spread.max() < min(0.5 * gap_m + 3 * noise_m, 14 * noise_m + 0.03)
    torn = full_face_count(scan.valid) - len(mesh.faces)
    assert torn <= 2 * 2 * (20 + 30) + 8 + (2 * 2 * 22 if mixed else 0) + (10 if noise_m else 0)


def test_a_thin_wire_is_cut_off_on_both_sides():
    geometry = AzimuthElevation(50, 50, 0.002, 0.002)
    ranges = 4.0 / geometry.rays[..., 0]
    ranges[:, 25] = 2.0
    edges = grid_edges(scan_of(geometry, ranges))
    assert not edges.right[:, 24:26].any()
    assert edges.right[:, :24].all()
    assert edges.right[:, 26:].all()
    assert edges.down.all()


def test_faces_look_at_the_scanner_whichever_way_the_grid_runs():
    geometry = AzimuthElevation(20, 30, 0.01, 0.01)
    ranges = 2.0 / geometry.rays[..., 0]
    for rows, columns in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        table = (geometry.rays * ranges[..., None])[::rows, ::columns]
        mesh = scan_mesh(Scan(TabulatedGrid(table), ranges[::rows, ::columns], np.ones(geometry.shape)))
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        assert len(mesh.faces) == 2 * 19 * 29
        assert ((np.cross(b - a, c - a) * a).sum(axis=-1) < 0).all()


@given(step=st.integers(1, 7), holes=st.integers(0, 99))
def test_every_vertex_is_its_cells_point_and_every_uv_its_cells_centre(step, holes):
    geometry = AzimuthElevation(37, 53, 0.004, 0.004)
    rng = np.random.default_rng(holes)
    ranges = np.where(rng.random(geometry.shape) < 0.9, 3.0 / geometry.rays[..., 0], np.nan)
    scan = scan_of(geometry, ranges)
    mesh = scan_mesh(scan, step=step)
    row, column = mesh.cells.T
    assert (row % step == 0).all()
    assert (column % step == 0).all()
    np.testing.assert_array_equal(mesh.vertices, scan.points[row, column])
    np.testing.assert_allclose(mesh.uv, np.stack([(column + 0.5) / 53, (row + 0.5) / 37], axis=-1), atol=1e-6)
    assert np.isfinite(mesh.vertices).all()
    if len(mesh.faces):
        assert sorted(np.unique(mesh.faces)) == list(range(len(mesh.vertices)))


@given(most=st.integers(4, 5000))
def test_the_mesh_for_the_screen_keeps_its_limit_and_its_shape(most):
    geometry = AzimuthElevation(90, 30, 0.002, 0.006)  # rows are finer: they go first
    scan = scan_of(geometry, 3.0 / geometry.rays[..., 0])
    mesh = scan_mesh(scan, max_vertices=most)
    assert 4 <= len(mesh.vertices) <= max(most, 4)
    row, column = (np.unique(mesh.cells[:, k]) for k in range(2))
    assert len(mesh.vertices) == len(row) * len(column)
    assert len(mesh.vertices) >= min(most, 2700) / 3.5 or len(mesh.vertices) <= 8


def test_sparse_and_tiny_scans_make_empty_or_tiny_meshes():
    geometry = AzimuthElevation(2, 2, 0.01, 0.01)
    assert len(scan_mesh(scan_of(geometry, np.array([[2.0, np.nan], [np.nan, 2.0]]))).faces) == 0
    assert len(scan_mesh(scan_of(geometry, np.array([[2.0, 2.0], [np.nan, 2.0]]))).faces) == 1
    single = np.full((2, 2), np.nan)
    single[0, 0] = 1e-40  # below what a float32 can invert
    assert len(scan_mesh(scan_of(geometry, single)).faces) == 0


def test_neighbours_in_the_grid_that_are_none_in_space_stay_apart():
    """A full turn cut into a grid whose middle is missing."""
    geometry = SphericalGrid(20, 360, np.deg2rad(1), np.deg2rad(1), 0.0, 0.2)
    rays = np.concatenate([geometry.rays[:, :90], geometry.rays[:, 270:]], axis=1)
    scan = Scan(TabulatedGrid(rays * 3), np.full(rays.shape[:2], 3.0), np.ones(rays.shape[:2]))
    edges = grid_edges(scan)
    assert not edges.right[:, 89].any()
    assert np.delete(edges.right, 89, axis=1).all()


@pytest.mark.parametrize(
    ("options", "word"),
    [({"step": 0}, "step"), ({"step": True}, "step"), ({"step": 1.5}, "step"), ({"max_vertices": 3}, "max_vertices")],
)
def test_bad_options_are_named(options, word):
    geometry = AzimuthElevation(4, 4, 0.01, 0.01)
    with pytest.raises(OptionError, match=word):
        scan_mesh(scan_of(geometry, np.ones((4, 4))), **options)


@given(height=st.integers(0, 9), width=st.integers(0, 9), size=st.integers(1, 4), seed=st.integers(0, 9))
def test_whole_blocks_are_those_in_which_every_flag_holds(height, width, size, seed):
    flags = np.random.default_rng(seed).random((height, width)) < 0.8
    rows, columns = height // size, width // size
    tiles = flags[: rows * size, : columns * size].reshape(rows, size, columns, size)
    np.testing.assert_array_equal(whole_blocks(flags, size), tiles.all(axis=(1, 3)))


def test_normals_are_the_same_whether_or_not_the_occluding_surface_is_known():
    geometry = AzimuthElevation(60, 80, 0.01, 0.01)
    ranges = plane_ranges(geometry.rays, (0.9, 0.3, 0.3), 2.0)
    scan = scan_of(geometry, ranges, noise_m=0.002)
    cells = np.argwhere(scan.valid)[::7]
    alone = cell_normals(scan, cells)
    occluding_surface(scan)
    np.testing.assert_array_equal(cell_normals(scan, cells), alone)
