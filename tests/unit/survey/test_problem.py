"""The derivatives of a survey's residuals against differences, and its solver against a peer and against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.survey.least_squares.problem import (
    CameraUnknowns,
    PhotoView,
    Problem,
    RelativePose,
    Ties,
    moved_pose,
    relative_residual,
    surface_residuals,
    tie_residuals,
)
from ladarreg_core.survey.least_squares.solver import solve

CAMERA = Camera(640, 480, 520.0, 520.0, 322.0, 236.0, (-0.08, 0.01, 0.0, 0.0))
_PIXEL, _RANGE = 0.5, 0.003


def room(seed: int, *, photos: int = 5, points: int = 160, noise: float = 1.0) -> tuple[Problem, Problem]:
    """Return a problem at the truth, and the same with noise in all that is known, at a start beside it.

    A scanner stands in the middle of a box; photographs look at its walls, each pose known relative to the scanner to a
    centimetre by its image.
    """
    rng = np.random.default_rng([seed, 17])
    walls = rng.uniform([-3, 2.5, -1], [3, 3.5, 1.5], (points, 3))
    walls[:, 1] = np.where(rng.random(points) < 0.5, 3.0, 2.6)  # two parallel sheets
    walls[: points // 3, 1] = walls[: points // 3, 1] - 0.4 * walls[: points // 3, 0]  # and a slanted one
    normal = np.tile([0.0, -1.0, 0.0], (points, 1))
    normal[: points // 3] = np.array([-0.4, -1.0, 0.0]) / np.hypot(0.4, 1.0)
    scanner = Rigid.from_rotvec([0.0, 0.0, 0.4], [0.1, -0.2, 0.05])
    poses, seen = [scanner], []
    for k in range(photos):
        centre = np.array([rng.uniform(-1.2, 1.2), rng.uniform(-0.8, 0.4), rng.uniform(-0.3, 0.3)])
        poses.append(Rigid.from_centre(look_along(np.array([0.0, 3.0, 0.1]) - 0.6 * centre), centre))
        uv = CAMERA.project(poses[-1] @ walls)
        seen += [(k + 1, j) for j in np.flatnonzero(CAMERA.contains(uv)).tolist()]
    photo, point = np.array(seen).T
    kept = np.bincount(point, minlength=points)[point] >= 2
    photo, point = photo[kept], point[kept]
    middle = np.array([0.0, 0.0, (CAMERA.width - 1) / 2, (CAMERA.height - 1) / 2])
    values = np.array([CAMERA.focal_px, CAMERA.distortion[0], CAMERA.cx, CAMERA.cy]) - middle
    prior = np.diag(np.array([5.0, 0.02, 4.0, 4.0]) ** 2)
    views = (None, *(PhotoView(0, np.eye(4), middle, CAMERA) for _ in range(photos)))
    truth = Problem(
        tuple(poses), np.array([True, *[False] * photos]), views,
        (CameraUnknowns(CAMERA, values, values, prior),), (),
        Ties(
            walls, point, photo, np.zeros((len(point), 2)), np.arange(points), np.zeros(points, int),
            scanner @ walls, normal @ scanner.rotation.T, np.full(points, _RANGE),
            np.full(len(point), np.nan), np.full(points, -1),
        ),
    )  # fmt: skip
    exact = -tie_residuals(truth)[0]
    uv = exact + noise * rng.normal(0, _PIXEL, exact.shape)
    across = noise * rng.normal(0, _RANGE, points)
    covariance = np.diag([0.004**2] * 3 + [0.01**2] * 3)
    known, start = [], [scanner]
    for k in range(1, photos + 1):
        off = noise * rng.normal(0, 1, 6) * np.sqrt(np.diag(covariance))
        relative = poses[k] @ scanner.inverse
        known.append(RelativePose(k, 0, moved_pose(relative, off), covariance))
        start.append(moved_pose(poses[k], rng.normal(0, 1, 6) * np.array([0.01] * 3 + [0.03] * 3)))
    wrong = values + noise * rng.normal(0, 1, 4) * np.sqrt(np.diag(prior))
    measured = replace(
        truth, poses=tuple(start), relative=tuple(known),
        cameras=(replace(truth.cameras[0], values=wrong, prior=wrong),),
        ties=replace(
            truth.ties, uv=uv, xyz=truth.ties.xyz + across[:, None] * truth.ties.normal,
            points=walls + rng.normal(0, 0.02, walls.shape),
        ),
    )  # fmt: skip
    return truth, measured


def test_derivatives_of_ties_are_those_of_differences() -> None:
    _, problem = room(1)
    _, by_pose, by_camera, by_point = tie_residuals(problem)
    of_body, of_camera, size = problem.columns
    for body in (1, 3):
        rows = problem.ties.photo == body
        for column in range(6):
            found = _difference(problem, size, of_body[body] + column)
            np.testing.assert_allclose(by_pose[rows, :, column], found[rows], rtol=1e-5, atol=1e-3)
    for column in range(4):
        found = _difference(problem, size, of_camera[0] + column)
        np.testing.assert_allclose(by_camera[:, :, column], found, rtol=1e-5, atol=1e-3)
    for column in range(3):
        step = np.zeros_like(problem.ties.points)
        step[:, column] = 1e-6
        ahead, back = (tie_residuals(problem.moved(np.zeros(size), sign * step))[0] for sign in (1, -1))
        np.testing.assert_allclose(by_point[:, :, column], (back - ahead) / 2e-6, rtol=1e-5, atol=1e-3)


def test_derivatives_of_surfaces_are_those_of_differences() -> None:
    _, problem = room(2)
    problem = replace(problem, fixed=np.zeros(len(problem.poses), bool))
    _, by_scan, by_point = surface_residuals(problem)
    of_body, _, size = problem.columns
    for column in range(6):
        step = np.zeros(size)
        step[of_body[0] + column] = 1e-6
        ahead, back = (surface_residuals(problem.moved(s * step, np.zeros((1, 3))))[0] for s in (1, -1))
        np.testing.assert_allclose(by_scan[:, column], (ahead - back) / 2e-6, rtol=1e-5, atol=1e-6)
    for column in range(3):
        step = np.zeros_like(problem.ties.points)
        step[:, column] = 1e-6
        ahead, back = (surface_residuals(problem.moved(np.zeros(size), s * step))[0] for s in (1, -1))
        np.testing.assert_allclose(by_point[:, column], (ahead - back) / 2e-6, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("far", [0.0, 0.3, 2.0])
def test_derivatives_of_relative_poses_are_those_of_differences(far: float) -> None:
    rng = np.random.default_rng(5)
    poses = [Rigid.from_rotvec(rng.normal(0, 1, 3), rng.normal(0, 2, 3)) for _ in range(2)]
    apart = moved_pose(poses[1] @ poses[0].inverse, far * np.array([0.3, -0.5, 0.4, 0.2, 0.1, -0.3]))
    known = RelativePose(1, 0, apart, np.eye(6), rng.normal(0, 1e-3, (6, 4)), np.zeros(4))
    values = rng.normal(0, 1, 4)
    residual, by_body, by_base = relative_residual(known, poses, values)
    assert (np.abs(residual).max() < 1e-2) == (far == 0.0)
    for column in range(6):
        step = np.zeros(6)
        step[column] = 1e-6
        for body, J in ((1, by_body), (0, by_base)):
            beside = [[moved_pose(p, s * step) if k == body else p for k, p in enumerate(poses)] for s in (1, -1)]
            ends = [relative_residual(known, at, values) for at in beside]
            np.testing.assert_allclose(J[:, column], (ends[0][0] - ends[1][0]) / 2e-6, atol=1e-6)


def test_without_noise_the_truth_is_found() -> None:
    truth, problem = room(3, noise=0.0)
    found = solve(problem)
    assert found.converged
    for pose, true in zip(found.problem.poses, truth.poses, strict=True):
        assert pose.distance_to(true) < 1e-6
        assert pose.angle_to(true) < 1e-6
    np.testing.assert_allclose(found.problem.cameras[0].values, truth.cameras[0].values, atol=1e-3)


@pytest.mark.long
def test_a_general_solver_finds_the_same_minimum() -> None:
    _, problem = room(4, photos=3, points=40)
    _, _, size = problem.columns

    def residuals(x: np.ndarray) -> np.ndarray:
        at = problem.moved(x[:size], x[size:].reshape(-1, 3))
        parts = [
            tie_residuals(at)[0].ravel() / _PIXEL, surface_residuals(at)[0] / at.ties.sigma_m,
            (at.cameras[0].values - at.cameras[0].prior) / np.sqrt(np.diag(at.cameras[0].covariance)),
        ]  # fmt: skip
        parts += [relative_residual(one, at.poses, None)[0] / np.sqrt(np.diag(one.covariance)) for one in at.relative]
        return np.concatenate(parts)

    unknowns = size + problem.ties.points.size
    peer = least_squares(residuals, np.zeros(unknowns), x_scale="jac", xtol=1e-14, ftol=1e-14)
    at = problem.moved(peer.x[:size], peer.x[size:].reshape(-1, 3))
    found = solve(problem, robust=False, sigma_px=_PIXEL)
    assert found.converged
    for ours, theirs in zip(found.problem.poses, at.poses, strict=True):
        assert ours.distance_to(theirs) < 2e-5
        assert ours.angle_to(theirs) < 2e-5


def test_wrong_ties_and_a_wrong_image_lose_their_weight() -> None:
    truth, problem = room(5)
    rng = np.random.default_rng(6)
    wrong = rng.random(len(problem.ties.uv)) < 0.15
    uv = np.where(wrong[:, None], problem.ties.uv + rng.uniform(15, 40, problem.ties.uv.shape), problem.ties.uv)
    lying = replace(problem.relative[1], pose=moved_pose(problem.relative[1].pose, np.array([0, 0, 0, 0.3, 0.2, 0.0])))
    relative = (problem.relative[0], lying, *problem.relative[2:])
    found = solve(replace(problem, ties=replace(problem.ties, uv=uv), relative=relative))
    assert (found.tie_weights[wrong] > 0.05).mean() < 0.15  # of two that see a point, either may be the wrong one
    assert np.median(found.tie_weights[~wrong]) > 0.7
    assert found.relative_weights[1] < 0.05
    assert found.relative_weights[[0, 2, 3, 4]].min() > 0.5
    for pose, true in zip(found.problem.poses, truth.poses, strict=True):
        assert pose.distance_to(true) < 0.02


@pytest.mark.long
def test_the_covariance_is_that_of_the_errors() -> None:
    distances, cameras = [], []
    for seed in range(40):
        truth, problem = room(100 + seed)
        found = solve(problem)
        for body in range(1, len(truth.poses)):
            true, pose = truth.poses[body], found.problem.poses[body]
            off = np.concatenate([_turn(true, pose), true.centre - pose.centre])
            distances.append(off @ np.linalg.solve(found.covariance_of(body), off) / 6)
        off = truth.cameras[0].values - found.problem.cameras[0].values
        cameras.append(off @ np.linalg.solve(found.camera_covariance(0), off) / 4)
    assert 0.75 < np.sqrt(np.mean(distances)) < 1.2
    assert 0.7 < np.sqrt(np.mean(cameras)) < 1.3


def _turn(true: Rigid, pose: Rigid) -> np.ndarray:
    from ladarreg_core.frames import rotvec_from_rotation

    return np.asarray(rotvec_from_rotation(true.rotation @ pose.rotation.T))


def _difference(problem: Problem, size: int, column: int) -> np.ndarray:
    step = np.zeros(size)
    step[column] = 1e-6
    ahead, back = (tie_residuals(problem.moved(sign * step, np.zeros((1, 3))))[0] for sign in (1, -1))
    return np.asarray((back - ahead) / 2e-6)
