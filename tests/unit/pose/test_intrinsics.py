from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import f, norm

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.estimators.intrinsics import Descent, estimate_intrinsics, predicted_gains
from ladarreg_core.pose.estimators.unknown_intrinsics import PARAMETERS, intrinsic
from testing.scenes.pose_case import difference
from testing.scenes.room import ROOM_CAMERA, room_case

SIGMA = {"sigma_px": 1.0, "sigma_range_m": 0.015}
LENSES = {
    0: (),
    4: (-0.12, 0.05, 0.001, -0.002),
    5: (-0.12, 0.05, 0.001, -0.002, 0.01),
    8: (0.35, -0.1, 0.001, -0.002, 0.02, 0.4, -0.05, 0.01),
}


def scaled(camera, factor):
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def with_k1(camera, k1):
    return replace(camera, distortion=(k1, *(camera.distortion or (0.0,) * 4)[1:]))


def fitted(case, given, intrinsics, **options):
    result = solve_pose(case.matches, given, PoseOptions(intrinsics="fixed", **SIGMA))
    return estimate_intrinsics(case.matches, given, result.camera_from_scanner, intrinsics, **SIGMA, **options)


@settings(max_examples=40)
@given(
    terms=st.sampled_from(sorted(LENSES)),
    x=st.floats(-0.4, 0.4),
    y=st.floats(-0.3, 0.3),
    fy=st.floats(700, 1200),
)
def test_the_derivatives_by_intrinsics_are_those_of_the_projection(terms, x, y, fy):
    camera = Camera(768, 512, 974.0, fy, 380.0, 250.0, LENSES[terms])
    point, step = np.array([x, y, 1.0]), 1e-5
    ways = (
        lambda d: scaled(camera, np.exp(d)),
        lambda d: with_k1(camera, (camera.distortion or (0.0,))[0] + d),
        lambda d: replace(camera, cx=camera.cx + d),
        lambda d: replace(camera, cy=camera.cy + d),
    )
    expected = [(way(step).project(point) - way(-step).project(point)) / (2 * step) for way in ways]
    np.testing.assert_allclose(camera.intrinsics_jacobian([x, y]), np.transpose(expected), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("terms", sorted(LENSES))
def test_every_intrinsic_is_found_exactly_without_noise(terms):
    true = replace(ROOM_CAMERA, distortion=LENSES[terms])
    case = room_case(5, count=120, sigma_px=0.0, sigma_range_m=0.0, camera=true)
    given = with_k1(replace(scaled(true, 1.05), cx=true.cx + 9, cy=true.cy - 6), intrinsic(true, "k1") + 0.06)
    start = Rigid.from_centre(rotation_from_rotvec([0.01, 0.01, -0.01]) @ case.pose.rotation, case.pose.centre + 0.03)
    fit = estimate_intrinsics(case.matches, given, start, "focal_k1_centre", **SIGMA)
    assert fit.settled
    assert fit.inliers.all()
    for name in PARAMETERS["focal_k1_centre"]:
        assert fit.values[name] == pytest.approx(intrinsic(true, name), abs=1e-2 * fit.sigmas[name])
    assert fit.pose.distance_to(case.pose) < 1e-4
    assert len(fit.camera.distortion) == max(terms, 4)
    assert fit.camera.distortion[1:] == (LENSES[terms] or (0.0,) * 4)[1:]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("intrinsics", "k1", "shift"), [("focal", 0.0, 0.0), ("focal_k1", -0.1, 0.0), ("focal_k1_centre", -0.1, 12.0)]
)
def test_errors_agree_with_the_covariance(intrinsics, k1, shift):
    """The mean squared Mahalanobis distance of n fits is 1 +- sqrt(2 / (P n)), regardless of outliers."""
    true = with_k1(replace(ROOM_CAMERA, cx=ROOM_CAMERA.cx + shift), k1)
    distances = []
    for seed in range(900, 915):
        case = room_case(seed, count=120, outliers=0.3, camera=true)
        fit = fitted(case, scaled(ROOM_CAMERA, 0.97), intrinsics)
        error = [intrinsic(true, name) - value for name, value in fit.values.items()]
        step = np.concatenate([difference(case.pose, fit.pose), error])
        distances.append(step @ np.linalg.solve(fit.covariance, step) / len(step))
        assert abs(error[0]) < 4 * fit.sigmas["focal_px"]
        assert np.mean(fit.inliers == case.true) > 0.95
    spread = np.sqrt(2 / len(step) / len(distances))
    assert 1 - 4 * spread < np.mean(distances) < 1 + 5 * spread  # a few outliers close to the gate are included


