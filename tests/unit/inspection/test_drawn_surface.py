"""A coarse scan is drawn as the surface on which a pick would lie."""

from __future__ import annotations

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.inspection.drawn_surface import drawn_surface
from ladarreg_core.inspection.pictures import display_note, inspection_views, scan_picture, usual_show
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.perspective import View

_SENSOR_M, _WALL_M = 1.7, 40.0


def street(*, rows: int = 40, step_rad: float = 0.008, share: float = 1.0, lit: bool = True) -> Scan:
    """Level ground 1.7 m below the sensor that ends at a wall 40 m ahead, of which a share of the cells returned."""
    geometry = AzimuthElevation(rows, 120, 0.004, step_rad, elevation_offset_rad=-0.02)
    rays = np.asarray(geometry.rays, np.float64)
    with np.errstate(divide="ignore"):
        ground = np.where(rays[..., 2] < 0, _SENSOR_M / -rays[..., 2], np.inf)
    ranges = np.minimum(ground, _WALL_M / rays[..., 0])
    rng = np.random.default_rng(5)
    ranges[rng.random(ranges.shape) > share] = np.nan
    intensity = 100 + 20 * rng.random(ranges.shape) if lit else np.zeros(ranges.shape)
    return Scan(geometry, ranges, intensity)


def the_view(scan: Scan) -> View:
    return inspection_views(scan)[0].view


def off_by(view: View, ranges: FloatArray) -> FloatArray:
    """Return the relative errors of ranges on the ground, well inside the scan."""
    v, u = np.mgrid[: view.camera.height, : view.camera.width]
    rays = view.rays_at(np.stack([u, v], axis=-1).astype(np.float64))
    with np.errstate(divide="ignore"):
        true = _SENSOR_M / -rays[..., 2]
    column, row = view.cells[..., 0], view.cells[..., 1]
    height, width = view.scan.shape
    ground = (rays[..., 2] < 0) & (true < 0.7 * _WALL_M)
    ground &= (column > 4) & (column < width - 6) & (row > 2) & (row < height - 4)
    return np.abs(ranges[ground] / true[ground] - 1)


def test_ground_between_lines_is_drawn_as_a_plane_and_not_in_steps() -> None:
    view = the_view(street())
    assert np.nanmax(off_by(view, view.ranges)) > 0.02, "the nearest cells make steps"
    ranges, _ = drawn_surface(view)
    assert np.max(off_by(view, ranges)) < 0.002


def test_cells_without_a_return_between_those_of_one_surface_are_drawn_with_its_range_and_intensity() -> None:
    view = the_view(street(share=0.6))
    ranges, intensity = drawn_surface(view)
    empty = ~np.isfinite(off_by(view, view.ranges))
    assert empty.mean() > 0.2
    found = off_by(view, ranges)
    assert np.isfinite(found[empty]).mean() > 0.95
    assert np.nanmax(found) < 0.02
    before = ~np.isfinite(view.ranges) & np.isfinite(ranges)
    assert intensity[before].min() >= 100, "that of the returns around, not darkened by cells without one"


def test_no_surface_is_drawn_between_the_foreground_and_what_lies_behind() -> None:
    scan = street()
    ranges = np.array(scan.ranges)
    ranges[5:25, 50:70] = 6.0  # a box in front of ground and wall
    view = the_view(Scan(scan.geometry, ranges, scan.intensity))
    drawn, _ = drawn_surface(view)
    column, row = view.cells[..., 0], view.cells[..., 1]
    beside = (row > 6) & (row < 14) & (column > 45) & (column < 75) & np.isfinite(drawn)
    assert ((drawn[beside] < 6.1) | (drawn[beside] > 15)).all()


def test_a_dense_scan_is_drawn_as_it_was_measured() -> None:
    view = the_view(street(step_rad=0.0015))
    dense = Scan(AzimuthElevation(40, 120, 0.0015, 0.0015), view.scan.ranges, view.scan.intensity)
    view = the_view(dense)
    ranges, intensity = drawn_surface(view)
    assert ranges is view.ranges
    assert intensity is view.intensity


def test_a_scan_without_intensity_is_shown_by_its_shape_and_says_so() -> None:
    dark, lit = street(lit=False), street()
    assert (usual_show(dark), usual_show(lit)) == ("shape", "intensity")
    assert display_note(lit) is None
    assert "no intensity" in (display_note(dark) or "")
    gray = scan_picture(the_view(dark), "shape")[..., 0].astype(int)
    view = the_view(dark)
    column, row = view.cells[..., 0], view.cells[..., 1]
    inner = (column > 10) & (column < 110)
    wall, ground = np.median(gray[inner & (row > 4) & (row < 12)]), np.median(gray[inner & (row > 28) & (row < 36)])
    assert abs(wall - ground) > 30, "wall and ground differ"
    assert np.unique(scan_picture(view, "raw")).size < 5, "of its intensity there is nothing to see"
