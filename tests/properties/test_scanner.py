"""Laws of the scanner geometries: every ray meets its own cell, and the thesis's own formulas hold."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ladarreg_core.errors import LadarregError, OptionError, ShapeError
from ladarreg_core.frames import rotation_from_rotvec
from ladarreg_core.scanner.grids import (
    AzimuthElevation,
    PinholeGrid,
    ScanGeometry,
    SphericalGrid,
    TabulatedGrid,
    range_from_counts,
)
from ladarreg_core.scanner.ray_table import interpolate_rays
from tests.properties.test_camera import CAMERAS, DEPTH

STEP = np.deg2rad(0.055)
GEOMETRIES: dict[str, ScanGeometry] = {
    "azimuth-elevation": AzimuthElevation(70, 100, 0.01, 0.008),
    "offset": AzimuthElevation(71, 100, 0.01, 0.008, 0.05, -0.03),
    "pinhole": PinholeGrid(CAMERAS["ideal"].scaled(0.1)),
    "pinhole with a lens": PinholeGrid(DEPTH.scaled(0.1)),
    "spherical": SphericalGrid(
        60, 90, d_longitude_rad=0.01, d_latitude_rad=0.012, centre_longitude_rad=0.7, top_latitude_rad=0.4
    ),
    "all around": SphericalGrid(40, 180, 2 * np.pi / 180, 0.012, 1.0, 0.3),
}
geometries = pytest.mark.parametrize("geometry", GEOMETRIES.values(), ids=GEOMETRIES)


def cells(shape: tuple[int, int]) -> st.SearchStrategy[np.ndarray]:
    """Fractional cells (6, 2) between the outermost cell centres."""
    return hnp.arrays(np.float64, (6, 2), elements=st.floats(0, 1)).map(lambda unit: unit * (np.array(shape) - 1))


@geometries
def test_every_ray_meets_its_own_cell(geometry: ScanGeometry) -> None:
    rows, columns = geometry.shape
    grid = np.stack(np.mgrid[:rows, :columns], axis=-1).astype(np.float64)
    rays = geometry.rays
    assert rays.shape == (rows, columns, 3)
    assert not rays.flags.writeable
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-14)
    np.testing.assert_allclose(geometry.ray_at(grid), rays, atol=1e-12)
    np.testing.assert_allclose(geometry.cell_of(rays * 7.5), grid, atol=1e-6)


@geometries
@given(data=st.data())
def test_a_fractional_cell_goes_out_and_comes_back(geometry: ScanGeometry, data: st.DataObject) -> None:
    c = data.draw(cells(geometry.shape))
    np.testing.assert_allclose(geometry.cell_of(geometry.ray_at(c)), c, atol=1e-6)


@geometries
def test_row_0_is_the_top_and_column_0_the_left(geometry: ScanGeometry) -> None:
    rows, columns = geometry.shape
    rays = geometry.rays
    assert rays[0, columns // 2, 2] > rays[-1, columns // 2, 2]
    middle = rays[rows // 2]
    turn = np.unwrap(np.arctan2(middle[:, 1], middle[:, 0]))
    assert (np.diff(turn) < 0).all()


@geometries
def test_step_is_the_angle_between_neighbours(geometry: ScanGeometry) -> None:
    rows, columns = geometry.shape
    r, c = rows // 2, columns // 2
    ray = geometry.rays[r, c]
    for step, other in zip(geometry.step_rad, (geometry.rays[r + 1, c], geometry.rays[r, c + 1]), strict=True):
        assert 0.5 * step < math.acos(float(ray @ other)) < 1.1 * step


@given(st.integers(0, 699), st.integers(0, 999), st.floats(0.5, 9))
def test_azimuth_elevation_is_equation_2_1(row: int, column: int, range_m: float) -> None:
    geometry = AzimuthElevation(700, 1000, STEP, STEP)
    azimuth, elevation = (999 / 2 - column) * STEP, (699 / 2 - row) * STEP
    expected = [
        math.cos(azimuth) * math.cos(elevation),
        math.sin(azimuth),
        math.cos(azimuth) * math.sin(elevation),
    ]
    np.testing.assert_allclose(geometry.ray_at([row, column]), expected, atol=1e-15)
    point = np.array(expected) * range_m
    back = geometry.cell_of(point)
    assert back == pytest.approx([row, column], abs=1e-8)


@given(st.floats(-0.45, 0.45), st.floats(-0.35, 0.35), st.floats(100, 3000))
def test_the_perspective_view_is_equations_2_4_and_2_5(azimuth: float, elevation: float, focal: float) -> None:
    """u = cx - f tan(az)/cos(el), v = cy - f tan(el), and back by el = atan(v/f), az = atan(u / hypot(v, f))."""
    geometry = AzimuthElevation(3, 3, STEP, STEP)
    cell = [1 - elevation / STEP, 1 - azimuth / STEP]
    X, Y, Z = geometry.ray_at(cell)
    u, v = -focal * Y / X, -focal * Z / X
    assert u == pytest.approx(-focal * math.tan(azimuth) / math.cos(elevation), abs=1e-9)
    assert v == pytest.approx(-focal * math.tan(elevation), abs=1e-9)
    assert math.atan(-v / focal) == pytest.approx(elevation, abs=1e-12)
    assert math.atan(-u / math.hypot(v, focal)) == pytest.approx(azimuth, abs=1e-12)


def test_the_thesis_own_form_is_half_a_step_off() -> None:
    """The thesis writes W/2 - j where the axis lies between two columns of an even grid."""
    own = AzimuthElevation(4, 6, 0.01, 0.01, 0.005, 0.005)
    np.testing.assert_allclose(own.ray_at([2, 3]), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(AzimuthElevation(4, 6, 0.01, 0.01).ray_at([1.5, 2.5]), [1, 0, 0], atol=1e-15)


def test_tilt_adds_to_elevation_and_pan_does_not_add_to_azimuth() -> None:
    """Turning the scanner up about Y shifts rows; the error of adding pan to azimuth is 4.6 deg at (30, 20, 10)."""
    geometry = AzimuthElevation(101, 101, np.deg2rad(0.5), np.deg2rad(0.5))
    tilted = geometry.ray_at([50, 40]) @ rotation_from_rotvec([0, -np.deg2rad(5), 0]).T
    np.testing.assert_allclose(geometry.cell_of(tilted), [40, 40], atol=1e-9)

    ray = geometry.ray_at([10, 30])  # elevation 20, azimuth 10
    panned = rotation_from_rotvec([0, 0, np.deg2rad(30)]) @ ray
    added = geometry.ray_at([10, -30])  # azimuth 10 + 30
    assert math.degrees(math.acos(float(panned @ added))) == pytest.approx(4.6, abs=0.05)


def test_directions_behind_and_nowhere() -> None:
    behind = np.array([[-1.0, 0, 0], [0, 0, 0], [np.nan, 1, 0]])
    assert np.isnan(PinholeGrid(CAMERAS["ideal"]).cell_of(behind)).all()
    for geometry in GEOMETRIES.values():
        rows, columns = geometry.shape
        r, c = np.moveaxis(geometry.cell_of(behind[[0, 2]]), -1, 0)
        inside = (r > -0.5) & (r < rows - 0.5) & (c > -0.5) & (c < columns - 0.5)
        assert not inside.any() or geometry is GEOMETRIES["all around"]


# --- tabulated grids -------------------------------------------------------------------------------------------------


def leaning(rows: int, columns: int, *, lean: float = 0.006, turn: float = 0.0, span: float = 1.2) -> np.ndarray:
    """A scanner whose columns lean, in closed form: longitude depends a little on the row."""
    r, c = np.mgrid[:rows, :columns] / np.maximum([[[rows - 1]], [[columns - 1]]], 1)
    longitude = turn - span * (c - 0.5) + lean * (r - 0.5)
    latitude = 0.5 - 1.0 * r + 0.002 * np.sin(3 * c)
    return np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=-1
    )


@pytest.mark.slow
@pytest.mark.parametrize("turn", [0.0, 2.0, np.pi, -np.pi / 2], ids=["ahead", "left", "behind", "right"])
@given(data=st.data())
def test_a_table_without_holes_is_its_own_law(turn: float, data: st.DataObject) -> None:
    truth = leaning(80, 60, turn=turn)
    geometry = TabulatedGrid(truth * 3.0)
    np.testing.assert_allclose(geometry.rays, truth, atol=1e-14)
    c = data.draw(cells(geometry.shape))
    np.testing.assert_allclose(geometry.cell_of(geometry.ray_at(c)), c, atol=1e-5)


@pytest.mark.parametrize("turn", [0.0, np.pi])
@settings(max_examples=12)
@given(seed=st.integers(0, 10_000), share=st.floats(0.05, 0.7))
def test_holes_are_filled_within_a_tenth_of_a_cell(turn: float, seed: int, share: float) -> None:
    truth = leaning(80, 60, turn=turn)
    rng = np.random.default_rng(seed)
    table = truth.copy()
    table[rng.random((80, 60)) < share] = np.nan
    top, left = rng.integers(5, 40, 2)
    table[top : top + 20, left : left + 12] = 0  # a block without returns, written as zeros
    rays = TabulatedGrid(table).rays
    known = np.isfinite(table).all(-1) & (np.abs(table).sum(-1) > 0)
    np.testing.assert_allclose(rays[known], truth[known], atol=1e-14)
    step = 1.0 / 79
    assert np.linalg.norm(rays - truth, axis=-1).max() < 0.1 * step


def test_a_turn_of_360_degrees_has_no_seam() -> None:
    """A spinning scanner's table jumps from -pi to pi inside the grid; holes there are filled all the same."""
    truth = leaning(40, 360, turn=1.0, span=2 * np.pi * 359 / 360, lean=0.0)
    table = truth.copy()
    table[10:20, ::3] = np.nan
    geometry = TabulatedGrid(table)
    assert np.linalg.norm(geometry.rays - truth, axis=-1).max() < 0.1 * 2 * np.pi / 360
    grid = np.stack(np.mgrid[:40, :360], axis=-1)
    np.testing.assert_allclose(geometry.cell_of(truth), grid, atol=0.1)


