"""What a scan supports: its resolution, its intensity, its holes, and where it has a shape to compare."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.matching.images.photo_levels import photo_levels, working_camera
from ladarreg_core.matching.images.scan_levels import pair_levels, scan_levels
from ladarreg_core.matching.images.structure import painted_cells, shaped_pixels, structured_cells
from ladarreg_core.matching.images.support import (
    carries_intensity,
    comparison_focal_px,
    is_coarse,
    is_interpolated,
    open_cells,
)
from ladarreg_core.matching.images.views import scan_density
from ladarreg_core.matching.search.grid_search import likely_poses
from ladarreg_core.matching.verify.verification import GateOptions, coarse_gate, shape_alone_gate
from ladarreg_core.registration.self_test.synthetic_photo import random_pose, render_photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid
from ladarreg_core.surface.perspective import perspective_view
from ladarreg_core.surface.uncertainty import pixel_sigma
from testing.scenes.painted_room import painted_room
from testing.scenes.simulated import outdoors
from testing.scenes.thinned_scan import thinned

STEP_RAD = np.radians(0.2)


def scan_of(ranges: np.ndarray, intensity: np.ndarray | None = None) -> Scan:
    rows, columns = ranges.shape
    grid = SphericalGrid(rows, columns, STEP_RAD, STEP_RAD, 0.0, STEP_RAD * (rows - 1) / 2)
    light = np.zeros(ranges.shape, np.float32) if intensity is None else intensity
    return Scan(grid, ranges.astype(np.float32), light.astype(np.float32))


def cone(radius: int = 80, side: int = 201) -> np.ndarray:
    """Return where a lidar looks that fills a cone, (side, side) bool."""
    row, column = np.mgrid[:side, :side] - side // 2
    return np.asarray(np.hypot(row, column) <= radius)


def test_a_scan_is_coarse_beside_a_finer_photo_only() -> None:
    scan = scan_of(np.full((40, 40), 5.0))  # .2 deg a cell: 286 px
    assert is_coarse(scan, Camera.from_focal(960, 640, 649.0))
    assert not is_coarse(scan, Camera.from_focal(480, 320, 320.0))


def test_a_scan_is_interpolated_where_the_photo_would_be_tiny() -> None:
    scan = scan_of(np.full((40, 40), 5.0), np.random.default_rng(0).random((40, 40)))  # 286 px
    tele, usual = Camera.from_focal(1920, 1200, 5000.0), Camera.from_focal(1920, 1200, 2800.0)  # 110 x 69, 196 x 123
    dense = Camera.from_focal(120, 75, 290.0)
    assert [is_interpolated(scan, camera) for camera in (tele, usual, dense)] == [True, False, False]
    native = 1 / STEP_RAD
    focal = [comparison_focal_px(scan, camera) / native for camera in (tele, usual, dense)]
    np.testing.assert_allclose(focal, [2.5, 1, 1], rtol=1e-3)


@pytest.mark.parametrize("levels", [1, 2, 4])
def test_an_intensity_of_few_levels_shows_nothing(levels: int) -> None:
    rng = np.random.default_rng(0)
    ranges, few = np.full((100, 100), 8.0), rng.integers(0, levels, (100, 100))
    assert not carries_intensity(scan_of(ranges, few))
    assert carries_intensity(scan_of(ranges, rng.integers(0, 256, (100, 100))))
    assert carries_intensity(scan_of(ranges, rng.random((100, 100)))), "no level of floats is common, but all differ"


def test_the_sky_is_open_and_what_was_not_looked_at_is_not() -> None:
    """A lidar's cone with buildings to the left and right, the sky between them, and a gap of one cell."""
    looked = cone()
    there = looked.copy()
    there[:110, 80:120] = False
    there[150, 100] = False
    there[150:156, 60:66] = False
    found = open_cells(scan_of(np.where(there, 20.0, np.nan)))
    assert found[40:105, 85:115].all(), "the sky between the buildings"
    assert not found[150:156, 60:66].any(), "a gap of an accumulated cloud's pattern"
    assert not found[~looked].any(), "outside the cone"
    assert not found[150, 100], "no beam came by there"
    assert not found[there].any()


def test_the_first_row_of_a_turning_scanner_is_no_border() -> None:
    there = np.ones((40, 200), np.bool_)
    there[:20, 80:120] = False
    found = open_cells(scan_of(np.where(there, 20.0, np.nan)))
    assert found[:20, 82:118].all()


FOCAL_PX = 300.0


def ground(rows: int = 160, columns: int = 200) -> np.ndarray:
    """Return the ranges (rows, columns) of a view of the ground 1.8 m below, with 2 cm and 1 mrad of noise."""
    v, u = np.mgrid[:rows, :columns]
    ray = np.stack([(u - columns / 2) / FOCAL_PX, (v + 12.0) / FOCAL_PX, np.ones(u.shape)], axis=-1)
    rng = np.random.default_rng(1)
    down = ray[..., 1] / np.linalg.norm(ray, axis=-1) + 0.001 * rng.standard_normal(u.shape)
    return np.asarray(1.8 / np.maximum(down, 0.01) + 0.02 * rng.standard_normal(u.shape))


