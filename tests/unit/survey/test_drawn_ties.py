"""Ties that somebody drew between two photographs: what they give to weak poses, and what a wrong one does not do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, look_along, rotvec_from_rotation
from ladarreg_core.survey.adjustment import AdjustedPhoto
from ladarreg_core.survey.assembly import drawn_ties
from ladarreg_core.survey.build import Bodies
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
from ladarreg_core.survey.parts import SurveyTie
from ladarreg_core.survey.ties.features import Features
from ladarreg_core.survey.ties.ties import LaserPoints, laser_points, thinned, tie_points, tracks_of, with_drawn
from ladarreg_core.survey.verdicts import Solution
from testing.scenes.shared_places import SharedPlaces, shared_places

_NO_FEATURES = Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32))
_WEAK = np.array([*[np.radians(0.3)] * 3, *[0.015] * 3])
"""Standard deviation of the weak poses: 0.3 deg and 15 mm, about 5 px."""
_NOISE_PX = 0.5
_DRAWN = 12


def _drawn(pair: SharedPlaces, rng: np.random.Generator, count: int) -> list[SurveyTie]:
    chosen = pair.uv[rng.choice(len(pair.uv), count, replace=False)]
    places = chosen + rng.normal(0, _NOISE_PX, chosen.shape)
    return [
        SurveyTie(
            id=f"t{k + 1}", photos=pair.names, uv=((one[0][0], one[0][1]), (one[1][0], one[1][1])), sigma_px=_NOISE_PX
        )
        for k, one in enumerate(places.tolist())
    ]


def _adjusted(
    pair: SharedPlaces, start: list[Rigid], drawn: list[SurveyTie], *, on_laser: bool
) -> tuple[Adjusted, Bodies]:
    """Adjust two photographs at weak poses by the ties that were drawn alone, as the survey does it, twice."""
    features, matches, ends = with_drawn(
        [_NO_FEATURES, _NO_FEATURES], {}, [((0, 1), np.array(one.uv), one.sigma_px) for one in drawn]
    )
    known = [RelativePose(k + 1, WORLD, pose, np.diag(_WEAK**2), name="its prior") for k, pose in enumerate(start)]
    cameras = tuple(CameraUnknowns(one, np.zeros(0), np.zeros(0), np.zeros((0, 0))) for one in pair.cameras)
    views = (None, *(PhotoView(k, np.eye(4), np.zeros(4), one) for k, one in enumerate(pair.cameras)))
    fixed = np.array([True, False, False])
    problem = Problem((Rigid.identity(), *start), fixed, views, cameras, tuple(known), Ties.none())
    bodies = Bodies([0], {0: 1, 1: 2})
    for _ in range(2):
        poses, models = dict(enumerate(problem.poses[1:])), dict(enumerate(pair.cameras))
        laser = {
            (k, 0): laser_points(pair.scan, models[k], poses[k], features[k].uv.astype(np.float64))
            for k in poses if on_laser
        }  # fmt: skip
        ties = tie_points(
            matches, [one.uv for one in features], poses, models, laser, [Rigid.identity()],
            body_of_scan=[0], body_of_photo=bodies.photos, drawn=ends,
        )  # fmt: skip
        found = solve(replace(problem, ties=ties))
        problem = found.problem
    return found, bodies


def _errors(pair: SharedPlaces, poses: tuple[Rigid, ...]) -> Matrix:
    return np.array([pose_difference(true, found) for true, found in zip(pair.poses, poses, strict=True)])


def _weak_start(pair: SharedPlaces, rng: np.random.Generator) -> list[Rigid]:
    return [moved_pose(pose, _WEAK * rng.normal(size=6)) for pose in pair.poses]


def _verdicts(pair: SharedPlaces, found: Adjusted, bodies: Bodies, drawn: list[SurveyTie]) -> dict[str, lr.AdjustedTie]:
    photos = {
        name: AdjustedPhoto(
            camera_from_world=pose, covariance=np.eye(6), camera=camera, camera_id="c", evidence="image", reasons=()
        )
        for name, pose, camera in zip(pair.names, found.problem.poses[1:], pair.cameras, strict=True)
    }
    return {one.id: one for one in drawn_ties(drawn, Solution(found, bodies), photos)}


@pytest.mark.slow
def test_drawn_ties_bring_two_weak_poses_closer_together_and_to_the_surface() -> None:
    pair, before, after, between, held, agree = shared_places(), [], [], [], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        start, drawn = _weak_start(pair, rng), _drawn(pair, rng, _DRAWN)
        found, bodies = _adjusted(pair, start, drawn, on_laser=True)
        before.append(_errors(pair, tuple(start)))
        after.append(_errors(pair, found.problem.poses[1:]))
        agree.append(sum(one.agrees for one in _verdicts(pair, found, bodies, drawn).values()))
        rotations = [pose.rotation for pose in (*pair.poses, *start, *found.problem.poses[1:])]
        true, weak, solved = (rotations[k + 1] @ rotations[k].T for k in (0, 2, 4))
        between.append([np.linalg.norm(rotvec_from_rotation(one @ true.T)) for one in (weak, solved)])
        held.append([off @ np.linalg.solve(found.covariance_of(k + 1), off) / 6 for k, off in enumerate(after[-1])])
    turn, shift = (
        np.sqrt(np.mean(np.array(after)[..., part] ** 2) / np.mean(np.array(before)[..., part] ** 2))
        for part in (slice(0, 3), slice(3, 6))
    )
    assert sum(agree) >= 0.96 * 12 * _DRAWN, agree
    assert turn < 0.85, turn  # how both stand together, the surface says little of
    assert shift < 0.85, shift
    relative = np.median(np.array(between), axis=0)
    assert relative[1] < 0.4 * relative[0], relative
    assert 0.2 < np.mean(held) < 3, "the errors are those that the covariance states"


@pytest.mark.slow
def test_a_wrong_tie_is_left_out_and_named_and_moves_nothing() -> None:
    pair, rng = shared_places(), np.random.default_rng(4)
    start, drawn = _weak_start(pair, rng), _drawn(pair, rng, _DRAWN)
    right, _ = _adjusted(pair, start, drawn, on_laser=True)
    at_edges = [
        name for name, one in _verdicts(pair, right, Bodies([0], {0: 1, 1: 2}), drawn).items() if not one.agrees
    ]
    assert len(at_edges) <= 1  # from a weak pose the surface beside one may be taken for its place
    (u, v), there = drawn[5].uv
    wrong = SurveyTie(id="wrong", photos=pair.names, uv=((u, v), (there[0] + 22.0, there[1] - 17.0)), sigma_px=0.5)
    far = SurveyTie(id="far", photos=pair.names, uv=((u, v), (there[0] + 200.0, there[1] + 150.0)), sigma_px=0.5)
    every = [*drawn, wrong, far]
    found, bodies = _adjusted(pair, start, every, on_laser=True)
    verdicts = _verdicts(pair, found, bodies, every)
    assert [name for name, one in verdicts.items() if not one.agrees] == [*at_edges, "wrong", "far"]
    assert "px from where all other observations put it" in verdicts["wrong"].reason
    assert 10 < verdicts["wrong"].residual_px < np.hypot(22, 17) + 4
    assert "draw it again" in verdicts["far"].reason
    for one, other in zip(right.problem.poses, found.problem.poses, strict=True):
        assert one.distance_to(other) < 1e-3


@pytest.mark.slow
def test_where_the_laser_met_nothing_drawn_ties_are_triangulated() -> None:
    pair, rng = shared_places(), np.random.default_rng(8)
    start, drawn = _weak_start(pair, rng), _drawn(pair, rng, _DRAWN)
    found, _ = _adjusted(pair, start, drawn, on_laser=False)
    assert len(found.problem.ties.scan) == 0
    assert len(found.problem.ties.points) >= _DRAWN - 2
    kept = np.linalg.norm(found.tie_residuals_px[found.tie_inliers], axis=1)
    assert np.median(kept) < 2 * _NOISE_PX


def test_what_is_drawn_is_never_thinned_out() -> None:
    rng = np.random.default_rng(2)
    uv, by_hand = rng.uniform(0, 600, (900, 2)), np.arange(900) >= 890
    kept = thinned(np.stack([np.arange(900)] * 2, axis=1), uv, 300, keep=by_hand)
    assert len(kept) == 310
    assert set(range(890, 900)) <= set(kept[:, 0].tolist())


def test_drawn_ties_follow_the_features_that_were_found() -> None:
    found = Features(np.zeros((3, 2), np.float32), np.ones((3, 128), np.float32), np.ones(3, np.float32))
    places = np.array([[5.0, 6.0], [7.0, 8.0]])
    features, matches, ends = with_drawn(
        [found, found, found], {(0, 2): np.array([[1, 1]])}, [((2, 0), places, 0.4), ((0, 1), places, 2.0)]
    )
    assert [len(one) for one in features] == [5, 4, 4]
    assert features[2].uv[3].tolist() == [5.0, 6.0]
    assert features[0].uv[3:].tolist() == [[7.0, 8.0], [5.0, 6.0]]
    assert matches[0, 2].tolist() == [[1, 1], [3, 3]]
    assert matches[0, 1].tolist() == [[4, 3]]
    assert ends == {(2, 3): (0, 0.4), (0, 3): (0, 0.4), (0, 4): (1, 2.0), (1, 3): (1, 2.0)}


def test_ties_that_share_an_end_are_one_track() -> None:
    a, b, c, d = (("a", (1.0, 2.0)), ("b", (3.0, 4.0)), ("c", (5.0, 6.0)), ("d", (7.0, 8.0)))
    beside = ("b", (30.0, 4.0))
    assert tracks_of([(a, b), (c, d), (c, a)]) == [0, 0, 0], "the third joins both"
    assert tracks_of([(a, b), (c, d), (a, c), (b, c)]) == [0, 0, 0, 0], "a ring"
    assert tracks_of([(a, b), (("a", (1.0, 2.5)), c)]) == [0, 1], "only at the very same pixel"
    assert tracks_of([(a, b), (a, beside), (c, d)]) == [0, 1, 2], "one of two is wrong: none is joined"
    assert tracks_of([]) == []


def _three_views(rng: np.random.Generator, count: int) -> tuple[Camera, list[Rigid], Matrix]:
    """Return a camera, its three poses, and the pixels (N, 3, 2) of places that all three see."""
    camera = Camera.from_focal(900, 600, 800.0)
    poses = [Rigid.from_centre(look_along([1.0, -0.3 * x, 0.0]), [0.0, x, 0.0]) for x in (-0.8, 0.0, 0.8)]
    places = np.column_stack([rng.uniform(2.5, 3.5, count), rng.uniform(-0.4, 0.4, (count, 2))])
    return camera, poses, np.stack([camera.project(pose @ places) for pose in poses], axis=1)


def test_a_track_of_three_photographs_is_one_point_with_three_observations() -> None:
    rng = np.random.default_rng(3)
    camera, poses, uv = _three_views(rng, 12)
    uv += rng.normal(0, _NOISE_PX, uv.shape)
    uv[4, 2] += (25.0, -15.0)
    names = ("a", "b", "c")
    pairs = [(k, to) for k in range(len(uv)) for to in (1, 2)]  # each from the first photograph to the second and third
    drawn = [
        SurveyTie(
            id=f"t{number}", photos=("a", names[to]), uv=(tuple(uv[k, 0].tolist()), tuple(uv[k, to].tolist())),
            sigma_px=_NOISE_PX,
        )
        for number, (k, to) in enumerate(pairs)
    ]  # fmt: skip
    features, matches, ends = with_drawn(
        [_NO_FEATURES] * 3, {}, [((0, to), uv[k][[0, to]], _NOISE_PX) for k, to in pairs]
    )
    assert [len(one) for one in features] == [len(uv)] * 3, "the common end is one feature"
    start = dict(enumerate(poses))
    ties = tie_points(
        matches, [one.uv for one in features], start, dict.fromkeys(range(3), camera), {}, [],
        body_of_scan=[], body_of_photo={k: k + 1 for k in start}, drawn=ends,
    )  # fmt: skip
    assert len(ties.points) == len(uv)
    assert np.bincount(ties.point).tolist() == [3] * len(uv)
    known = [
        RelativePose(k + 1, WORLD, pose, np.diag((_WEAK / 30) ** 2), name="its prior") for k, pose in start.items()
    ]
    own = CameraUnknowns(camera, np.zeros(0), np.zeros(0), np.zeros((0, 0)))
    views = (None, *(PhotoView(0, np.eye(4), np.zeros(4), camera) for _ in range(3)))
    fixed = np.array([True, False, False, False])
    found = solve(Problem((Rigid.identity(), *poses), fixed, views, (own,), tuple(known), ties))
    photos = {
        name: AdjustedPhoto(
            camera_from_world=pose, covariance=np.eye(6), camera=camera, camera_id="c", evidence="image", reasons=()
        )
        for name, pose in zip(names, poses, strict=True)
    }
    bodies = Bodies([0], {k: k + 1 for k in range(3)})
    verdicts = drawn_ties(drawn, Solution(found, bodies), photos)
    left_out = [one.id for one in verdicts if not one.agrees]
    assert "t9" in left_out, "the end in the third photograph was drawn elsewhere"
    assert set(left_out) <= {"t8", "t9"}, "nothing else suffers from it"


def test_a_surface_that_few_of_the_photographs_meet_is_none() -> None:
    """At a depth edge the ray of one loose pose meets what lies behind: everything would be bent towards it."""
    camera, poses, uv = _three_views(np.random.default_rng(5), 8)
    features, matches, ends = with_drawn(
        [_NO_FEATURES] * 3, {}, [((0, to), one[[0, to]], _NOISE_PX) for one in uv for to in (1, 2)]
    )
    meeting = np.array([0, 1, 2, 3, 1, 2, 3, 1])
    laser = {}
    for photo, pose in enumerate(poses):
        rays = camera.unproject(features[photo].uv.astype(np.float64)) @ pose.rotation
        depth = (3.0 - pose.centre[0]) / rays[:, 0]
        xyz = (pose.centre + rays * depth[:, None]).astype(np.float32)
        first = np.argsort([np.flatnonzero((uv[:, photo].astype(np.float32) == at).all(axis=1))[0]
                            for at in features[photo].uv])  # fmt: skip
        xyz[first[meeting <= photo]] = np.nan
        laser[photo, 0] = LaserPoints(xyz, np.tile(np.float32([-1, 0, 0]), (len(xyz), 1)), 0.003)
    ties = tie_points(
        matches, [one.uv for one in features], dict(enumerate(poses)), dict.fromkeys(range(3), camera), laser,
        [Rigid.identity()], body_of_scan=[0], body_of_photo={k: k + 1 for k in range(3)}, drawn=ends,
    )  # fmt: skip
    assert len(ties.points) == len(uv), "without a surface, a place is triangulated"
    first_seen = np.array([ties.uv[(ties.point == point) & (ties.photo == 1)][0] for point in ties.on_point])
    on = [int(np.argmin(np.linalg.norm(uv[:, 0] - at, axis=1))) for at in first_seen]
    assert sorted(on) == np.flatnonzero(meeting >= 2).tolist()