def test_directions_outside_a_table_meet_no_cell_of_it() -> None:
    geometry = TabulatedGrid(leaning(40, 30))
    rng = np.random.default_rng(1)
    d = rng.normal(size=(2000, 3))
    r, c = np.moveaxis(geometry.cell_of(d), -1, 0)
    longitude, latitude = np.arctan2(d[:, 1], d[:, 0]), np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1]))
    far = (np.abs(longitude) > 0.6 + 0.1) | (np.abs(latitude) > 0.5 + 0.1)
    inside = (r >= -0.5) & (r <= 39.5) & (c >= -0.5) & (c <= 29.5)
    assert not (far & inside).any()
    assert inside[(np.abs(longitude) < 0.55) & (np.abs(latitude) < 0.45)].all()
    assert np.isnan(geometry.cell_of([[np.nan, 0, 1], [0, 0, 0], [np.inf, 0, 0]])).all()
    assert np.isnan(geometry.ray_at([[-2.0, 3], [3, 31], [np.nan, 1]])).all()


def test_a_jittering_table_still_knows_its_cells() -> None:
    rng = np.random.default_rng(3)
    truth = leaning(60, 50)
    table = truth + rng.normal(0, 0.15 / 60, truth.shape)  # neighbours nearly change places
    geometry = TabulatedGrid(table)
    found = geometry.cell_of(geometry.rays)
    error = np.linalg.norm(found - np.stack(np.mgrid[:60, :50], axis=-1), axis=-1)
    assert np.isfinite(found).mean() > 0.97
    assert np.nanpercentile(error, 97) < 1.5


