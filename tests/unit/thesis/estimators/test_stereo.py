"""Properties of the stereo depths and the two costs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.pose.diagnostics import diagnose, stereo_depth_error
from ladarreg_core.thesis.estimators.epipolar import epipolar_cost, epipolar_residuals
from ladarreg_core.thesis.estimators.stereo import StereoPairs, stereo_cost, stereo_frame
from testing.scenes.room import room_case
from tests.properties.strategies import rotvecs

WIDE = Camera(1000, 800, 500.0, 510.0, 490.0, 405.0)
LENS = Camera(1000, 800, 500.0, 510.0, 490.0, 405.0, (-0.1, 0.03, 1e-3, -7e-4))


def exact_case(seed: int, *, aside: np.ndarray | None = None, camera: Camera = WIDE) -> tuple[Matches, Rigid]:
    """Noise-free matches from a camera with a baseline of a tenth to a half of the depth, mostly lateral."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(2, 10, 12)
    points = depth[:, None] * np.column_stack([np.ones(12), rng.uniform(-0.5, 0.5, (12, 2))])
    angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 1.0)
    centre = length * np.array([rng.uniform(-0.5, 0.5), np.cos(angle), np.sin(angle)])
    turn = rotation_from_rotvec(rng.normal(size=3) * 0.15) @ CAMERA_AXES_FROM_SCANNER
    pose = Rigid.from_centre(turn, centre)
    if aside is not None:  # rotate the whole scene, including the camera, about the scanner
        points, pose = points @ aside.T, pose @ Rigid(aside.T, np.zeros(3))
    ranges = np.linalg.norm(points, axis=1)
    return Matches(points / ranges[:, None], ranges, camera.project(pose @ points)), pose


def well_away_from_poles(pairs: StereoPairs, x: np.ndarray) -> bool:
    """Return whether all disparities are large enough that rounding does not affect the depths."""
    residual = epipolar_residuals(x, pairs)
    assert np.abs(residual).max() < 1e-12
    shift = np.array([[x[0]], [x[1]]])
    rectified = (pairs.laser + shift / pairs.depth) / (1 - x[2] / pairs.depth)
    along = (rectified - pairs.laser) * np.hypot(x[0], x[1])
    turned = [x[:2] @ along + s * (x[0] * along[1] - x[1] * along[0]) for s in (1, -1)]
    return bool(np.abs(turned).min() > 0.03 * np.hypot(x[0], x[1]) ** 2)


@pytest.mark.slow
@given(seed=st.integers(0, 100_000), turn=st.one_of(st.none(), rotvecs()))
@settings(max_examples=150)
def test_without_noise_2_21_gives_the_laser_depth(seed, turn):
    matches, pose = exact_case(seed, aside=None if turn is None else rotation_from_rotvec(turn))
    pairs = StereoPairs.of(matches, WIDE)
    assert pairs.usable.all()
    x = pairs.parameters(pose)
    assume(well_away_from_poles(pairs, x))
    assert np.abs(pairs.depths(x) / pairs.depth - 1).max() <= 1e-12
    assert pairs.pose(x).matrix == pytest.approx(pose.matrix, abs=1e-13)
    assert stereo_cost(pairs)(x) < 1e-22
    assert epipolar_cost(pairs)(x) < 1e-24


def test_distortion_is_removed():
    matches, pose = exact_case(3, camera=LENS)
    pairs = StereoPairs.of(matches, LENS)
    assert np.abs(epipolar_residuals(pairs.parameters(pose), pairs)).max() < 1e-9


@given(seed=st.integers(0, 100_000), weighted=st.booleans())
@settings(max_examples=60)
def test_the_fast_costs_are_the_equations(seed, weighted):
    case = room_case(seed, count=60, baseline_m=1.0, direction=(0.2, 1.0, 0.3))
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.1, 4, 60) if weighted else None
    pairs = StereoPairs.of(Matches(case.rays, case.ranges, case.uv, weights=weights), case.camera)
    x = pairs.parameters(case.pose) + rng.normal(size=6) * ([0.1] * 3 + [0.02] * 3)
    stereo = (pairs.weights * (pairs.depth - pairs.depths(x)) ** 2).sum()
    # near a pole rounding errors dominate any computation of the depth
    assert stereo_cost(pairs)(x) == pytest.approx(stereo, rel=1e-12 * max(1, np.abs(pairs.depths(x)).max()))
    epipolar = (pairs.weights * epipolar_residuals(x, pairs) ** 2).sum()
    assert epipolar_cost(pairs)(x) == pytest.approx(epipolar, rel=1e-12)


