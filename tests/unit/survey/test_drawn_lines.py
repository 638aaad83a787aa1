"""Lines drawn by hand in several photographs: what they add to weak poses, and which constrain none or are wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.survey.adjustment import AdjustedLine, AdjustedPhoto
from ladarreg_core.survey.assembly import drawn_lines
from ladarreg_core.survey.build import Bodies
from ladarreg_core.survey.least_squares.line_residuals import line_residuals, line_surface_residuals
from ladarreg_core.survey.least_squares.problem import (
    WORLD,
    CameraUnknowns,
    Matrix,
    PhotoView,
    Problem,
    RelativePose,
    Ties,
    moved_pose,
    pose_difference,
)
from ladarreg_core.survey.least_squares.solver import Adjusted, solve
from ladarreg_core.survey.parts import SurveyLine
from ladarreg_core.survey.ties.lines import DrawnLine, lines_between
from ladarreg_core.survey.verdicts import Solution, without_photo

_PINHOLE = Camera(900, 600, 800.0, 800.0, 452.0, 296.0, (-0.1, 0.02, 0.0, 0.0))
_WEAK = np.array([*[np.radians(0.2)] * 3, *[0.015] * 3])
"""Standard deviation of the weak poses: 0.2 deg and 15 mm, about 5 px."""
_NOISE_PX = 0.5
_SIDES = (-0.9, -0.1, 0.5, 0.9)
"""Where the photographs stand, m, to the side of what they look at."""


def _poses(sides: Sequence[float] = _SIDES) -> list[Rigid]:
    return [Rigid.from_centre(look_along([1.0, -0.3 * y, 0.1 * y]), [0.0, y, 0.3 * y * y]) for y in sides]


def _edges(rng: np.random.Generator, count: int) -> Matrix:
    """Return two places (N, 2, 3) of edges in front of all photographs, .3 m apart or more."""
    ends = np.concatenate([rng.uniform(2.5, 3.5, (200, 2, 1)), rng.uniform(-0.5, 0.5, (200, 2, 2))], axis=2)
    return np.asarray(ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > 0.3][:count])


def _drawn(
    edges: Matrix, poses: Sequence[Rigid], camera: CameraModel, rng: np.random.Generator, *, noise_px: float = _NOISE_PX
) -> list[DrawnLine]:
    """Return the edges as each photograph shows them, other parts of them in each."""
    found = []
    for first, second in edges:
        uv = []
        for pose in poses:
            at = rng.uniform([-0.2, 0.7], [0.3, 1.2])[:, None]
            uv.append(camera.project(pose @ (first + at * (second - first))) + rng.normal(0, noise_px, (2, 2)))
        found.append(DrawnLine(tuple(range(len(poses))), np.array(uv), _NOISE_PX))
    return found


def _problem(
    poses: Sequence[Rigid], camera: CameraModel = _PINHOLE, *, sigmas: Matrix = _WEAK, estimated: bool = False
) -> Problem:
    """Return a scanner and photographs whose poses are known weakly."""
    known = [RelativePose(k, WORLD, pose, np.diag(sigmas**2), name="its prior") for k, pose in enumerate(poses, 1)]
    values = np.array([800.0, -0.1, 2.5, -3.5]) if estimated else np.zeros(0)
    prior = np.diag(np.array([5.0, 0.02, 4.0, 4.0]) ** 2) if estimated else np.zeros((0, 0))
    middle = np.array([0.0, 0.0, 449.5, 299.5])
    views = (None, *(PhotoView(0, np.eye(4), middle, camera) for _ in poses))
    fixed = np.array([True, *[False] * len(poses)])
    own = CameraUnknowns(camera, values, values, prior)
    return Problem((Rigid.identity(), *poses), fixed, views, (own,), tuple(known), Ties.none())


def _with_lines(problem: Problem, drawn: Sequence[DrawnLine]) -> Problem:
    return replace(problem, lines=lines_between(problem, drawn, {k: k + 1 for k in range(len(problem.poses) - 1)}, [0]))


def _beside(poses: Sequence[Rigid], rng: np.random.Generator, *, sigmas: Matrix = _WEAK) -> list[Rigid]:
    return [moved_pose(pose, sigmas * rng.normal(size=6)) for pose in poses]


def _verdicts(problem: Problem, drawn: Sequence[DrawnLine], found: Adjusted | None = None) -> list[AdjustedLine]:
    """Return what is said of each line, in photographs that are called a, b, c, ..."""
    found = solve(problem) if found is None else found
    count = len(problem.poses) - 1
    names, view = "abcdefgh"[:count], problem.views[1]
    assert view is not None
    photos = {
        name: AdjustedPhoto(
            camera_from_world=pose, covariance=np.eye(6), camera=view.base, camera_id="c", evidence="image", reasons=()
        )
        for name, pose in zip(names, found.problem.poses[1:], strict=True)
    }
    given = [
        SurveyLine(
            id=f"l{k + 1}", photos=tuple(names[photo] for photo in one.photos),
            uv=tuple(((a[0], a[1]), (b[0], b[1])) for a, b in one.uv.tolist()),
        )
        for k, one in enumerate(drawn)
    ]  # fmt: skip
    bodies = Bodies([0], {k: k + 1 for k in range(count)})
    return list(drawn_lines(given, drawn, Solution(found, bodies), photos))


@pytest.mark.slow
@pytest.mark.parametrize(
    "camera",
    [
        _PINHOLE,
        FisheyeCamera(1200, 1200, 360.0, 360.0, 601.0, 597.0, (0.02, -0.004, 0.0, 0.0)),
        EquirectangularCamera(2048, 1024),
    ],
    ids=["pinhole", "fisheye", "equirectangular"],
)
def test_derivatives_of_lines_are_those_of_differences(camera: CameraModel) -> None:
    rng = np.random.default_rng(1)
    estimated = camera.as_pinhole is not None
    drawn = _drawn(_edges(rng, 6), _poses(), camera, rng)
    problem = _with_lines(_problem(_beside(_poses(), rng), camera, estimated=estimated), drawn)
    residual, by_pose, by_camera, by_line = line_residuals(problem)
    assert np.isfinite(residual).all()
    assert np.abs(residual).max() > 2, "derivatives are to hold away from the solution"
    of_body, of_camera, size = problem.columns

    def difference(column: int | None, of_line: int | None = None) -> Matrix:
        found = []
        for sign in (1, -1):
            step, lines = np.zeros(size), np.zeros((len(problem.lines.points), 4))
            if column is not None:
                step[column] = sign * 1e-6
            if of_line is not None:
                lines[:, of_line] = sign * 1e-6
            found.append(line_residuals(problem.moved(step, np.zeros((0, 3)), lines))[0])
        return np.asarray((found[1] - found[0]) / 2e-6)

    for body in (1, 3):
        rows = problem.lines.photo == body
        for column in range(6):
            found = difference(of_body[body] + column)[rows]
            np.testing.assert_allclose(by_pose[rows, :, column], found, rtol=1e-5, atol=1e-3)
    for column in range(4 if estimated else 0):
        np.testing.assert_allclose(by_camera[:, :, column], difference(of_camera[0] + column), rtol=1e-4, atol=1e-3)
    for column in range(4):
        np.testing.assert_allclose(by_line[:, :, column], difference(None, column), rtol=1e-5, atol=1e-3)


def test_derivatives_of_lines_on_a_scan_are_those_of_differences() -> None:
    rng = np.random.default_rng(2)
    edges = _edges(rng, 3)
    drawn = [replace(one, scan=0, xyz=edge + rng.normal(0, 0.01, (2, 3)), sigma_m=0.004)
             for one, edge in zip(_drawn(edges, _poses(), _PINHOLE, rng), edges, strict=True)]  # fmt: skip
    problem = _with_lines(_problem(_beside(_poses(), rng)), drawn)
    problem = replace(problem, fixed=np.zeros(len(problem.poses), bool))
    distance, by_scan, by_line = line_surface_residuals(problem)
    assert len(distance) == 4 * len(edges)
    of_body, _, size = problem.columns
    for column in range(10):
        step, lines = np.zeros(size), np.zeros((len(problem.lines.points), 4))
        (step if column < 6 else lines[0])[of_body[0] + column if column < 6 else column - 6] = 1e-6
        if column >= 6:
            lines[:] = lines[0]
        ahead, back = (line_surface_residuals(problem.moved(s * step, np.zeros((0, 3)), s * lines))[0] for s in (1, -1))
        analytic = by_scan[:, column] if column < 6 else by_line[:, column - 6]
        np.testing.assert_allclose(analytic, (ahead - back) / 2e-6, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "camera",
    [_PINHOLE, FisheyeCamera(1200, 1200, 360.0, 360.0, 601.0, 597.0, (0.02, -0.004, 0.0, 0.0)),
     EquirectangularCamera(2048, 1024)],
    ids=["pinhole", "fisheye", "equirectangular"],
)  # fmt: skip
def test_without_noise_lines_find_the_truth(camera: CameraModel) -> None:
    rng, true = np.random.default_rng(3), _poses()
    start = [*true[:2], *_beside(true[2:], rng)]
    drawn = _drawn(_edges(rng, 9), true, camera, rng, noise_px=0.0)
    problem = _with_lines(_problem(start, camera), drawn)
    held = [replace(one, covariance=np.diag([1e-12] * 6)) if k < 2 else replace(one, covariance=np.eye(6))
            for k, one in enumerate(problem.relative)]  # fmt: skip
    found = solve(replace(problem, relative=tuple(held)))
    assert found.converged
    for one, other in zip(found.problem.poses[1:], true, strict=True):
        assert one.distance_to(other) < 5e-4, "a twentieth of what half a pixel would leave"
    assert all(one.agrees for one in _verdicts(problem, drawn, found))


@pytest.mark.slow
def test_errors_of_weak_poses_with_lines_are_those_that_the_covariance_states() -> None:
    before, after, held, agree = [], [], [], []
    for seed in range(16):
        rng, true = np.random.default_rng([seed, 4]), _poses()
        start = _beside(true, rng)
        drawn = _drawn(_edges(rng, 8), true, _PINHOLE, rng)
        problem = _with_lines(_problem(start), drawn)
        found = solve(problem)
        off = np.array([pose_difference(t, p) for t, p in zip(true, found.problem.poses[1:], strict=True)])
        before.append([pose_difference(t, p) for t, p in zip(true, start, strict=True)])
        after.append(off)
        held += [one @ np.linalg.solve(found.covariance_of(k), one) / 6 for k, one in enumerate(off, 1)]
        agree.append(sum(one.agrees for one in _verdicts(problem, drawn, found)))
    turn, shift = (
        np.sqrt(np.mean(np.array(after)[..., part] ** 2) / np.mean(np.array(before)[..., part] ** 2))
        for part in (slice(0, 3), slice(3, 6))
    )
    assert np.mean(agree) > 7.8, agree
    assert turn < 0.85, turn
    assert shift < 0.85, shift
    assert 0.8 < np.sqrt(np.mean(held)) < 1.1, np.sqrt(np.mean(held))


def test_two_photographs_of_a_line_constrain_nothing() -> None:
    rng, true = np.random.default_rng(5), _poses()
    drawn = [replace(one, photos=one.photos[:2], uv=one.uv[:2]) for one in _drawn(_edges(rng, 4), true, _PINHOLE, rng)]
    problem = _with_lines(_problem(_beside(true, rng)), drawn)
    assert not len(problem.lines.points)
    for said in _verdicts(problem, drawn):
        assert not said.agrees
        assert said.reason == (
            "Left out: only two of its photographs are part of the adjustment, and two or fewer do not "
            "constrain their poses; draw it in 3 or more, or mark its ends as ties where two photographs show both."
        )


def test_a_line_that_points_at_the_cameras_is_refused() -> None:
    """Photographs beside each other, and a line in the plane of them all: each sees it in that plane."""
    rng = np.random.default_rng(6)
    true = [Rigid.from_centre(look_along([1.0, -0.3 * y, 0.0]), [0.0, y, 0.0]) for y in _SIDES]
    level = np.array([[[2.5, -0.3, 0.0], [3.2, 0.4, 0.0]]])
    (said,) = _verdicts(_problem(true), _drawn(level, true, _PINHOLE, rng, noise_px=0.2))
    assert not said.agrees
    assert "in nearly the same plane (0." in said.reason
    assert said.reason.endswith("draw it in a photograph from beside it.")


@pytest.mark.slow
@pytest.mark.parametrize("off", [6.0, 25.0])
def test_a_wrong_edge_is_left_out_and_named_and_moves_nothing(off: float) -> None:
    rng, true = np.random.default_rng(7), _poses()
    start, drawn = _beside(true, rng, sigmas=_WEAK / 5), _drawn(_edges(rng, 6), true, _PINHOLE, rng)
    along = drawn[2].uv[1, 1] - drawn[2].uv[1, 0]
    across = off * np.array([-along[1], along[0]]) / np.linalg.norm(along)
    wrong = replace(drawn[2], uv=drawn[2].uv + np.array([[0, 0], across, [0, 0], [0, 0]])[:, None])
    of_three = replace(wrong, photos=(0, 1, 3), uv=wrong.uv[[0, 1, 3]])
    sigmas = _WEAK / 5
    right = solve(_with_lines(_problem(start, sigmas=sigmas), [one for k, one in enumerate(drawn) if k != 2]))
    for bad, reason in (
        (wrong, "Left out in b, where it disagrees with all other observations by "),
        (of_three, "Left out: one of a, b, d shows another"),
    ):
        lines = [*drawn[:2], bad, *drawn[3:]]
        problem = _with_lines(_problem(start, sigmas=sigmas), lines)
        found = solve(problem)
        verdicts = _verdicts(problem, lines, found)
        assert [one.id for one in verdicts if not one.agrees] == ["l3"]
        assert verdicts[2].reason.startswith(reason), verdicts[2].reason
        assert 0.5 * off < np.nanmax(verdicts[2].residuals_px) < 2 * off
        for one, other in zip(right.problem.poses, found.problem.poses, strict=True):
            assert one.distance_to(other) < 4e-3


def test_a_line_that_a_scan_shows_holds_one_photograph() -> None:
    rng, true = np.random.default_rng(8), _poses(_SIDES[:1])
    edges = _edges(rng, 6)
    drawn = [replace(one, scan=0, xyz=edge, sigma_m=0.001)
             for one, edge in zip(_drawn(edges, true, _PINHOLE, rng, noise_px=0.0), edges, strict=True)]  # fmt: skip
    start = _beside(true, rng)
    problem = _with_lines(_problem(start, sigmas=100 * _WEAK), drawn)
    found = solve(problem)
    assert found.problem.poses[1].distance_to(true[0]) < 1e-3 < start[0].distance_to(true[0])
    verdicts = _verdicts(problem, drawn, found)
    assert all(one.agrees for one in verdicts)
    assert verdicts[0].reason.startswith("In one photograph and the scan it agrees within 0.")
    assert all(one.scan_residual_m < 1e-4 for one in verdicts)


def test_a_line_that_a_scan_shows_elsewhere_is_left_out_there_and_says_by_how_much() -> None:
    rng, true = np.random.default_rng(8), _poses()
    edges, drawn = _edges(rng, 4), []
    for number, (one, edge) in enumerate(zip(_drawn(edges, true, _PINHOLE, rng), edges, strict=True)):
        across = np.linalg.svd((edge[1] - edge[0])[None])[2][2]  # not in depth, of which the photographs know less
        drawn.append(replace(one, scan=0, xyz=edge + 0.2 * across * (number == 2), sigma_m=0.002))
    problem = _with_lines(_problem(true), drawn)
    verdicts = _verdicts(problem, drawn)
    assert [one.agrees for one in verdicts] == [True, True, False, True]
    assert verdicts[2].scan_residual_m == pytest.approx(0.2, abs=0.02)
    assert verdicts[2].reason.startswith("Left out in the scan, which shows it elsewhere than its photographs by 0.")
    assert max(one.scan_residual_m for one in verdicts if one.agrees) < 0.01


def test_a_line_of_too_few_photographs_goes_with_one_that_is_taken_out() -> None:
    rng, true = np.random.default_rng(9), _poses()
    four = _drawn(_edges(rng, 2), true, _PINHOLE, rng)
    drawn = [four[0], replace(four[1], photos=(0, 2, 3), uv=four[1].uv[[0, 2, 3]])]
    problem = _with_lines(_problem(true), drawn)
    assert problem.lines.photo.tolist() == [1, 2, 3, 4, 1, 3, 4]
    left, bodies = without_photo(problem, Bodies([0], {k: k + 1 for k in range(4)}), 2)
    assert bodies.photos == {0: 1, 1: 2, 3: 3}
    assert left.lines.photo.tolist() == [1, 2, 3]
    assert left.lines.drawn.tolist() == [0]
    assert solve(left).line_inliers.all()
