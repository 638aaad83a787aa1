"""Measurements: values on shapes that are known, and standard deviations against drawn errors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.inspection.measuring.measurement import KINDS, MeasurementKind
from ladarreg_core.inspection.measuring.points import AT_EDGE, MeasuredPoints
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation

SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
POSE = Rigid.from_centre(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), (0.2, -0.6, 0.1))
CAMERA = lr.Camera.from_focal(600, 400, 500.0)
COVARIANCE = np.diag([4e-7, 9e-7, 4e-7, 4e-6, 9e-6, 4e-6])


@cache
def step_scan(seed: int = 0, noise_m: float = 0.003) -> Scan:
    """A wall at 4 m, whose left half is at 3 m."""
    geometry = AzimuthElevation(200, 300, 0.004, 0.004)
    rays = geometry.rays
    ranges = np.where(rays[..., 1] > 0, 3.0, 4.0) / rays[..., 0]
    ranges = ranges + np.random.default_rng(seed).normal(size=ranges.shape) * noise_m
    return Scan(geometry, ranges, np.ones(ranges.shape))


def given_result(pose: Rigid = POSE) -> PoseResult:
    photo = lr.Photo(np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), CAMERA)
    return lr.given_pose(step_scan(), photo, pose, check_images=False)


def result(pose: Rigid = POSE) -> PoseResult:
    return replace(GIVEN, camera_from_scanner=pose, covariance=COVARIANCE, accepted=True, evidence="image")


GIVEN = given_result()


@pytest.mark.parametrize(
    ("kind", "points", "value", "unit"),
    [
        ("point", [[1, 2, 3]], [1, 2, 3], "m"),
        ("distance", [[0, 0, 0], [3, 4, 12]], 13, "m"),
        ("polyline", [[0, 0, 0], [3, 4, 0], [3, 4, 12]], 17, "m"),
        ("angle", [[1, 0, 0], [0, 0, 0], [0, 2, 0]], 90, "deg"),
        ("angle", [[1, 0, 0], [0, 0, 0], [-1, 0, 1e-9]], 180, "deg"),
        ("area", SQUARE, 4, "m2"),
        ("area", [[0, 0, 0], [2, 0, 0], [2, 2, 0], [1, 1, 0], [0, 2, 0]], 3, "m2"),  # a corner points inward
        ("height", [[1, 1, 5], *SQUARE], 5, "m"),
        ("height", [[1, 1, -5], *SQUARE], -5, "m"),
        ("height", [[1.0, 1, 0], [2, 0, 0], [2, 2, 0], [2, 2, 2]], 1, "m"),  # a wall: positive toward the scanner
    ],
)
def test_the_value_of_known_shapes_does_not_depend_on_where_they_are(kind, points, value, unit) -> None:
    for shift in (np.zeros(3), np.array([5e5, 5.4e6, 300.0])):
        if kind == "point" and shift.any():
            continue
        found = lr.measure(kind, MeasuredPoints.given(np.array(points, float) + shift, sigma_m=0.001), viewpoint=shift)
        np.testing.assert_allclose(found.value, value, atol=1e-6)
        assert found.unit == unit
        assert np.all(found.sigma > 0)


def test_standard_deviations_of_known_shapes() -> None:
    s = 0.003
    distance = lr.measure("distance", MeasuredPoints.given([[0, 0, 0], [3, 4, 12]], sigma_m=s))
    assert distance.sigma == pytest.approx(s * np.sqrt(2), rel=1e-5)
    assert distance.interval == pytest.approx((13 - 1.96 * distance.sigma, 13 + 1.96 * distance.sigma), abs=1e-6)
    angle = lr.measure("angle", MeasuredPoints.given([[1, 0, 0], [0, 0, 0], [0, 1, 0]], sigma_m=s))
    assert angle.sigma == pytest.approx(np.degrees(s * 2), rel=1e-5)  # two ends, and the vertex along both
    area = lr.measure("area", MeasuredPoints.given(SQUARE, sigma_m=s))
    assert area.sigma == pytest.approx(s * np.sqrt(2) * 2, rel=1e-5)  # each corner by half of its diagonal
    height = lr.measure("height", MeasuredPoints.given([[1, 1, 5], *SQUARE], sigma_m=s))
    assert height.sigma == pytest.approx(s * np.sqrt(1 + 1 / 4), rel=1e-5)


def test_what_all_points_share_cancels_in_a_distance_and_not_in_a_point() -> None:
    scan = step_scan()
    one = MeasuredPoints.of_photo(scan, result(), [[390, 150], [470, 250]], sigma_uv_px=0.0, sigma_range_m=0.0)
    again = MeasuredPoints.joined([one.subset([0]), MeasuredPoints.joined([one.subset([1])])])
    together = lr.measure("distance", one)
    assert lr.measure("distance", again).sigma == pytest.approx(together.sigma, rel=1e-9)
    apart = replace(one.subset([1]), shared={"another photograph": next(iter(one.shared.values()))[1:]})
    assert lr.measure("distance", MeasuredPoints.joined([one.subset([0]), apart])).sigma > 2 * together.sigma
    assert np.linalg.norm(lr.measure("point", one.subset([0])).sigma) > 2 * together.sigma


@cache
def drawn_points() -> list[MeasuredPoints]:
    """The same five points, with other errors of pose, pixels and ranges each time."""
    rng = np.random.default_rng(5)
    uv = np.array([[390, 150], [480, 160], [470, 260], [400, 250], [430, 200]], float)
    found = []
    for draw in range(150):
        off = rng.multivariate_normal(np.zeros(6), COVARIANCE)
        pose = Rigid.from_centre(rotation_from_rotvec(-off[:3]) @ POSE.rotation, POSE.centre - off[3:])
        clicked = uv + rng.normal(0, 0.7, uv.shape)
        found.append(MeasuredPoints.of_photo(step_scan(draw % 30), result(pose), clicked, sigma_uv_px=0.7))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_standard_deviations_are_those_of_drawn_errors(kind: MeasurementKind) -> None:
    count = {"point": 1, "distance": 2, "polyline": 4, "angle": 3, "area": 4, "height": 5}[kind]
    found = [lr.measure(kind, points.subset(range(count))) for points in drawn_points()]
    assert not any(AT_EDGE in flag for one in found for flag in one.flags)
    spread = np.std([np.atleast_1d(one.value) for one in found], axis=0)
    sigma = np.mean([np.atleast_1d(one.sigma) for one in found], axis=0)
    np.testing.assert_allclose(sigma / spread, 1, atol=0.18)  # three standard deviations of the spread


@pytest.mark.slow
def test_points_of_the_scan_have_the_noise_of_the_scan_and_of_the_pick() -> None:
    cells = np.array([[60.0, 220.0], [140.3, 260.6]])
    values, stated = [], []
    rng = np.random.default_rng(2)
    for draw in range(120):
        found = MeasuredPoints.of_scan(step_scan(draw), cells=cells + rng.normal(0, 0.5, cells.shape), sigma_cells=0.5)
        measured = lr.measure("distance", found)
        values.append(measured.value)
        stated.append(measured.sigma)
    assert np.mean(stated) / np.std(values) == pytest.approx(1, abs=0.18)


def test_the_angle_of_a_pick_counts_where_it_is_more_than_its_cells() -> None:
    scan = step_scan(0)
    cells = np.array([[20.0, 12.0], [30.0, 14.0]])
    steps_rad = [
        np.linalg.norm(scan.geometry.ray_at(cells + half) - scan.geometry.ray_at(cells - half), axis=1)
        for half in (np.array([0.5, 0]), np.array([0, 0.5]))
    ]
    (by_angle, by_cells) = (
        MeasuredPoints.of_scan(scan, cells=cells, sigma_rad=float(max(map(np.max, steps_rad)))),
        MeasuredPoints.of_scan(scan, cells=cells, sigma_cells=1.0),
    )
    ratio = np.sqrt(np.diag(by_angle.covariance) / np.diag(by_cells.covariance))
    assert (ratio > 0.999).all()
    least = float(min(map(np.min, steps_rad)))
    small = MeasuredPoints.of_scan(scan, cells=cells, sigma_rad=least * 0.4)
    np.testing.assert_array_equal(small.covariance, MeasuredPoints.of_scan(scan, cells=cells).covariance)


def test_points_at_depth_edges_are_flagged_or_refused_and_others_are_not() -> None:
    scan = step_scan()
    for columns in (149.6, 149.2, 150.5):
        found = MeasuredPoints.of_scan(scan, cells=[[100, columns]])
        assert AT_EDGE in found.flags[0] or "depth edge" in found.refusals[0]
    found = MeasuredPoints.of_scan(scan, cells=[[100, 130], [100, 170]])
    assert found.flags == ((), ())
    assert found.refusals == ("", "")
    edge = CAMERA.project(POSE @ np.array([[3.0, 0.0, 0.0]]))  # the rim of the nearer half
    found = MeasuredPoints.of_photo(scan, result(), edge + np.array([[-1.0, 0], [1, 0], [-60, 0], [120, 0]]))
    marked = [AT_EDGE in flags or bool(why) for flags, why in zip(found.flags, found.refusals, strict=True)]
    assert marked == [True, True, False, False]


def test_what_cannot_be_measured_is_refused_in_a_sentence() -> None:
    scan = step_scan()
    found = MeasuredPoints.of_photo(scan, result(), [[390, 150], [900, 2]])
    with pytest.raises(lr.LadarregError, match=r"\(900, 2\) is outside the photograph, which has 600 x 400"):
        lr.measure("distance", found)
    with pytest.raises(lr.LadarregError, match="outside the scan, which has 200 rows and 300 columns"):
        lr.measure("point", MeasuredPoints.of_scan(scan, cells=[[-4, 3]]))
    behind = MeasuredPoints.of_scan(scan, rays=[[-1, 0, 0]])
    assert behind.refusals[0]
    given = MeasuredPoints.given
    for kind, points, words in (
        ("distance", SQUARE[:1], "1 points are given for a distance; give two"),
        ("angle", SQUARE, "give three, its vertex second"),
        ("distance", SQUARE[[0, 0]], "are the same"),
        ("area", np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), "on one line"),
        ("area", SQUARE[[0, 2, 1, 3]], "cross each other"),
        ("height", np.array([[0.0, 0, 1], [0, 0, 0], [1, 0, 0], [2, 0, 0]]), "on one line"),
    ):
        with pytest.raises(lr.LadarregError, match=words):
            lr.measure(kind, given(points))
    with pytest.raises(lr.LadarregError, match="kind of measurement"):
        lr.measure("volume", given(SQUARE))  # type: ignore[arg-type]
    with pytest.raises(lr.LadarregError, match="finite"):
        given([[np.nan, 0, 0]])
    with pytest.raises(lr.LadarregError, match="negative"):
        given(SQUARE, sigma_m=-1.0)
    refused = replace(result(), accepted=False, evidence="none")
    with pytest.raises(lr.LadarregError, match="refused"):
        MeasuredPoints.of_photo(scan, refused, [[390, 150]])


def test_a_pose_that_was_given_has_no_standard_deviation_and_says_so() -> None:
    found = MeasuredPoints.of_photo(step_scan(), GIVEN, [[390, 150], [470, 250]])
    measured = lr.measure("distance", found)
    assert np.isfinite(measured.value)
    assert np.isnan(measured.sigma)
    assert any("given" in flag for flag in measured.flags)


def test_corners_off_their_plane_and_values_near_zero_are_flagged() -> None:
    bent = SQUARE.copy()
    bent[::2, 2] = 0.1
    assert any("off their plane" in flag for flag in lr.measure("area", MeasuredPoints.given(bent, sigma_m=1e-3)).flags)
    near = lr.measure("distance", MeasuredPoints.given([[0, 0, 0], [0.001, 0, 0]], sigma_m=0.002))
    assert near.interval[0] == 0
    assert any("rough" in flag for flag in near.flags)


def test_points_are_moved_to_the_world_with_their_errors() -> None:
    found = MeasuredPoints.of_photo(step_scan(), result(), [[390, 150], [470, 250]])
    world = Rigid(rotation_from_rotvec((0.1, 0.2, 1.0)), np.array([5e5, 5.4e6, 300.0]))
    moved = found.moved(world)
    np.testing.assert_allclose(moved.xyz, world @ found.xyz)
    turn = np.kron(np.eye(2), world.rotation)
    np.testing.assert_allclose(moved.covariance, turn @ found.covariance @ turn.T, atol=1e-15)
