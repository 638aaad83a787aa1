"""Lines between matches: planar surfaces only, constant intervals, positions by perspective."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, look_along, rotation_from_rotvec
from ladarreg_core.matching.images.scan_levels import ScanLevels, scan_levels
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.perspective import perspective_view
from ladarreg_core.thesis.matching.densify import DensifyOptions, LinePoints, fraction_in_photo, lines_between
from testing.scenes.painted_room import shoot

CAMERA = Camera.from_focal(420, 300, 520.0)
CENTRE = np.array([0.3, -0.7, 0.1])
POSE = Rigid.from_centre(look_along(np.array([3.6, 0.1, -0.3]) - CENTRE), CENTRE)


@dataclass(frozen=True)
class Room:
    levels: ScanLevels

    def points(self, uv: np.ndarray) -> np.ndarray:
        rays = self.levels.view.rays_at(uv)
        return rays * shoot(np.zeros(3), rays)[0][:, None]

    def matches(self, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return exact matches inside the photo; occlusion is ignored."""
        rng = np.random.default_rng(seed)
        uv = rng.uniform([2, 2], [CAMERA.width - 3, CAMERA.height - 3], (4 * count, 2))
        points = self.points(uv)
        photo = CAMERA.project(POSE @ np.where(np.isfinite(points), points, np.nan))
        held = CAMERA.contains(photo)
        return uv[held][:count], photo[held][:count]

    def lines(self, matches: tuple[np.ndarray, np.ndarray], *, pose: Rigid | None = POSE, **options: Any) -> LinePoints:
        return lines_between(self.levels, *matches, DensifyOptions(**options), photo_camera=CAMERA, pose=pose)


def a_room(hole: tuple[slice, slice] | None = None) -> Room:
    """The painted room without noise."""
    geometry = AzimuthElevation(300, 420, np.deg2rad(0.11), np.deg2rad(0.11))
    ranges, box, _ = shoot(np.zeros(3), geometry.rays.reshape(-1, 3))
    ranges = np.where(box >= 0, ranges, np.nan).reshape(300, 420)
    if hole:
        ranges[hole] = np.nan
    scan = Scan(geometry, ranges, np.ones((300, 420)))
    return Room(scan_levels(scan, perspective_view(scan, CAMERA)))


@pytest.fixture(scope="module")
def room() -> Room:
    return a_room()


def test_points_lie_at_the_projections_of_the_measured_points(room: Room) -> None:
    matches = room.matches(150, seed=1)
    exact = room.lines(matches)
    assert len(exact.ends) > 100
    measured = room.levels.view.rays_at(exact.scan_uv) * exact.ranges[:, None]
    expected = CAMERA.project(POSE @ measured)
    error = np.hypot(*(expected - exact.photo_uv).T)
    assert np.percentile(error, 95) < 0.05
    assert error.max() < 2  # where a line crosses a fold within the threshold

    equal, without_pose = room.lines(matches, kappa="equal"), room.lines(matches, pose=None)
    np.testing.assert_array_equal(equal.photo_uv, without_pose.photo_uv)
    np.testing.assert_array_equal(equal.scan_uv, exact.scan_uv)
    first, last = matches[1][exact.ends[exact.line, 0]], matches[1][exact.ends[exact.line, 1]]
    np.testing.assert_allclose(equal.photo_uv, first + equal.fraction[:, None] * (last - first), atol=1e-9)
    assert np.percentile(np.hypot(*(expected - equal.photo_uv).T), 95) > 0.25


def test_lines_lie_on_planar_surfaces_without_holes() -> None:
    holed = a_room((slice(140, 160), slice(180, 260)))
    matches = holed.matches(200, seed=2)
    lines = holed.lines(matches, longest_px=300.0, plane_sigma_m=0.02, plane_sigma_relative=0.0)
    assert len(lines.ends) > 100
    hole = ~np.isfinite(holed.levels.ranges)
    for i, j in lines.ends:
        a, b = matches[0][i], matches[0][j]
        uv = a + np.linspace(0, 1, 200)[:, None] * (b - a)
        pixel = np.rint(uv).astype(int)
        assert not hole[pixel[:, 1], pixel[:, 0]].any()
        # Intersect each line of sight with the straight line in space between the ends.
        A, B = holed.points(np.stack([a, b]))
        rays = holed.levels.view.rays_at(uv)
        across = np.cross(np.cross(A, B), B - A)
        off = (across @ A) / (rays @ across) - np.linalg.norm(holed.points(uv), axis=1)
        assert np.sqrt(np.mean(off**2)) < 0.023  # the ranges are filtered


