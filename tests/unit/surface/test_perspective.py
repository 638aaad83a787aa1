"""The perspective view: exact maps, straight lines, and ranges that are never invented."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, PinholeGrid, SphericalGrid, TabulatedGrid
from ladarreg_core.surface.perspective import native_focal_px, perspective_view

STEP = np.deg2rad(0.2)
GRIDS = {
    "azimuth-elevation": AzimuthElevation(150, 220, STEP, STEP),
    "pinhole": PinholeGrid(Camera(220, 150, 280.0, 285.0, 108.0, 76.0, (0.1, -0.05, 0.001, -0.001))),
    "spherical": SphericalGrid(150, 220, STEP, STEP, 0.3, 0.3),
}


def linear_in_grid(geometry, seed: int = 0) -> Scan:
    """A scan whose intensity is a linear function of the cell, so that bilinear interpolation is exact."""
    row, column = np.mgrid[: geometry.shape[0], : geometry.shape[1]].astype(float)
    return Scan(geometry, np.full(geometry.shape, 3.0), 1 + 0.01 * row + 0.02 * column)


@pytest.mark.parametrize("name", GRIDS)
def test_every_pixel_shows_the_cell_that_its_ray_meets(name: str) -> None:
    geometry = GRIDS[name]
    scan = linear_in_grid(geometry)
    view = perspective_view(scan, Camera.from_focal(240, 180, 300.0))
    v, u = np.mgrid[:180, :240]
    cell = geometry.cell_of(view.rays_at(np.stack([u, v], axis=-1)))
    expected = 1 + 0.01 * cell[..., 0] + 0.02 * cell[..., 1]
    # OpenCV rounds its coordinates to 1/32 px.
    tolerance = 0.03 * 1.2 / 32 + 0.03 * 0.012
    inside = view.inside & (cell.min(axis=-1) > 1)
    assert inside.mean() > 0.5
    np.testing.assert_allclose(view.intensity[inside], expected[inside], atol=tolerance + 1e-5)


def test_a_tabulated_grid_gives_the_view_of_its_law() -> None:
    law = GRIDS["azimuth-elevation"]
    camera = Camera.from_focal(300, 260, 300.0)  # looks past the grid on all sides
    exact = perspective_view(linear_in_grid(law), camera)
    tabulated = perspective_view(linear_in_grid(TabulatedGrid(law.rays)), camera)
    assert (exact.inside == tabulated.inside).mean() > 0.999
    both = exact.inside & tabulated.inside
    np.testing.assert_allclose(exact.cells[both], tabulated.cells[both], atol=0.02)


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-0.3, 0.3)] * 3))
def test_rays_and_pixels_are_inverse_in_any_direction(turn: tuple[float, float, float]) -> None:
    scan = linear_in_grid(GRIDS["azimuth-elevation"])
    base = perspective_view(scan, Camera.from_focal(64, 48, 300.0)).view_from_scanner
    direction = Rigid(rotation_from_rotvec(turn) @ base.rotation, np.zeros(3))
    view = perspective_view(scan, Camera.from_focal(64, 48, 300.0), view_from_scanner=direction)
    uv = np.array([[0.0, 0.0], [63.0, 47.0], [10.3, 20.7]])
    np.testing.assert_allclose(view.project(view.rays_at(uv)), uv, atol=1e-9)


def test_the_seam_of_a_full_turn_does_not_smear() -> None:
    geometry = SphericalGrid(120, 360, np.deg2rad(1.0), np.deg2rad(0.5), 0.0, 0.5)
    intensity = np.tile(10 + np.cos(np.deg2rad(np.arange(360.0))), (120, 1))
    scan = Scan(geometry, np.full(geometry.shape, 3.0), intensity)
    behind = Rigid(np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]), np.zeros(3))
    view = perspective_view(scan, Camera.from_focal(200, 60, 200.0), view_from_scanner=behind)
    v, u = np.mgrid[:60, :200]
    column_at = geometry.cell_of(view.rays_at(np.stack([u, v], axis=-1)))[..., 1]
    error = np.abs(view.intensity - (10 + np.cos(np.deg2rad(column_at))))
    assert error[view.inside].max() < 0.01


def test_ranges_between_a_foreground_and_its_background_are_not_invented() -> None:
    geometry = AzimuthElevation(80, 120, STEP, STEP)
    ranges = np.full(geometry.shape, 4.0)
    ranges[20:60, 40:80] = 2.0
    ranges[30:40, 90:100] = np.nan
    scan = Scan(geometry, ranges, np.ones(geometry.shape))
    view = perspective_view(scan, Camera.from_focal(150, 100, 330.0))
    shown = view.ranges[view.inside]
    measured = shown[np.isfinite(shown)]
    assert set(np.unique(measured)) == {2.0, 4.0}
    assert np.isnan(shown).sum() > 50


def test_inside_a_slanted_surface_ranges_are_interpolated() -> None:
    geometry = AzimuthElevation(80, 120, STEP, STEP)
    wall = np.array([0.9, 0.3, 0.1])  # points with wall . p = 3
    scan = Scan(geometry, 3 / (geometry.rays @ wall), np.ones(geometry.shape))
    view = perspective_view(scan, Camera.from_focal(150, 100, 400.0))
    v, u = np.mgrid[:100, :150]
    expected = 3 / (view.rays_at(np.stack([u, v], axis=-1)) @ wall)
    inside = view.inside
    np.testing.assert_allclose(view.ranges[inside], expected[inside], rtol=2e-4)


def test_the_whole_scan_fits_up_to_120_degrees() -> None:
    scan = linear_in_grid(GRIDS["azimuth-elevation"])
    small = Camera.from_focal(40, 30, 300.0)
    whole = perspective_view(scan, small, whole_scan=True)
    corners = whole.project(scan.rays[::149, ::219].reshape(-1, 3))
    assert whole.camera.contains(corners, border=-1).all()
    full_turn = SphericalGrid(40, 360, np.deg2rad(1), np.deg2rad(1), 0.0, 0.35)
    around = Scan(full_turn, np.ones((40, 360)), np.ones((40, 360)))
    width = perspective_view(around, small, whole_scan=True).camera.width
    assert width <= 2 * 300 * np.tan(np.deg2rad(60)) + 3


def test_a_view_from_elsewhere_is_refused() -> None:
    scan = linear_in_grid(GRIDS["azimuth-elevation"])
    with pytest.raises(OptionError, match="pure rotation"):
        perspective_view(scan, view_from_scanner=Rigid(np.eye(3), np.array([0.1, 0, 0])))


def sliver(rows: int, columns: int, row_step: float, column_step: float) -> Scan:
    return linear_in_grid(AzimuthElevation(rows, columns, column_step, row_step))


def test_a_view_of_a_grid_with_unlike_steps_is_coarser_than_its_finest_cells() -> None:
    scan = sliver(1000, 60, 2e-4, 0.008)
    view = perspective_view(scan)
    width, height = view.camera.size
    assert 0.9 * 16 * 60 * 1000 <= width * height <= 16 * 60 * 1000
    assert view.camera.contains(view.project(scan.rays[[0, 0, -1, -1], [0, -1, 0, -1]]), border=-1).all()
    assert view.camera.fx < native_focal_px(scan)
    fewer = perspective_view(scan, most_pixels=5000)
    assert fewer.camera.width * fewer.camera.height <= 5000


def test_a_view_of_a_long_strip_is_not_longer_than_pictures_can_be() -> None:
    scan = sliver(24, 45_000, 2e-5, 2e-5)
    assert native_focal_px(scan) * 45_000 * 2e-5 > 40_000
    assert max(perspective_view(scan).camera.size) <= 32_000


def test_what_no_picture_shows_is_refused() -> None:
    with pytest.raises(DegenerateGeometryError, match=r"24 rows span 0\.0138 deg"):
        perspective_view(sliver(24, 36, 1e-5, 0.01))
    for least in (1e-9, 1e-100, 5e-324):
        with pytest.raises(DegenerateGeometryError, match="no single image"):
            perspective_view(sliver(24, 36, least, 0.01))
    for size in ((40_000, 2), (20_000, 20_000)):
        with pytest.raises(OptionError, match="32,000 a side"):
            perspective_view(sliver(24, 36, 0.01, 0.01), Camera.from_focal(*size, 300.0))