def shaped(ranges: np.ndarray) -> np.ndarray:
    return shaped_pixels(ranges, focal_px=FOCAL_PX, cell_rad=1 / FOCAL_PX)


def test_the_ground_has_no_shape_and_what_stands_on_it_has() -> None:
    ranges = ground()
    assert shaped(ranges).mean() < 0.05
    assert structured_cells(ranges, np.zeros_like(ranges))[:40].mean() > 0.5, "the logarithm takes its slope for detail"
    ranges[30:70, 60:100] = 6.0
    found = shaped(ranges)
    outline = [found[30:70, 60], found[30:70, 99], found[30, 60:100], found[69, 60:100]]
    assert np.concatenate(outline).mean() > 0.95
    assert found[80:-4, 4:-4].mean() < 0.1


def test_holes_in_the_ground_give_it_no_shape() -> None:
    """An accumulated cloud's pattern leaves gaps; the planes are fitted to what there is."""
    ranges = ground()
    ranges[(np.add.outer(np.arange(160), np.arange(200)) // 3) % 3 == 0] = np.nan
    assert shaped(ranges).mean() < 0.05
    assert not shaped(np.full((40, 40), np.nan)).any()


def test_a_fold_between_two_planes_is_a_shape() -> None:
    x = np.abs(np.arange(200) - 100) / FOCAL_PX  # two walls that meet in front
    depth = 10 / (1 + x)
    ranges = np.repeat((depth * np.sqrt(1 + x**2))[None], 80, axis=0)
    ranges += 0.01 * np.random.default_rng(2).standard_normal(ranges.shape)
    found = shaped(ranges)
    assert found[5:-5, 99:102].mean() > 0.9
    assert found[5:-5, 10:80].mean() < 0.05


def test_painted_ground_shows_its_paint() -> None:
    stripes = np.where(np.arange(160) // 12 % 2, 200.0, 60.0) + np.zeros((120, 160))
    assert painted_cells(stripes).mean() > 0.8
    speckle = np.random.default_rng(3).normal(100, 8, (120, 160))
    assert painted_cells(speckle).mean() < 0.2


def geometry_at(near_m: float, far_m: float) -> float:
    """Return the strength of the geometry channels along the edge between two surfaces."""
    ranges = np.full((160, 240), far_m)
    ranges[:, :120] = near_m
    scan = scan_of(ranges)
    camera = Camera.from_focal(200, 140, 286.0)
    levels = scan_levels(
        scan, perspective_view(scan, camera, view_from_scanner=Rigid(look_along([1, 0, 0]), np.zeros(3)))
    )
    strength = np.linalg.norm(levels.geometry_channels[0], axis=-1)
    return float(strength[40:100, 97:103].mean())


def test_edges_far_away_are_edges() -> None:
    assert geometry_at(40.0, 80.0) > 0.8 * geometry_at(4.0, 8.0)


def test_outlines_against_the_sky_are_edges_of_coarse_scans() -> None:
    there = cone()
    there[:100, 80:120] = False
    scan = scan_of(np.where(there, 20.0, np.nan))
    ahead = Rigid(look_along([1, 0, 0]), np.zeros(3))
    view = perspective_view(scan, Camera.from_focal(160, 120, 286.0), view_from_scanner=ahead)
    coarse, fine = (scan_levels(scan, view, coarse=flag).raw_geometry[0].sum(axis=0) for flag in (True, False))
    near_roof = np.s_[57:64, 66:94]
    assert coarse[near_roof].max() > 10 * fine[near_roof].max()


@pytest.mark.slow
def test_a_view_with_few_returns_has_smaller_blocks() -> None:
    room = painted_room(21)
    working = working_camera(room.scan, room.photo.camera)
    view = perspective_view(room.scan, working)
    whole = pair_levels(room.scan, view, channel_set="both", coarse=False, harmonics=2)
    height, width = room.scan.shape
    part = room.scan.window(slice(height // 4, 3 * height // 4), slice(width // 4, 3 * width // 4))
    few = pair_levels(part, perspective_view(part, working), channel_set="both", coarse=False, harmonics=2)
    assert np.isfinite(whole.ranges).sum() > 120_000 > np.isfinite(few.ranges).sum()
    assert few.block_px < whole.block_px == 48


@pytest.mark.slow
def test_a_scan_narrower_than_the_photo_is_found() -> None:
    """It fills a sixth of the photo: less than the overlap that was once asked for."""
    room = painted_room(22, baseline_m=0.3)
    height, width = room.scan.shape
    scan = room.scan.window(
        slice(round(0.3 * height), round(0.7 * height)), slice(round(0.28 * width), round(0.7 * width))
    )
    working = working_camera(scan, room.photo.camera)
    levels = scan_levels(scan, perspective_view(scan, working))
    shown = np.isfinite(levels.ranges).mean()
    assert 0.05 < shown < 0.25
    found = likely_poses(levels, photo_levels(room.photo, working))
    assert min(room.error_px(place.camera_from_scanner) for place in found) < 40


def test_shape_alone_is_held_to_more_and_never_to_less() -> None:
    assert shape_alone_gate(GateOptions()).fine_fraction > GateOptions().fine_fraction
    assert shape_alone_gate(GateOptions()).fraction > GateOptions().fraction
    strict = replace(GateOptions(), fine_fraction=0.7)
    assert shape_alone_gate(strict).fine_fraction == 0.7


def test_what_to_do_depends_on_how_much_of_the_photo_the_scan_covers() -> None:
    scan = scan_of(np.full((200, 200), 20.0))  # 40 degrees
    ahead = Rigid(look_along([1, 0, 0]), np.zeros(3))
    for focal_px, word in ((900.0, "accumulate longer"), (300.0, "turn the camera")):
        density = scan_density(scan, Camera.from_focal(960, 640, focal_px), [ahead])
        assert density is not None
        assert word in density.advice()
    assert "accumulate" not in density.advice()
    assert density.covered < 0.5


def test_the_self_test_of_a_scan_without_intensity_paints_its_surfaces_and_a_sky() -> None:
    there = np.ones((200, 240), np.bool_)
    there[:60, 40:200] = False
    ranges = np.full(there.shape, 40.0)
    ranges[90:150, 80:120] = 15.0  # something stands before the wall
    scan = scan_of(np.where(there, ranges, np.nan))
    camera = Camera.from_focal(960, 640, 900.0)
    rng = np.random.default_rng(4)
    made = render_photo(scan, camera, random_pose(scan, camera, rng), rng)
    assert np.linalg.norm(made.camera_from_scanner.centre) < 1.5, "beside the scanner, however far the wall is"
    uv = camera.project(made.camera_from_scanner @ scan.points[[120, 120, 170], [100, 60, 100]].astype(float))
    front, wall, below = (made.photo.pixels[round(v), round(u)].astype(float) for u, v in uv)
    assert np.abs(front - wall).max() > 20
    assert np.abs(below - wall).max() < 60
    above = camera.project(made.camera_from_scanner @ (40.0 * scan.geometry.rays[45, 120][None].astype(float)))[0]
    sky = made.photo.pixels[round(above[1]), round(above[0])]
    assert sky.min() > 150
    assert made.covered < 0.9


def test_few_regions_of_a_coarse_scan_are_to_stand_out_more() -> None:
    usual, few = GateOptions(), coarse_gate(GateOptions())
    assert few.few_contrast > usual.few_contrast
    assert replace(few, few_contrast=usual.few_contrast) == usual
    assert coarse_gate(replace(usual, few_contrast=5.0)).few_contrast == 5


@pytest.mark.slow
def test_lines_far_apart_make_a_pose_less_certain_than_its_regions_say() -> None:
    room = painted_room()

    def registered(scan: lr.Scan, gate: GateOptions) -> tuple[lr.Registration, float]:
        options = lr.RegisterOptions(auto=lr.AutoOptions(reach="near_start", gate=gate))
        found = lr.register(scan, room.photo, initial=room.camera_from_scanner, options=options)
        pose, points = found.camera_from_scanner, room.scan.points[room.scan.valid][::97].astype(float)
        sigma = pixel_sigma(pose @ points, found.camera, pose.rotation, found.covariance)
        return found, float(np.nanmedian(sigma))

    lines = thinned(room.scan, 4, columns_too=False)
    few, few_px = registered(lines, GateOptions())
    assert few.accepted
    strict = GateOptions(coarse_sigma_px=0.5 * few_px)
    refused, _ = registered(lines, strict)
    assert not refused.accepted
    assert "the scan is coarse" in refused.reasons[0]
    whole, whole_px = registered(room.scan, strict)
    assert whole.accepted  # with as many regions, of a scan that is not coarse
    assert few_px > 4 * whole_px


@pytest.mark.long
def test_petals_without_intensity_are_registered_and_another_place_is_refused() -> None:
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    case = outdoors("courtyard", lidar="petals", seed=102)
    result = lr.register(case.scan, case.photo)
    points = case.cloud.points[::50]
    true = case.true_camera.project(case.camera_from_scanner @ points)
    seen = case.true_camera.contains(true)
    off = np.hypot(*(true - result.camera.project(result.camera_from_scanner @ points))[seen].T)
    assert result.accepted, result.reasons
    assert float(np.median(off)) < 4
    assert any("only its shape" in reason for reason in result.reasons)
    other = outdoors("courtyard", lidar="petals", seed=103)
    refused = lr.register(case.scan, other.photo)
    assert not refused.accepted
    assert any("accumulate longer" in reason for reason in refused.reasons), refused.reasons