@settings(max_examples=6)
@given(seed=st.integers(0, 10_000), factor=st.floats(0.85, 1.18))
def test_the_result_does_not_depend_on_the_given_focal_length(seed, factor):
    case = room_case(seed, count=80, outliers=0.2)
    fits = [fitted(case, scaled(ROOM_CAMERA, by), "focal") for by in (1.0, factor)]
    sigma = fits[0].sigmas["focal_px"]
    assert fits[1].camera.focal_px == pytest.approx(fits[0].camera.focal_px, abs=0.5 * sigma)
    assert (fits[0].inliers != fits[1].inliers).sum() <= 2


def test_fixed_is_the_pose_alone():
    case = room_case(8, outliers=0.2)
    result = solve_pose(case.matches, case.camera, PoseOptions(intrinsics="fixed", **SIGMA))
    fit = fitted(case, case.camera, "fixed")
    assert fit.camera == case.camera
    assert fit.values == fit.sigmas == {}
    assert (fit.inliers == result.inliers).all()
    np.testing.assert_allclose(fit.covariance, result.covariance, rtol=1e-2)
    assert fit.chi2_per_dof == pytest.approx(result.chi2_per_dof, rel=1e-3)


def test_the_noise_is_estimated_again():
    """A wrong focal length makes the noise appear twice as large."""
    case = room_case(13, outliers=0.2)
    given = scaled(ROOM_CAMERA, 1.03)
    result = solve_pose(case.matches, given, PoseOptions(intrinsics="fixed"))
    calls = []

    def noise(pose, camera, inliers):
        calls.append(camera)
        return solve_pose(case.matches, camera, PoseOptions(intrinsics="fixed"), initial=pose).sigma_px, 0.015

    fit = estimate_intrinsics(
        case.matches, given, result.camera_from_scanner, "focal",
        sigma_px=result.sigma_px, sigma_range_m=result.sigma_range_m, noise=noise,
    )  # fmt: skip
    assert 1 <= len(calls) <= 3
    assert result.sigma_px > 1.3
    assert fit.sigma_px == pytest.approx(1.0, rel=0.15)
    assert abs(fit.camera.focal_px - 974) < 3.5 * fit.sigmas["focal_px"]


def test_a_wall_seen_face_on_does_not_determine_the_focal_length():
    rng = np.random.default_rng(4)
    points = np.column_stack([np.full(60, 4.0), rng.uniform(-1, 1, 60), rng.uniform(-0.8, 0.8, 60)])
    pose = Rigid(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.3, 0.0, 0.0]))
    ranges = np.linalg.norm(points, axis=1)
    uv = ROOM_CAMERA.project(pose @ points) + rng.normal(size=(60, 2))
    matches = Matches(points / ranges[:, None], ranges, uv)
    fit = estimate_intrinsics(matches, ROOM_CAMERA, pose, "focal", **SIGMA)
    assert not fit.determined
    assert np.isfinite(fit.covariance).all()
    room = room_case(4, count=60)
    assert estimate_intrinsics(room.matches, ROOM_CAMERA, room.pose, "focal", **SIGMA).determined


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), count=st.integers(4, 9), intrinsics=st.sampled_from(list(PARAMETERS)))
def test_random_pixels_give_a_plausible_camera(seed, count, intrinsics):
    """Without a solution, the result is still a camera whose lens covers its image."""
    case = room_case(seed, count=count, outliers=1.0)
    fit = estimate_intrinsics(case.matches, ROOM_CAMERA, case.pose, intrinsics, **SIGMA)
    assert 97 <= fit.camera.focal_px <= 9740
    assert fit.camera.contains([fit.camera.cx, fit.camera.cy])
    corners = np.array([[0.0, 0.0], [767.0, 0.0], [0.0, 511.0], [767.0, 511.0]])
    assert np.isfinite(fit.camera.unproject(corners)).all()
    assert np.isfinite(fit.covariance).all()
    assert np.isfinite(fit.s).all()


@pytest.mark.parametrize("seed", [17, 18, 19])
def test_the_score_test_predicts_the_gain_of_the_fit(seed):
    """Compared with the exact quantile of F for the decrease of chi-squared, within the error of Paulson's formula."""
    case = room_case(seed, count=120)
    everyone = np.ones(120, dtype=np.bool_)
    given = scaled(ROOM_CAMERA, 1.005)
    descents = [Descent.start(case.matches, given, case.pose, count, **SIGMA) for count in (0, 1)]
    for descent in descents:
        descent.least_squares(everyone)
    fixed, free = (descent.residuals.s[0].sum() for descent in descents)
    exact = norm.isf(f.sf((fixed - free) / (free / (240 - 7)), 1, 240 - 7))
    assert predicted_gains(descents[0], everyone, (1, 2))[0] == pytest.approx(exact, rel=0.05)
    right = Descent.start(case.matches, descents[1].camera, descents[1].state.pose(), 0, **SIGMA)
    right.least_squares(everyone)
    assert predicted_gains(right, everyone, (1,))[0] < 0