def test_a_table_follows_its_law_where_one_is_given() -> None:
    law = SphericalGrid(20, 30, 0.02, 0.02, 0.0, 0.2)
    table = np.full((20, 30, 3), np.nan)
    table[4, 5] = law.rays[4, 5] + [0, 0, 1e-3]
    geometry = TabulatedGrid(table, law=law)
    assert geometry.rays[4, 5, 2] > law.rays[4, 5, 2]
    np.testing.assert_array_equal(geometry.rays[10, 10], law.rays[10, 10])
    np.testing.assert_array_equal(geometry.cell_of(law.rays[10, 10]), law.cell_of(law.rays[10, 10]))
    assert geometry.step_rad == law.step_rad


@given(hnp.arrays(np.float64, (5, 2), elements=st.floats(-0.5, 9.5)))
def test_interpolation_is_exact_for_a_bilinear_table(c: np.ndarray) -> None:
    row, column = np.mgrid[:10, :10].astype(np.float64)
    table = np.stack([1 + row, 2 - column, 0.5 * row * column], axis=-1)
    r, k = c.T
    np.testing.assert_allclose(interpolate_rays(table, c), np.stack([1 + r, 2 - k, 0.5 * r * k], axis=-1), atol=1e-12)


# --- counts, and what is refused -------------------------------------------------------------------------------------


@given(hnp.arrays(np.uint16, (4, 5), elements=st.integers(0, 4095)), st.floats(-2, 2), st.floats(1e-4, 0.1))
def test_counts_to_range(counts: np.ndarray, r0_m: float, dr_m: float) -> None:
    ranges = range_from_counts(counts, r0_m, dr_m)
    assert np.array_equal(np.isnan(ranges), counts == 0)
    seen = counts > 0
    np.testing.assert_allclose(ranges[seen], [r0_m + int(n) * dr_m for n in counts[seen]], rtol=1e-14)


@pytest.mark.parametrize(
    "change",
    [
        {"d_azimuth_rad": 0.0},
        {"d_azimuth_rad": -0.01},
        {"d_elevation_rad": np.nan},
        {"d_azimuth_rad": 0.055},  # degrees taken for radians: reaches beyond 90 deg
        {"azimuth_offset_rad": np.inf},
        {"azimuth_offset_rad": 2.0},
        {"d_elevation_rad": 0.01, "rows": 700},  # elevation beyond straight up
        {"rows": 0},
        {"columns": -5},
    ],
)
def test_an_impossible_scanner_is_refused(change: dict[str, float]) -> None:
    good = {"rows": 70, "columns": 100, "d_azimuth_rad": 0.01, "d_elevation_rad": 0.01}
    AzimuthElevation(**good)  # type: ignore[arg-type]
    with pytest.raises((OptionError, ShapeError)) as caught:
        AzimuthElevation(**{**good, **change})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "table",
    [
        np.full((6, 6, 3), np.nan),
        np.zeros((6, 6, 3)),
        np.zeros((6, 3)),
        np.zeros((6, 6, 2)),
        np.zeros((0, 0, 3)),
        np.full((6, 6, 3), np.inf),
        "rays",
    ],
)
def test_a_table_without_rays_is_refused(table: object) -> None:
    with pytest.raises(LadarregError) as caught:
        TabulatedGrid(table)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