@settings(max_examples=25)
@given(seed=st.integers(0, 1000), interval=st.floats(2, 60))
def test_intervals_are_constant_and_leave_out_the_ends(room: Room, seed: int, interval: float) -> None:
    scan_uv, photo_uv = room.matches(40, seed)
    lines = room.lines((scan_uv, photo_uv), interval_px=interval)
    assert np.isfinite(np.column_stack([lines.scan_uv, lines.photo_uv, lines.ranges])).all()
    assert np.unique(lines.line).tolist() == list(range(len(lines.ends)))
    for k, (i, j) in enumerate(lines.ends):
        mine = lines.line == k
        length = np.hypot(*(scan_uv[j] - scan_uv[i]))
        from_start = np.hypot(*(lines.scan_uv[mine] - scan_uv[i]).T)
        np.testing.assert_allclose(np.diff(from_start), interval)
        np.testing.assert_allclose(from_start, lines.fraction[mine] * length)
        margins = np.array([from_start[0], length - from_start[-1]])
        assert margins[0] == pytest.approx(margins[1])
        assert margins[0] > interval / 2 - 1e-9 or len(from_start) == 1
        assert margins[0] <= interval + 1e-9
        np.testing.assert_allclose(lines.weight[mine] ** -2, mine.sum())


@settings(max_examples=15)
@given(order=st.permutations(range(60)))
def test_the_order_of_the_matches_does_not_matter(room: Room, order: list[int]) -> None:
    scan_uv, photo_uv = room.matches(60, seed=3)
    one, other = room.lines((scan_uv, photo_uv)), room.lines((scan_uv[order], photo_uv[order]))
    assert len(one) > 100
    a, b = (np.column_stack([lines.scan_uv, lines.photo_uv, lines.ranges, lines.weight]) for lines in (one, other))
    np.testing.assert_allclose(a[np.argsort(a[:, 0])], b[np.argsort(b[:, 0])], atol=1e-5)


def test_the_number_and_length_of_lines_are_limited(room: Room) -> None:
    matches = room.matches(300, seed=4)
    lines = room.lines(matches, lines_per_match=3, longest_px=70.0, shortest_px=25.0)
    length = np.hypot(*(matches[0][lines.ends[:, 1]] - matches[0][lines.ends[:, 0]]).T)
    assert np.bincount(lines.ends.ravel()).max() == 3
    assert length.min() >= 25
    assert length.max() <= 70
    assert len({tuple(sorted(pair)) for pair in lines.ends.tolist()}) == len(lines.ends)
    few = room.lines(matches, lines_per_match=3, longest_px=70.0, shortest_px=25.0, most_lines=17)
    np.testing.assert_array_equal(few.ends, lines.ends[:17])


def test_duplicate_lines_are_removed(room: Room) -> None:
    scan_uv, photo_uv = room.matches(30, seed=5)
    doubled = np.concatenate([scan_uv, scan_uv + 0.3]), np.concatenate([photo_uv, photo_uv + 0.3])
    lines = room.lines(doubled)
    ends = doubled[0][lines.ends]
    assert len(ends) > 20
    for both_ways in (ends, ends[:, ::-1]):
        distance = np.abs(ends[:, None] - both_ways).max(axis=(2, 3))
        assert (distance[np.triu_indices(len(ends), 1)] >= DensifyOptions().interval_px).all()


