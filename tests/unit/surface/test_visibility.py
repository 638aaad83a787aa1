import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, SphericalGrid
from ladarreg_core.surface.visibility.visible_points import project_scan, visible_cells

NEAR, FAR = 2.5, 4.0
PANEL = ((-0.45, 0.35), (-0.4, 0.5))  # Y and Z of the panel at X = NEAR
LENSES = [(), (0.12, -0.04, 0.002, -0.001), (-0.28, 0.09, 0.0, 0.0, -0.012)]


def in_panel(y, z, grow=0.0):
    (y0, y1), (z0, z1) = PANEL
    return (y > y0 - grow) & (y < y1 + grow) & (z > z0 - grow) & (z < z1 + grow)


def panel_scan(geometry, *, near=NEAR, noise_m=0.0, seed=0):
    rays = geometry.rays
    on_panel = rays * (near / rays[..., 0])[..., None]
    hit = in_panel(on_panel[..., 1], on_panel[..., 2])
    ranges = np.where(hit, near, FAR) / rays[..., 0]
    ranges += np.random.default_rng(seed).normal(size=ranges.shape) * noise_m
    return Scan(geometry, ranges, np.ones(geometry.shape)), hit


def hidden_by_panel(points, centre, grow, near=NEAR):
    """Whether the segment from a wall point to the camera passes the panel, grown by so many metres."""
    t = (near - centre[0]) / (points[..., 0] - centre[0])
    crossing = centre + t[..., None] * (points - centre)
    return in_panel(crossing[..., 1], crossing[..., 2], grow)


@settings(max_examples=25)
@given(
    centre=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.9, 0.9), st.floats(-0.7, 0.7)),
    turn=st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    focal=st.sampled_from([150.0, 500.0, 1500.0]),
    steps=st.sampled_from([(0.004, 0.004), (0.003, 0.015), (0.012, 0.004)]),
    noise_m=st.sampled_from([0.0, 0.003]),
    lens=st.sampled_from(LENSES),
)
def test_the_shadow_of_a_panel_is_the_analytic_one_to_within_a_cell(centre, turn, focal, steps, noise_m, lens):
    """Coarse grids too, whose columns lie 20 photo pixels apart: the surface hides, and nothing shines through it."""
    rows, columns = int(0.8 / steps[0]), int(1.0 / steps[1])
    scan, on_panel = panel_scan(AzimuthElevation(rows, columns, steps[1], steps[0]), noise_m=noise_m)
    centre = np.array(centre)
    camera = Camera(int(1.3 * focal), int(1.1 * focal), focal, focal, 0.66 * focal, 0.52 * focal, lens)
    pose = Rigid.from_centre(rotation_from_rotvec(turn) @ CAMERA_AXES_FROM_SCANNER, centre)
    seen = project_scan(scan, camera, pose)
    wall = ~on_panel & seen.in_picture
    points = scan.rays * (FAR / scan.rays[..., 0])[..., None]
    cell = 1.3 * max(steps) * NEAR * np.sqrt(1.4) + 1.5 * NEAR / focal * (focal < 400)
    surely = wall & hidden_by_panel(points, centre, -cell)
    surely_not = wall & ~hidden_by_panel(points, centre, cell)
    assert not seen.visible[surely].any()
    # A noisy cell may fall into the shadow of its neighbour once in a thousand.
    assert np.count_nonzero(seen.occluded[surely_not]) <= 0.001 * scan.ranges.size * (noise_m > 0)
    assert np.count_nonzero(seen.occluded & on_panel) <= 0.001 * scan.ranges.size * (noise_m > 0)


@settings(max_examples=12)
@given(distance=st.floats(1.5, 3.5), side=st.sampled_from([-1, 1]))
def test_a_thin_object_5_cm_before_a_wall_hides_it(distance, side):
    geometry = AzimuthElevation(60, 160, 0.003, 0.003)
    rays, gap = geometry.rays, 0.05
    ranges = distance / rays[..., 0]
    ranges[10:50, 79:81] = ((distance - gap) / rays[..., 0])[10:50, 79:81]  # a lath two cells wide
    scan = Scan(geometry, ranges, np.ones(geometry.shape))
    aside = 0.9 * side
    pan = np.arctan2(-aside, distance)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER @ rotation_from_rotvec((0, 0, -pan)), (0, aside, 0))
    seen = project_scan(scan, Camera.from_focal(640, 480, 800.0), pose)
    hidden = seen.occluded[14:46]
    # The ray from the camera through the lath meets the wall so many columns further (azimuth falls with the column).
    shadow = 79.5 + aside * gap / (distance - gap) / (0.003 * distance)
    from_middle = np.abs(np.arange(160) - shadow)
    wall = np.ones(160, dtype=bool)
    wall[79:81] = False
    assert seen.in_picture.all()
    assert hidden[:, wall & (from_middle < 0.5)].all()
    assert not hidden[:, from_middle > 2.2].any()
    assert not hidden[:, ~wall].any()


