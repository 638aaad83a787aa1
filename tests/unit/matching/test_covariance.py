"""The covariance of an aligned pose from the contributions of its blocks."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import pose_jacobian
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.matching.refine.covariance import RegionEvidence, _jackknife
from ladarreg_core.registration.register import register
from testing.scenes.unit_camera import simulate_unit_camera

CAMERA = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
ROWS, COLUMNS, SIGMA_PX = 9, 12, 0.3


def solved(rng: np.random.Generator, *, object_m: float, shift_px: float = 0.0) -> tuple[RegionEvidence, np.ndarray]:
    """Return the evidence of a solved pose, and its error (w, c); 3 x 3 blocks show an object that is shifted."""
    grid = np.stack(np.meshgrid(np.arange(ROWS), np.arange(COLUMNS), indexing="ij"), axis=-1).reshape(-1, 2)
    depth = rng.uniform(3.5, 5.0, len(grid))
    near = (abs(grid - [7, 2]) <= 1).all(axis=1)
    depth[near] = object_m
    points = CAMERA.unproject((grid[:, ::-1] + 0.5) * [640 / COLUMNS, 480 / ROWS]) * depth[:, None]
    _, J = pose_jacobian(Rigid.identity(), points, CAMERA)
    J = np.concatenate([J[..., :3], -J[..., 3:]], axis=-1)  # by the translation in place of the centre
    residual = rng.normal(0, SIGMA_PX, (len(grid), 2)) + near[:, None] * [0.0, shift_px]
    H, g = np.einsum("nip,niq->npq", J, J), np.einsum("nip,ni->np", J, residual)
    step = np.linalg.solve(H.sum(axis=0), g.sum(axis=0))
    g = np.einsum("nip,ni->np", J, residual - np.einsum("nip,p->ni", J, step))
    found = _jackknife(H, g, np.zeros(len(grid), np.intp), grid, Rigid.identity(), None)
    assert found is not None
    return found, np.concatenate([step[:3], -step[3:]])


def test_an_object_that_fits_elsewhere_widens_the_covariance_by_what_it_pulls() -> None:
    widened, distances, without = 0, [], []
    for seed in range(30):
        found, error = solved(np.random.default_rng([seed, 1]), object_m=1.5, shift_px=15.0)
        widened += found.by_object is not None
        distances.append(error @ np.linalg.solve(found.pose_covariance, error) / 6)
        without.append(error @ np.linalg.solve(1.5 * found.covariance, error) / 6)
    assert widened == 30
    assert np.sqrt(np.mean(without)) > 2, "the jackknife alone does not see it"
    assert np.sqrt(np.max(distances)) < 1


def test_blocks_that_agree_pull_nothing() -> None:
    for object_m, most in ((4.0, 4), (1.5, 100)):  # the near one determines the pose by itself: that is said, too
        evidence = [solved(np.random.default_rng([seed, 2]), object_m=object_m) for seed in range(200)]
        assert sum(found.by_object is not None for found, _ in evidence) <= most
        squared = [error @ np.linalg.solve(found.pose_covariance, error) / 6 for found, error in evidence]
        assert 0.5 < np.sqrt(np.mean(squared)) < 1.3


@pytest.mark.long
def test_a_striped_chair_that_is_one_stripe_off_makes_a_pose_uncertain() -> None:
    pytest.importorskip("embreex")
    case = simulate_unit_camera(9104)
    true = (case.units[2] @ case.mount).inverse
    found = register(case.panorama, case.photos[2], initial=true)
    pose = found.camera_from_scanner
    turn = rotvec_from_rotation(true.rotation @ pose.rotation.T)
    error = np.concatenate([turn, true.centre - pose.centre])
    assert not found.accepted or np.sqrt(error @ np.linalg.solve(found.covariance, error) / 6) < 2.5  # was 5.7
