"""A camera pooled over photographs: by simulated estimates whose truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ladarreg_core.batches.photos.pooled_camera import (
    CameraEstimate,
    PooledCamera,
    camera_estimate,
    pool,
    with_pooled_camera,
)
from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import INTRINSICS, CameraUncertainty
from testing.scenes.small_registration import sample_registration

TRUTH = np.array([980.0, -0.02, 4.0, -6.0])
STATED = np.array([1000.0, 0.0, 0.0, 0.0])
PRIOR = np.array([30.0, 0.05, 11.0, 11.0])
SIGMA = np.array([4.0, 0.01, 3.0, 5.0])
ZOOM = np.array([60.0, 0.0, 0.0, 0.0])


def estimate(name: str, rng: np.random.Generator, truth: NDArray[np.float64] = TRUTH) -> CameraEstimate:
    """Return what a photograph with correlated measurements of the camera says of it, beside the prior."""
    mixed = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    covariance = np.diag(SIGMA) @ (mixed * rng.uniform(0.5, 1.5, 4)) @ mixed.T @ np.diag(SIGMA)
    measured = rng.multivariate_normal(truth, covariance)
    H = np.linalg.inv(covariance)
    values = np.linalg.solve(H + np.diag(PRIOR**-2), H @ measured + PRIOR**-2 * STATED)
    return CameraEstimate(name, values, H, H @ measured, STATED, PRIOR)


def some(count: int, seed: int = 0) -> list[CameraEstimate]:
    rng = np.random.default_rng(seed)
    return [estimate(f"p{number}", rng) for number in range(count)]


def pooled(estimates: Sequence[CameraEstimate]) -> PooledCamera:
    found = pool(estimates)
    assert found is not None
    return found


def test_the_pool_is_right_within_its_sigma_and_the_prior_counts_once() -> None:
    distances = []
    for seed in range(60):
        found = pooled(some(6, seed))
        off = found.values - TRUTH
        distances.append(float(off @ np.linalg.solve(found.covariance, off)) / 4)
    assert 0.5 < np.mean(distances) < 1.1, "it is stated a little wider, for what the estimates have in common"
    alone = some(2)
    exact = np.linalg.inv(sum(one.information for one in alone) + np.diag(PRIOR**-2))
    assert np.all(np.diag(pooled(alone).covariance) >= np.diag(exact))
    np.testing.assert_allclose(pooled(alone).covariance, 1.08 * exact)


def test_more_photographs_know_the_camera_better() -> None:
    sigmas = [pooled(some(count)).sigmas["focal_px"] for count in (2, 4, 8)]
    assert sigmas[0] > sigmas[1] > sigmas[2]


@pytest.mark.parametrize("number", [0, 2, 5])
def test_a_photograph_of_another_camera_is_named_and_changes_nothing(number: int) -> None:
    right = some(5)
    other = estimate("other", np.random.default_rng(9), TRUTH + ZOOM)
    found, without = pooled([*right[:number], other, *right[number:]]), pooled(right)
    assert found.disagreeing == ("other",)
    np.testing.assert_array_equal(found.values, without.values)
    np.testing.assert_array_equal(found.covariance, without.covariance)


def test_there_is_no_pool_of_less_than_two_or_of_two_halves() -> None:
    rng = np.random.default_rng(5)
    others = [estimate(f"other {number}", rng, TRUTH + ZOOM) for number in range(2)]
    assert pool([]) is None
    assert pool(some(1)) is None
    assert pool([*some(1), others[0]]) is None
    assert pool([*some(2), *others]) is None


def test_an_estimate_survives_its_file() -> None:
    one = replace(some(1)[0], prior=np.array([np.inf, 0.05, 11, 11]))
    again = CameraEstimate.from_fields(one.as_fields())
    for name in ("values", "information", "weighted", "stated", "prior"):
        np.testing.assert_array_equal(getattr(again, name), getattr(one, name))


def test_photographs_agree_on_the_camera_however_it_was_held() -> None:
    values = np.array([980.0, -0.02, 4.0, -6.0])
    sigma = np.array([4.0, 0.01, 3.0, 5.0])
    found = PooledCamera(values, np.diag(sigma**2), ("a", "b"), ())
    size = {1: (120, 90), 3: (120, 90), 6: (90, 120), 8: (90, 120)}
    u, v = 31.0, 17.0  # of the pixels as stored
    turned = {1: (u, v), 3: (119 - u, 89 - v), 6: (89 - v, u), 8: (v, 119 - u)}
    upright = {orientation: found.camera(*size[orientation], orientation) for orientation in size}
    rays = {o: camera.unproject(np.array([turned[o]]))[0] for o, camera in upright.items()}
    for orientation, ray in rays.items():
        assert ray[2] == pytest.approx(rays[1][2], abs=1e-12)
        assert np.linalg.norm(ray[:2]) == pytest.approx(np.linalg.norm(rays[1][:2]), abs=1e-12)
        result = replace(
            sample_registration(), camera=upright[orientation], camera_uncertainty=_uncertainty(found, orientation)
        )
        back = camera_estimate("a", result, orientation)
        assert back is not None
        np.testing.assert_allclose(back.values, values, atol=1e-9)


def _uncertainty(found: PooledCamera, orientation: int) -> CameraUncertainty:
    joint = np.diag([1e-6] * 10)
    joint[6:, 6:] = found.covariance_of(orientation)
    return CameraUncertainty(INTRINSICS, joint, dict(zip(INTRINSICS, (1000, 0, 59.5, 44.5), strict=True)), {})


def test_the_uncertainty_of_the_camera_is_in_the_pose() -> None:
    found = PooledCamera(TRUTH, np.diag(SIGMA**2), ("a", "b"), ())
    camera = found.camera(120, 90, 1)
    result = replace(sample_registration(), camera=camera)
    rng = np.random.default_rng(3)
    pixels = rng.uniform((5, 5), (115, 85), (40, 2))
    rays = camera.unproject(pixels) @ result.camera_from_scanner.rotation
    depth = rng.uniform(2, 5, 40)
    points = result.camera_from_scanner.centre + depth[:, None] * rays
    ranges = np.linalg.norm(points, axis=1)
    matches = type(result.matches)(points / ranges[:, None], ranges, pixels, [f"m{k}" for k in range(40)])
    count = np.zeros(40)
    result = replace(
        result, matches=matches, inliers=np.ones(40, bool), residuals_px=np.zeros((40, 2)), residuals_m=count,
        stereo_depth_error_m=count,
    )  # fmt: skip
    seen = with_pooled_camera(result, found, 1)
    assert isinstance(seen.camera, Camera)
    added = seen.covariance - result.covariance
    assert np.linalg.eigvalsh(added).min() > -1e-12
    assert seen.sigma_position_m > 2 * result.sigma_position_m
    assert seen.camera_sigmas == pytest.approx(dict(zip(INTRINSICS, SIGMA, strict=True)))
    assert seen.camera_uncertainty is not None
    np.testing.assert_array_equal(seen.camera_from_scanner.matrix, result.camera_from_scanner.matrix)


def test_what_was_refused_or_calibrated_says_nothing_of_a_camera() -> None:
    assert camera_estimate("a", sample_registration(), 1) is None
    assert camera_estimate("a", sample_registration(accepted=False), 1) is None