@settings(max_examples=20)
@given(height=st.floats(0.3, 2.5), reach=st.floats(-1.5, 1.5), noise_m=st.sampled_from([0.0, 0.002]))
def test_a_floor_and_a_wall_do_not_shadow_themselves(height, reach, noise_m):
    """A room's floor, however grazing, stays visible out to the wall wherever the camera stands."""
    geometry = AzimuthElevation(220, 120, 0.004, 0.004, elevation_offset_rad=-0.2)
    rays = geometry.rays
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 2] < 0, -1.5 / rays[..., 2], np.inf)
    ranges = np.minimum(floor, 9.0 / rays[..., 0])
    ranges += np.random.default_rng(0).normal(size=ranges.shape) * noise_m
    scan = Scan(geometry, ranges, np.ones(geometry.shape))
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (reach, 0.3, height - 1.5))
    seen = project_scan(scan, Camera.from_focal(500, 500, 300.0), pose)
    # Seen at a grazing angle the floor rises a metre a pixel: the wall's lowest row may go with it.
    hidden = seen.occluded.sum(axis=1)
    assert np.sort(hidden)[-2] <= 2
    assert hidden.sum() <= 125 + 0.001 * np.count_nonzero(seen.in_picture)


def test_the_incidence_is_measured_from_the_camera():
    geometry = AzimuthElevation(60, 60, 0.004, 0.004)
    rays = geometry.rays
    tilt = np.deg2rad(35.0)
    normal = np.array([np.cos(tilt), np.sin(tilt), 0.0])
    scan = Scan(geometry, 3.0 / (rays @ normal), np.ones(geometry.shape))
    for centre in ((0.0, 0.0, 0.0), (1.0, 2.0, 0.3), (-0.5, -1.0, 0.0)):
        pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, centre)
        seen = project_scan(scan, Camera.from_focal(4000, 4000, 500.0), pose)
        to_camera = np.array(centre) - scan.points
        expected = -(to_camera @ normal) / np.linalg.norm(to_camera, axis=-1)
        np.testing.assert_allclose(seen.cosine, expected, atol=4e-3)


def test_a_surface_seen_from_its_back_is_not_seen():
    geometry = AzimuthElevation(40, 40, 0.01, 0.01)
    scan = Scan(geometry, 2.0 / geometry.rays[..., 0], np.ones(geometry.shape))
    facing_back = rotation_from_rotvec((0, np.pi, 0)) @ CAMERA_AXES_FROM_SCANNER
    seen = project_scan(scan, Camera.from_focal(400, 400, 300.0), Rigid.from_centre(facing_back, (5.0, 0, 0)))
    assert seen.in_picture.all()
    assert seen.occluded.all()


def test_what_is_behind_or_outside_is_not_in_the_picture():
    geometry = SphericalGrid(40, 360, np.deg2rad(1), np.deg2rad(1), 0.0, 0.35)
    scan = Scan(geometry, np.full(geometry.shape, 3.0), np.ones(geometry.shape))
    camera = Camera.from_focal(320, 240, 300.0)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.2, 0.1, 0.0))
    seen = project_scan(scan, camera, pose)
    points = pose @ scan.points.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        u, v = points[..., 0] / points[..., 2] * 300 + 159.5, points[..., 1] / points[..., 2] * 300 + 119.5
    expected = (points[..., 2] > 0) & (np.abs(u - 159.5) <= 159.5) & (np.abs(v - 119.5) <= 119.5)
    np.testing.assert_array_equal(seen.in_picture, expected)
    np.testing.assert_array_equal(visible_cells(scan, camera, pose), expected)