@pytest.mark.parametrize(
    ("scan", "photo"),
    [
        (np.zeros((0, 2)), np.zeros((0, 2))),
        ([[50.0, 60.0]], [[40.0, 60.0]]),
        ([[50.0, 60.0]] * 5, [[40.0, 60.0]] * 5),
        ([[50.0, 60.0], [np.nan, 60.0], [np.inf, -np.inf]], [[40.0, 60.0], [80.0, 60.0], [80.0, 90.0]]),
        ([[50.0, 60.0], [90.0, 60.0]], [[40.0, 60.0], [np.nan, 60.0]]),
        ([[-50.0, 60.0], [1e300, 60.0], [90.0, 1e5]], [[40.0, 60.0], [80.0, 60.0], [80.0, 90.0]]),
        ([[50.0, 60.0], [90.0, 60.0]], [[40.0, 60.0], [40.0, 60.5]]),  # one photo corner for both
        ([[50.0, 60.0], [90.0, 60.0]], [[40.0, 60.0], [400.0, 60.0]]),
    ],
)
def test_degenerate_matches_give_no_points(room: Room, scan: Any, photo: Any) -> None:
    lines = room.lines((np.array(scan), np.array(photo)))
    assert len(lines) == len(lines.ends) == len(lines.weight) == 0
    assert lines.scan_uv.shape == lines.photo_uv.shape == (0, 2)


def test_matches_without_a_range_end_no_line(room: Room) -> None:
    matches = room.matches(40, seed=6)
    empty = replace(room.levels, ranges=np.full_like(room.levels.ranges, np.nan), edge=np.ones_like(room.levels.edge))
    assert len(room.lines(matches))
    assert not len(lines_between(empty, *matches, photo_camera=CAMERA))


def test_a_pose_facing_away_gives_equal_intervals(room: Room) -> None:
    matches = room.matches(40, seed=7)
    backwards = Rigid(np.diag([-1.0, 1.0, -1.0]) @ POSE.rotation, POSE.translation)
    np.testing.assert_array_equal(
        room.lines(matches, pose=backwards).photo_uv, room.lines(matches, kappa="equal").photo_uv
    )


def test_arrays_of_different_length_raise_a_one_line_error(room: Room) -> None:
    for scan, photo in ((np.zeros((3, 2)), np.zeros((2, 2))), (np.zeros(3), np.zeros(3)), (["a"], ["b"])):
        with pytest.raises(ShapeError) as caught:
            lines_between(room.levels, scan, photo, photo_camera=CAMERA)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "option",
    [
        {"plane_sigma_m": -1},
        {"plane_sigma_m": np.nan},
        {"plane_sigma_relative": 2},
        {"interval_px": 0},
        {"interval_px": "8"},
        {"shortest_px": 0.5},
        {"longest_px": np.inf},
        {"most_stretch": 0.9},
        {"neighbours": 0},
        {"lines_per_match": 2.5},
        {"most_lines": True},
        {"kappa": "both"},
    ],
)
def test_invalid_options_are_refused(option: dict[str, Any]) -> None:
    with pytest.raises(OptionError) as caught:
        DensifyOptions(**option)
    assert next(iter(option)) in str(caught.value)
    assert "\n" not in str(caught.value)


@given(
    ends=st.lists(st.floats(-1, 1), min_size=4, max_size=4),
    depths=st.lists(st.floats(1, 9), min_size=2, max_size=2),
    turn=st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
    t=st.floats(0.01, 0.99),
)
def test_kappa_is_exact_on_straight_lines(ends: list[float], depths: list[float], turn: list[float], t: float) -> None:
    view = Rigid(CAMERA_AXES_FROM_SCANNER, np.zeros(3))
    a, b = (view.inverse @ np.array([x * z, y * z, z]) for (x, y), z in zip((ends[:2], ends[2:]), depths, strict=True))
    camera = Rigid(rotation_from_rotvec(turn), np.array([0.4, -0.1, 3.0])) @ view

    def fraction(transform: Rigid) -> tuple[float, float]:
        """Return the position of the point at t along the projected line, and z_b / z_a."""
        p, q, r = (transform @ point for point in (a, b, a + t * (b - a)))
        p_uv, q_uv, r_uv = (point[:2] / point[2] for point in (p, q, r))
        along = q_uv - p_uv
        return float((r_uv - p_uv) @ along / max(float(along @ along), 1e-300)), float(q[2] / p[2])

    on_scan, ratio_scan = fraction(view)
    on_photo, ratio_photo = fraction(camera)
    if np.hypot(ends[0] - ends[2], ends[1] - ends[3]) > 1e-3 and on_photo != 0:
        found = fraction_in_photo(np.array([on_scan]), np.array([ratio_photo / ratio_scan]))
        assert abs(found[0] - on_photo) < 1e-6
