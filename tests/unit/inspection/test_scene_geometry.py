"""Viewpoints, outlines and curves of the 3-D scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.camera import Camera, FisheyeCamera
from ladarreg_core.errors import ShapeError
from ladarreg_core.export.models.viser_colors import line_colors_for_viewer, shown_colors
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, look_along
from ladarreg_core.inspection.scene_geometry import (
    Marks,
    arrows,
    camera_outline,
    camera_outlines,
    dashed,
    distance_of_picture,
    faded,
    picture_sheet,
    rays_to,
    spread,
)
from ladarreg_core.inspection.viewpoints import field_of_view, from_pose, inside, is_all_around, overview
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, SphericalGrid
from tests.properties.strategies import poses

CAMERA = Camera.from_focal(600, 400, 500.0)
GEOMETRY = AzimuthElevation(40, 60, 0.01, 0.01)
WALL = Scan(GEOMETRY, 3 / GEOMETRY.rays[..., 0], np.ones((40, 60)))


@given(poses(reach_m=5.0), st.floats(0.05, 3.0))
def test_a_cameras_outline_ends_at_the_corners_of_its_image(pose: Rigid, depth: float) -> None:
    lines = camera_outline(CAMERA, pose, depth_m=depth)
    assert lines.shape == (8, 2, 3)
    np.testing.assert_allclose(lines[:4, 0], np.broadcast_to(pose.centre, (4, 3)), atol=1e-4)
    seen = CAMERA.project(pose @ lines[:4, 1].astype(float))
    np.testing.assert_allclose(seen, [[-0.5, -0.5], [599.5, -0.5], [599.5, 399.5], [-0.5, 399.5]], atol=0.5)
    np.testing.assert_array_equal(lines[4:, 0], lines[:4, 1])
    np.testing.assert_array_equal(np.roll(lines[4:, 0], -1, axis=0), lines[4:, 1])


@given(st.integers(1, 20))
def test_dashes_lie_on_their_line_and_reach_both_ends(dashes: int) -> None:
    line = np.array([[[0.0, 1, 2], [4.0, 1, -2]]])
    pieces = dashed(line, dashes=dashes)
    assert pieces.shape == (dashes, 2, 3)
    np.testing.assert_allclose(pieces[0, 0], line[0, 0], atol=1e-6)
    np.testing.assert_allclose(pieces[-1, 1], line[0, 1], atol=1e-6)
    along = pieces[..., 0].ravel()
    assert (np.diff(along) > 0).all()
    np.testing.assert_allclose(pieces[..., 2], 2 - pieces[..., 0], atol=1e-5)


def test_marks_without_a_finite_point_are_left_out() -> None:
    marks = Marks.of(
        [[1, 2, 3], [np.nan, 0, 0], [4, 5, 6]], [[255, 0, 0], [0, 255, 0], [0, 0, 255]], [True, True, False]
    )
    assert marks.given.tolist() == [0, 2]
    dim = marks.dimmed((0, 0, 0), on=0.0, off=0.5)
    assert dim.tolist() == [[255, 0, 0], [0, 0, 128]]
    assert marks.chosen([False, True]).points.tolist() == [[4, 5, 6]]
    before = marks.before(0.1)
    np.testing.assert_allclose(np.linalg.norm(marks.points - before, axis=1), 0.1, rtol=1e-5)
    np.testing.assert_allclose(np.cross(before, marks.points), 0, atol=1e-5)
    assert len(Marks.of([], [], [])) == 0
    assert len(Marks.of(np.zeros((0, 3)), np.zeros((0, 3)), [])) == 0
    with pytest.raises(ShapeError):
        Marks.of([[1, 2, 3]], [[1, 2, 3], [4, 5, 6]], [True])


@given(st.integers(0, 19), st.floats(-0.9, 0.9), st.floats(-0.9, 0.9))
def test_a_click_selects_the_mark_nearest_to_its_ray(wanted: int, aside: float, above: float) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform((2, -3, -2), (6, 3, 2), (20, 3))
    marks = Marks.of(points, np.zeros((20, 3), np.uint8), np.ones(20, bool))
    eye = np.array([-1.0, aside, above])
    assert marks.nearest_to_ray(eye, 7 * (points[wanted] - eye), radius_m=0.02) == wanted
    assert marks.nearest_to_ray(eye, eye - points[wanted], radius_m=0.02) is None, "behind the eye"
    assert marks.nearest_to_ray(eye, (0.0, 0.0, 1.0), radius_m=0.02) is None


@given(poses())
def test_a_click_hits_a_picture_only_within_its_outline(pose: Rigid) -> None:
    corners = np.array([[-1.0, -1.0], [1.0, 1.0]]) * np.tan(np.array(field_of_view(CAMERA)) / 2)
    eye = (pose.inverse @ np.array([[0.4, -0.3, -2.0]]))[0]
    for share, hit in ((0.0, True), (0.97, True), (1.03, False)):
        for corner in corners:
            at = (pose.inverse @ np.array([[*(share * 1.5 * corner), 1.5]]))[0]
            for factor in (1.0, 0.25):
                found = distance_of_picture(CAMERA, pose, eye, factor * (at - eye), depth_m=1.5)
                assert found == (pytest.approx(1 / factor) if hit else None)
            assert distance_of_picture(CAMERA, pose, eye, eye - at, depth_m=1.5) is None, "it lies behind"


def test_an_arrow_ends_where_something_is_now() -> None:
    was, now = np.array([[0.0, 0, 0], [1.0, 2, 3]]), np.array([[0.1, 0.2, -0.1], [1.0, 2, 3]])
    lines = arrows(was, now, factor=10)
    assert lines.shape == (6, 2, 3)
    assert np.allclose(lines[:, 1], np.tile(now, (3, 1)))
    assert np.allclose(lines[0, 0], now[0] - 10 * (now[0] - was[0]))
    heads = np.linalg.norm(lines[[2, 4], 0] - lines[[2, 4], 1], axis=1)
    assert heads == pytest.approx([heads[0]] * 2)
    assert 0 < heads[0] < 0.4 * np.linalg.norm(lines[0, 0] - lines[0, 1])
    assert np.isfinite(lines).all()


def test_small_helpers() -> None:
    assert camera_outlines(CAMERA, (), depth_m=1.0).shape == (0, 2, 3)
    assert camera_outlines(CAMERA, (Rigid.identity(),) * 3, depth_m=1.0).shape == (24, 2, 3)
    assert rays_to(np.ones((5, 3)), (np.zeros(3), np.ones(3))).shape == (10, 2, 3)
    assert faded([[200, 100, 0]], (0, 0, 0), share=0.5).tolist() == [[100, 50, 0]]
    assert np.abs(shown_colors(line_colors_for_viewer([[92, 200, 255]]), base_color=1.0).astype(int)).min() > 0


@given(st.integers(0, 500), st.integers(1, 60))
def test_spread_indices_reach_both_ends(count: int, most: int) -> None:
    chosen = spread(count, most)
    assert len(chosen) == min(count, most)
    if most > 1 and count > 1:
        assert (chosen[0], chosen[-1]) == (0, count - 1)


@given(poses(reach_m=3.0))
def test_a_camera_viewpoint_lies_at_its_centre_and_looks_along_its_axis(pose: Rigid) -> None:
    there = from_pose(WALL, CAMERA, pose)
    np.testing.assert_allclose(there.position, pose.centre, atol=1e-12)
    in_camera = pose @ np.stack([there.look_at, there.position + there.up])
    np.testing.assert_allclose(in_camera[0, :2], 0, atol=1e-9)
    assert in_camera[0, 2] > 0
    np.testing.assert_allclose(in_camera[1], [0, -1, 0], atol=1e-9)


@given(st.floats(0.2, 5.0))
def test_a_window_of_any_shape_shows_the_whole_field_of_view(aspect: float) -> None:
    there = from_pose(WALL, CAMERA, Rigid(CAMERA_AXES_FROM_SCANNER, np.zeros(3)))
    upright = math.tan(there.upright_fov_rad(aspect) / 2)
    assert upright >= 200 / 500 - 1e-9
    assert upright * aspect >= 300 / 500 - 1e-9
    assert min(upright / (200 / 500), upright * aspect / (300 / 500)) == pytest.approx(1)


@given(st.none() | st.tuples(*[st.floats(-2.0, 2.0)] * 3))
def test_the_overview_shows_the_scanner_the_camera_and_nearly_all_of_the_model(
    centre: tuple[float, float, float] | None,
) -> None:
    there = overview(WALL, None if centre is None else np.array(centre))
    view = Rigid.from_centre(look_along(there.look_at - there.position), there.position)
    half = np.tan(np.array(there.fov_rad) / 2)
    seen = view @ np.vstack([np.zeros(3), np.zeros(3) if centre is None else centre, WALL.points.reshape(-1, 3)])
    inside = (seen[:, 2] > 0) & (np.abs(seen[:, :2]) <= half * seen[:, 2:]).all(axis=1)
    assert inside[:2].all()
    assert inside.mean() > 0.94
    assert (there.position < there.look_at)[0]
    assert (there.position > there.look_at)[2]
    upright = seen[inside, 1] / seen[inside, 2]
    assert abs(upright.max() + upright.min()) < 0.2 * half[1], "not in the middle"
    if centre is not None and abs(centre[1]) > 0.5:
        assert (there.position - there.look_at)[1] * centre[1] < 0, "from the other side"


def test_the_overview_of_a_scan_that_looks_all_around() -> None:
    geometry = AzimuthElevation(20, 90, 0.03, 2 * np.pi / 90)
    there = overview(Scan(geometry, np.full((20, 90), 2.0), np.ones((20, 90))), None)
    assert np.isfinite([*there.position, *there.look_at]).all()
    assert np.linalg.norm(there.look_at - there.position) > 0.3


def test_a_scan_of_half_the_horizon_is_all_around() -> None:
    for columns, expected in ((40, False), (85, False), (180, True)):
        geometry = SphericalGrid(10, columns, 2 * np.pi / 180, 0.05, 0.3, 0.2)
        scan = Scan(geometry, np.full((10, columns), 2.0), np.ones((10, columns)))
        assert is_all_around(scan) == expected, columns
    there = inside(scan, np.array([0.5, 0, 0]), np.array([0.0, 1, 0]))
    np.testing.assert_allclose(there.look_at - there.position, [0, 2, 0])


def test_the_overview_looks_along_a_given_direction() -> None:
    there = overview(WALL, None, forward=np.array([0.2, 1, 5]))
    along = (there.look_at - there.position)[:2]
    assert along @ [0.2, 1] / np.linalg.norm(along) / np.linalg.norm([0.2, 1]) > 0.9


@given(poses(reach_m=5.0), st.floats(0.5, 30.0))
def test_a_pictures_sheet_shows_each_pixel_on_its_ray(pose: Rigid, distance: float) -> None:
    camera = Camera(640, 480, 500.0, 510.0, 317.0, 241.0, distortion=(-0.12, 0.03, 0.001, -0.002))
    net = picture_sheet(camera, pose, distance_m=distance, squares=12)
    assert net.shape == (10, 13, 3)
    assert np.linalg.norm(net - pose.centre, axis=-1) == pytest.approx(distance)
    uv = camera.project(pose @ net.reshape(-1, 3)).reshape(10, 13, 2)
    assert uv[0, 0] == pytest.approx([-0.5, -0.5], abs=1e-3)
    assert uv[-1, -1] == pytest.approx([639.5, 479.5], abs=1e-3)
    assert uv[3, 6] == pytest.approx([319.5, 159.5], abs=1e-3)


def test_a_pictures_sheet_is_open_where_its_camera_has_no_ray() -> None:
    camera = FisheyeCamera(500, 500, 130.0, 130.0, 249.5, 249.5)
    net = picture_sheet(camera, Rigid.identity(), distance_m=2.0)
    has_ray = np.isfinite(camera.unproject([[-0.5, -0.5], [249.5, 249.5]])).all(axis=1)
    assert np.isfinite(net[0, 0]).all() == has_ray[0]
    assert np.isfinite(net[8, 8]).all()
    assert has_ray[1]