@pytest.mark.parametrize("camera", [
    Camera.from_focal(1, 1, 1.0),
    Camera.from_focal(3, 60_000, 500.0),
    Camera.from_focal(640, 480, 1e6),
    Camera.from_focal(640, 480, 0.5),
    Camera(640, 480, 200, 200, 320, 240, (-0.6, 0.4, 0.01, -0.01, 0.0)),
    Camera(640, 480, 300, 300, 5000, -9000),
])  # fmt: skip
def test_odd_cameras_and_places_are_survived(camera):
    scan, _ = panel_scan(AzimuthElevation(40, 50, 0.02, 0.02))
    for centre in ((0, 0, 0), (2.5, 0, 0), (2.4999, 0.1, 0.1), (9, 0, 0), (1e6, 0, 0)):
        seen = project_scan(scan, camera, Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, centre))
        assert seen.visible.shape == scan.shape
        assert not (seen.occluded & ~seen.in_picture).any()


def test_a_camera_among_the_triangles_sees_past_those_beside_it():
    """The floor runs under the camera and behind it: triangles that cross its plane are cut, not dropped or flipped."""
    geometry = AzimuthElevation(16, 24, 0.06, 0.06, elevation_offset_rad=-0.5)
    rays = geometry.rays
    with np.errstate(divide="ignore"):
        ranges = np.where(rays[..., 2] < -0.05, -1.0 / rays[..., 2], np.nan)
    scan = Scan(geometry, ranges, np.ones(geometry.shape))
    wide = Camera.from_focal(600, 600, 150.0)
    down = rotation_from_rotvec((0.5, 0, 0)) @ CAMERA_AXES_FROM_SCANNER
    seen = project_scan(scan, wide, Rigid.from_centre(down, (2.0, 0.0, -0.6)))
    assert seen.in_picture.sum() > 50
    assert not seen.occluded.any()


@pytest.mark.slow
@pytest.mark.parametrize("lens", LENSES[:2])
def test_a_large_scan_is_projected_in_tiles_as_in_one_piece(lens, monkeypatch):
    from ladarreg_core.surface.visibility import visible_points as visibility

    scan, _ = panel_scan(AzimuthElevation(260, 330, 0.003, 0.003), noise_m=0.001)
    camera = Camera(260, 220, 300.0, 300.0, 130.0, 110.0, lens)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, np.array([0.3, 0.35, 0.1]))
    whole = project_scan(scan, camera, pose)
    for name, value in {"LARGEST_WHOLE_SCAN": 1000, "_TILE_ROWS": 64, "_TILE_CELLS": 6000}.items():
        monkeypatch.setattr(visibility, name, value)
    assert len(list(visibility.projected_tiles(scan, camera, pose))) > 8
    tiled = project_scan(scan, camera, pose)
    np.testing.assert_array_equal(tiled.in_picture, whole.in_picture)
    shown = whole.in_picture
    np.testing.assert_allclose(tiled.uv[shown], whole.uv[shown], atol=1e-3)
    assert np.count_nonzero(whole.occluded) > 500
    assert np.count_nonzero(tiled.occluded != whole.occluded) < 0.01 * np.count_nonzero(whole.occluded)
    assert np.abs(tiled.cosine[shown] - whole.cosine[shown]).max() < 0.05
    monkeypatch.setattr(visibility, "_TILE_MARGIN", 1)
    monkeypatch.setattr(visibility, "LARGEST_WHOLE_SCAN", 10**9)
    alone = 0  # without the surface of the other tiles, shadows across their borders are lost
    for tile in list(visibility.projected_tiles(scan, camera, pose)):
        alone += np.count_nonzero(project_scan(tile.scan, camera, pose).occluded[tile.inner])
    assert alone < 0.95 * np.count_nonzero(tiled.occluded)


def test_a_window_of_a_scan_has_its_rays_points_and_cells():
    from ladarreg_core.scanner.grids import TabulatedGrid

    for geometry in (SphericalGrid(40, 60, 0.01, 0.01, 0.2, 0.5), AzimuthElevation(40, 60, 0.01, 0.01)):
        for grid in (geometry, TabulatedGrid(geometry.rays)):
            scan = panel_scan(grid)[0]
            part = scan.window(slice(10, 31, 2), slice(5, 50, 3))
            np.testing.assert_allclose(part.rays, scan.rays[10:31:2, 5:50:3], atol=1e-12)
            np.testing.assert_allclose(part.points, scan.points[10:31:2, 5:50:3], atol=1e-6)
            np.testing.assert_allclose(part.geometry.cell_of(part.rays[4, 6]), [4, 6], atol=1e-6)
            np.testing.assert_allclose(part.geometry.ray_at([4.0, 6.0]), scan.rays[18, 23], atol=1e-9)
            assert part.geometry.step_rad == (2 * grid.step_rad[0], 3 * grid.step_rad[1])