@given(seed=st.integers(0, 100_000))
@settings(max_examples=20)
def test_both_residuals_are_equivalent_for_small_errors(seed):
    # d Z / d disparity = -Z / disparity: a depth error is an epipolar residual seen through the disparity.
    matches, pose = exact_case(seed)
    pairs = StereoPairs.of(matches, WIDE)
    x = pairs.parameters(pose)
    assume(well_away_from_poles(pairs, x))
    shaken = x + 1e-7 * np.random.default_rng(seed).normal(size=6)
    e = epipolar_residuals(shaken, pairs)
    cos, sin = (x[0] + x[1]) / (np.sqrt(2) * np.hypot(x[0], x[1])), (x[0] - x[1]) / (np.sqrt(2) * np.hypot(x[0], x[1]))
    turn = np.array([[cos, -sin], [sin, cos]])
    rectified = (pairs.laser + x[:2, None] / pairs.depth) / (1 - x[2] / pairs.depth)
    predicted = pairs.depth * (turn @ e) / (turn @ (rectified - pairs.laser))
    assert pairs.depth - pairs.depths(shaken) == pytest.approx(predicted, rel=1e-2, abs=1e-9)


def test_the_cost_is_nan_without_baseline_and_finite_next_to_it():
    case = room_case(1)
    pairs = StereoPairs.of(case.matches, case.camera)
    x = pairs.parameters(case.pose)
    cost, valley = stereo_cost(pairs), 2 * (pairs.depth**2).sum()
    assert np.isnan(cost(np.array([0.0, 0.0, 0.1, *x[3:]])))
    assert not np.isfinite(pairs.depth_errors(np.array([0.0, 0.0, 0.1, *x[3:]]))).any()
    near = cost(np.array([1e-9, 1e-9, 0.0, *(x[3:] + 0.05)]))
    assert near == pytest.approx(valley, rel=1e-3)


def test_zero_disparity_is_infinitely_far_without_a_warning():
    rays = np.array([[1.0, 0.0, 0.0], [1.0, 0.1, 0.0]]) / np.sqrt([[1.0], [1.01]])
    pairs = StereoPairs.of(Matches(rays, np.full(2, 3.0), np.full((2, 2), (490.0, 405.0))), WIDE)
    with np.errstate(all="raise"):
        assert stereo_cost(pairs)(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])) > 1e200
        epipolar_cost(pairs)(np.array([0.3, 0.0, 0.0, np.pi / 2, 0.0, 0.0]))
    assert pairs.depth_errors(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))[0] == np.inf


def test_depth_is_along_the_scanner_s_x_if_the_matches_are_ahead():
    rng = np.random.default_rng(0)
    ahead = np.column_stack([np.ones(20), rng.uniform(-1, 1, (20, 2))])
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    assert (stereo_frame(ahead) == np.eye(3)).all()
    for turn in ([0, 0, 1.6], [0, 0, np.pi], [0, -1.5, 0.3], [0, np.pi / 2, 0]):
        aside = ahead @ rotation_from_rotvec(turn).T
        frame = stereo_frame(aside)
        assert frame @ frame.T == pytest.approx(np.eye(3))
        assert np.linalg.det(frame) == pytest.approx(1)
        assert (aside @ frame[0] > 0.5).all()
    around = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    assert (stereo_frame(around) == np.eye(3)).all()
    assert (stereo_frame(np.zeros((0, 3))) == np.eye(3)).all()


def test_matches_without_a_depth_are_marked():
    rays = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0.6, 0.8, 0]])
    uv = np.array([[490.0, 405.0]] * 3 + [[np.nan, 3.0]])
    pairs = StereoPairs.of(Matches(rays, np.ones(4), uv), WIDE, frame_from_scanner=np.eye(3))
    assert pairs.usable.tolist() == [True, False, False, False]
    errors = pairs.depth_errors(np.array([0.5, 0.1, 0.0, 0.1, 0.0, 0.0]))
    assert np.isfinite(errors).tolist() == [True, False, False, False]


@given(turn=rotvecs())
@settings(max_examples=25)
def test_the_diagnostics_do_not_depend_on_the_scanner_s_orientation(turn):
    # the roll may differ by up to three degrees, so that only lengths are compared
    case = room_case(7, baseline_m=1.0)
    R = rotation_from_rotvec(turn)
    aside = Matches(case.rays @ R.T, case.ranges, case.uv)
    frame = stereo_frame(aside.rays)
    assert (aside.rays @ frame[0] > 0.3).all()
    pose = case.pose @ Rigid(R.T, np.zeros(3))
    error = stereo_depth_error(pose, aside, case.camera, sigma_px=1.0)
    assert np.isfinite(error).mean() > 0.95
    assert np.nanmedian(np.abs(error)) < 0.1
    figures = diagnose(pose, aside, case.true, case.camera, sigma_px=1.0)
    assert figures["baseline_across_m"] == pytest.approx(1.0, abs=0.3)
    assert figures["disparity_median_px"] > 100
