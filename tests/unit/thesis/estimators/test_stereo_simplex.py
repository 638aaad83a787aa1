"""The simplex with outlier rejection: poor starting poses, outliers, zero baseline, and the verdict on its result."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimate import PoseOptions, estimate_pose, solve_pose
from ladarreg_core.thesis.estimators.nelder_mead import SimplexStep
from ladarreg_core.thesis.estimators.stereo import StereoPairs, stereo_cost
from ladarreg_core.thesis.estimators.stereo_simplex import SimplexOptions, descend, fit_simplex
from testing.scenes.accuracy import default
from testing.scenes.apple import THESIS_START, apple_case
from testing.scenes.pose_case import Case, difference, picture_difference_px, start_near
from testing.scenes.room import room_case

METHODS = ("stereo_simplex", "epipolar_simplex")
BESIDE = (0.1, 1.0, 0.2)


def watched(case: Case, options: SimplexOptions | None = None, initial: Rigid | None = None):
    """Return all steps and the fit."""
    steps, walk = [], descend(case.matches, case.camera, options, initial=initial, sigma_px=case.sigma_px)
    while True:
        try:
            steps.append(next(walk))
        except StopIteration as end:
            return steps, end.value


def solve(case: Case, method: str, *, initial: Rigid | None = None, **simplex):
    options = PoseOptions(
        method=method, sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m, simplex=SimplexOptions(**simplex)
    )
    return solve_pose(case.matches, case.camera, options, initial=initial)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_it_finds_the_pose_with_a_consistent_covariance(method, outliers):
    distances, wrong_kept = [], 0
    for seed in range(100, 108):
        case = room_case(seed, count=120, outliers=outliers, baseline_m=0.7, direction=BESIDE)
        result = solve(case, method)
        assert result.accepted, result.reasons
        assert result.evidence == "statistics"
        step = difference(case.pose, result.camera_from_scanner)
        assert np.linalg.norm(step[3:]) < 0.03
        distances.append(step @ np.linalg.solve(result.covariance, step) / 6)
        wrong_kept += int((result.inliers & ~case.true).sum())
        assert result.inliers[case.true].mean() > 0.8
    assert 0.5 < np.sqrt(np.mean(distances)) < 1.7  # chi-squared with 48 degrees of freedom keeps within .72 to 1.26
    assert wrong_kept <= 2


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_it_converges_from_poor_starting_poses(method):
    for seed in range(200, 202):
        case = room_case(seed, count=100, direction=BESIDE)
        for start in (start_near(case, seed, 10, 0.5), start_near(case, seed, 30, 1.5), THESIS_START):
            result = solve(case, method, initial=start)
            assert result.camera_from_scanner.distance_to(case.pose) < 0.03
            assert result.diagnostics["start"] in ("given", "linear", "aimed")


@pytest.mark.slow
def test_the_thesis_s_single_descent_may_collapse_and_reports_it():
    collapsed = 0
    for seed in range(300, 306):
        case = room_case(seed, count=60, baseline_m=0.3)
        start = Rigid.from_centre(rotation_from_rotvec([0, 0.1, 0]) @ case.pose.rotation, [0.0, 0.01, 0.003])
        result = solve(case, "stereo_simplex", initial=start, restarts=0, reject_rounds=0, step_m=0.01)
        if result.diagnostics["collapsed"]:
            collapsed += 1
            assert not result.accepted
            assert "collapsed" in result.reasons[0]
        restarted = solve(case, "stereo_simplex", initial=start, step_m=0.01)
        assert not restarted.diagnostics["collapsed"]
        assert restarted.camera_from_scanner.distance_to(case.pose) < 0.05
    assert collapsed >= 3


def test_without_baseline_only_the_epipolar_residual_works():
    for seed in range(400, 402):
        case = room_case(seed, count=150, baseline_m=0.0)
        epipolar = solve(case, "epipolar_simplex")
        assert epipolar.accepted
        assert epipolar.camera_from_scanner.distance_to(case.pose) < 0.01
        assert epipolar.diagnostics["rejected_by"] == "pixel residual"
        asked = solve(case, "epipolar_simplex", reject_depth_m=0.1)
        assert asked.diagnostics["rejected_by"] == "pixel residual"  # depths are meaningless without baseline
        assert not solve(case, "stereo_simplex").accepted
    beside = solve(room_case(400, direction=BESIDE), "epipolar_simplex", reject_depth_m=1.0)
    assert beside.diagnostics["rejected_by"] == "depth error"


def test_good_matches_give_nearly_the_default_s_pose():
    for seed in range(500, 504):
        case = room_case(seed, count=150, sigma_px=0.3, sigma_range_m=0.005, baseline_m=0.6, direction=BESIDE)
        best = default(case)[0]
        for method in METHODS:
            assert picture_difference_px(case, solve(case, method).camera_from_scanner, best) < 0.15


def test_every_step_is_yielded():
    case = room_case(3, count=60, outliers=0.1, direction=BESIDE)
    options = SimplexOptions(reject_depth_m=0.3, step_m=0.2)
    steps, fit = watched(case, options, THESIS_START)
    assert all(isinstance(step.simplex, SimplexStep) for step in steps)
    assert {step.residual for step in steps} == {"stereo", "epipolar"}  # doubtful from this distance, hence a restart
    assert steps[0].round == steps[0].restart == 0
    assert steps[-1].restart == fit.restarts
    assert steps[0].inliers.all()
    assert sum(step.simplex.move == "start" for step in steps) >= 3
    assert steps[0].camera_from_scanner.matrix == pytest.approx(
        StereoPairs.of(case.matches, case.camera).pose(steps[0].simplex.best).matrix
    )
    first = stereo_cost(StereoPairs.of(case.matches, case.camera))
    assert steps[0].simplex.costs.tolist() == [first(v) for v in steps[0].simplex.vertices]
    assert fit.iterations == sum(
        b.simplex.iteration
        for b, c in zip(steps, [*steps[1:], None], strict=True)
        if c is None or c.simplex.move == "start"
    )
    assert fit_simplex(case.matches, case.camera, options, initial=THESIS_START).after.camera_from_scanner.matrix == (
        pytest.approx(fit.after.camera_from_scanner.matrix, abs=0)
    )


def test_rejection_is_by_the_thesis_s_depth_error():
    case = apple_case("B", 901)
    fit = fit_simplex(case.matches, case.camera, SimplexOptions(reject_depth_m=0.5), initial=THESIS_START)
    assert fit.before.inliers.all()
    assert fit.stopped == "settled"
    assert fit.rounds >= 1
    assert fit.threshold == 0.5
    pairs = StereoPairs.of(case.matches, case.camera)
    zx, zy = pairs.depths(pairs.parameters(fit.after.camera_from_scanner))
    error = np.sqrt((pairs.depth - zx) ** 2 + (pairs.depth - zy) ** 2)
    assert (fit.after.inliers == (error <= 0.5)).all()
    kept = pairs.subset(fit.after.inliers)
    assert fit.after.cost == pytest.approx(stereo_cost(kept)(pairs.parameters(fit.after.camera_from_scanner)))
    assert f"{fit.after.inliers.sum()} of 208 inliers by depth error" in fit.describe()
    one = fit_simplex(case.matches, case.camera, SimplexOptions(reject_rounds=0), initial=THESIS_START)
    assert one.after.camera_from_scanner.matrix == pytest.approx(fit.before.camera_from_scanner.matrix, abs=1e-9)


def test_it_stops_at_the_stop_cost():
    case = room_case(5, count=60, direction=BESIDE)
    full, short = (
        fit_simplex(case.matches, case.camera, SimplexOptions(stop_cost=cost, reject_rounds=0), initial=case.pose)
        for cost in (None, 1e3)
    )
    assert short.evaluations < full.evaluations
    assert full.before.cost < short.before.cost <= 1e3


@pytest.mark.parametrize("method", METHODS)
def test_a_scan_to_the_side_is_solved_as_well(method):
    case = room_case(8, count=100, direction=BESIDE)
    for turn in ([0, 0, np.pi / 2], [0, 0, np.pi], [0, 1.3, 0.4]):
        R = rotation_from_rotvec(turn)
        result = estimate_pose(case.rays @ R.T, case.ranges, case.uv, case.camera, method=method)
        assert result.accepted, result.reasons
        assert (result.camera_from_scanner @ Rigid(R, np.zeros(3))).distance_to(case.pose) < 0.03


@pytest.mark.parametrize("method", METHODS)
def test_a_wall_starts_from_an_aimed_camera_instead_of_the_linear_pose(method):
    rng = np.random.default_rng(4)
    points = np.column_stack([np.full(80, 4.0), *rng.uniform(-1.2, 1.2, (2, 80))])
    for roll in (0.0, 2.0, np.pi):
        turn = rotation_from_rotvec([0, 0, roll]) @ rotation_from_rotvec([0.05, -0.15, 0]) @ CAMERA_AXES_FROM_SCANNER
        pose = Rigid.from_centre(turn, [0.1, 0.8, 0.2])
        camera = room_case(0).camera
        uv = camera.project(pose @ points) + rng.normal(size=(80, 2)) * 0.3
        ranges = np.linalg.norm(points, axis=1)
        result = estimate_pose(
            points / ranges[:, None], ranges, uv, camera, method=method, sigma_px=0.3, sigma_range_m=0.003
        )
        assert result.diagnostics["start"] == "aimed"
        assert result.camera_from_scanner.distance_to(pose) < 0.05


@given(scale=st.sampled_from([1e-2, 1e2]), method=st.sampled_from(METHODS))
@settings(max_examples=4)
def test_it_works_at_any_scale(scale, method):
    case = room_case(11, count=60, direction=BESIDE)
    result = estimate_pose(
        case.rays, case.ranges * scale, case.uv, case.camera, method=method, sigma_px=1.0, sigma_range_m=0.015 * scale
    )
    assert result.camera_from_scanner.centre / scale == pytest.approx(case.pose.centre, abs=0.03)


def test_a_weight_multiplies_squared_residuals():
    case = room_case(12, count=50, direction=BESIDE)
    heavy = Matches(
        np.r_[case.rays, case.rays[:10]], np.r_[case.ranges, case.ranges[:10]], np.r_[case.uv, case.uv[:10]]
    )
    weighed = Matches(case.rays, case.ranges, case.uv, weights=np.r_[np.full(10, 2.0), np.ones(40)])
    for residual in ("stereo", "epipolar"):
        options = SimplexOptions(residual=residual, reject_rounds=0)
        a, b = (fit_simplex(m, case.camera, options, initial=case.pose).before for m in (heavy, weighed))
        assert a.cost == pytest.approx(b.cost, rel=1e-9)
        assert a.camera_from_scanner.matrix == pytest.approx(b.camera_from_scanner.matrix, abs=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_its_diagnostics_are_json_and_repeatable(method):
    case = room_case(13, count=60, outliers=0.1)
    a, b = solve(case, method), solve(case, method)
    assert json.loads(json.dumps(a.diagnostics)) == json.loads(json.dumps(b.diagnostics))
    assert {"start", "rounds", "iterations", "evaluations", "collapsed", "stopped"} <= set(a.diagnostics)
    assert np.array(a.diagnostics["before_rejection"]).shape == (4, 4)
    assert (a.camera_from_scanner.matrix == b.camera_from_scanner.matrix).all()


@pytest.mark.parametrize("method", METHODS)
def test_unstated_noise_is_estimated_from_the_inliers(method):
    case = room_case(14, sigma_px=0.4, sigma_range_m=0.004, baseline_m=1.0, direction=BESIDE)
    result = estimate_pose(case.rays, case.ranges, case.uv, case.camera, method=method)
    assert result.sigma_px == pytest.approx(0.4, rel=0.35)
    assert result.accepted


@pytest.mark.slow
@given(seed=st.integers(0, 10_000), count=st.integers(4, 9), method=st.sampled_from(METHODS))
@settings(max_examples=12)
def test_random_matches_are_never_accepted(seed, count, method):
    rng = np.random.default_rng(seed)
    rays = rng.normal(size=(count, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    camera = room_case(0).camera
    try:
        result = estimate_pose(
            rays, rng.uniform(0.1, 100, count), rng.uniform(0, 500, (count, 2)), camera, method=method
        )
    except DegenerateGeometryError:
        return
    assert not result.accepted
    assert np.isfinite(result.covariance).all()
    assert np.isfinite(result.camera_from_scanner.matrix).all()


def test_invalid_options_are_refused():
    for bad in (
        {"residual": "median"}, {"step_m": 0.0}, {"step_rad": -1.0}, {"tolerance": np.nan}, {"reject_depth_m": "far"},
        {"reject_sigma": None}, {"restarts": -1}, {"most_iterations": 0}, {"reject_rounds": 1.5}, {"stop_cost": True},
    ):  # fmt: skip
        with pytest.raises(OptionError):
            SimplexOptions(**bad)
    case = room_case(0, count=20)
    for sigma in (0.0, np.nan, "1"):
        with pytest.raises(OptionError, match="sigma_px"):
            descend(case.matches, case.camera, sigma_px=sigma)
    with pytest.raises(DegenerateGeometryError, match="in front"):
        fit_simplex(case.matches.subset([0, 1]), case.camera)
    with pytest.raises(OptionError, match="epipolar_simplex"):
        estimate_pose(case.rays, case.ranges, case.uv, case.camera, method="simplex")
