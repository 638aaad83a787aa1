"""Rigs of a survey: what is measured of their sensors, what that holds, and frames that do not fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.survey.build import Bodies
from ladarreg_core.survey.least_squares.problem import (
    RIG,
    WORLD,
    CameraUnknowns,
    PhotoView,
    Problem,
    RelativePose,
    Ties,
    moved_pose,
    pose_difference,
)
from ladarreg_core.survey.least_squares.solver import Adjusted, solve
from ladarreg_core.survey.parts import RigMember, SurveyCamera, SurveyPhoto, SurveyScan
from ladarreg_core.survey.placement import PhotoState
from ladarreg_core.survey.rigs import rig_factors, rigs_of, start_from_rig
from ladarreg_core.survey.ties.features import Features
from ladarreg_core.survey.verdicts import is_held_by_rig
from ladarreg_core.survey.work import PhotoFiles

CAMERA = Camera.from_focal(640, 480, 520.0)
RIGHT_FROM_LEFT = Rigid.from_rotvec([0.02, -0.6, 0.01], [-0.3, 0.02, 0.05])
_SIGMA = np.array([*[np.radians(0.05)] * 3, *[0.004] * 3])
_NO_FEATURES = Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32))
_UNKNOWN = CameraUnknowns(CAMERA, np.zeros(0), np.zeros(0), np.zeros((0, 0)))
_VIEW = PhotoView(0, np.eye(4), np.zeros(4), CAMERA)


def solved(poses: list[Rigid], seed: int) -> Adjusted:
    """Return bodies whose poses are each known with a covariance, at one draw of its noise."""
    rng = np.random.default_rng([seed, 5])
    known = [
        RelativePose(k, WORLD, moved_pose(pose, _SIGMA * rng.normal(size=6)), np.diag(_SIGMA**2), name="its image")
        for k, pose in enumerate(poses)
    ]
    problem = Problem(
        tuple(poses), np.zeros(len(poses), np.bool_), (_VIEW,) * len(poses), (_UNKNOWN,), tuple(known), Ties.none()
    )
    return solve(problem)


def rig(frames: int, *, verified: dict[str, set[int]], stated: bool = False) -> tuple[lr.Survey, list[PhotoState]]:
    """Return a survey of a rig with two sensors, and its photographs, left and right of each frame."""
    photos, states = [], []
    for frame in range(frames):
        for sensor in ("left", "right"):
            given = SurveyPhoto(
                id=f"{sensor}-{frame}", source=Path("photo.jpg"), camera=sensor,
                rig=RigMember(id="head", frame=str(frame), sensor=sensor),
            )  # fmt: skip
            photos.append(given)
            pairs: dict[int, Any] = {0: object()} if frame in verified[sensor] else {}
            states.append(
                PhotoState(given, PhotoFiles(id=given.id, source=Path()), 1, _NO_FEATURES, CAMERA, False, pairs)
            )
    sensors = {"left": None, "right": RIGHT_FROM_LEFT if stated else None}
    survey = lr.Survey(
        scans=(SurveyScan(id="scan", source=Path("scan.npz")),),
        cameras=(SurveyCamera(id="left", source=CAMERA), SurveyCamera(id="right", source=CAMERA)),
        photos=tuple(photos), rigs={"head": sensors},
    )  # fmt: skip
    return survey, states


def true_poses(frames: int, seed: int) -> list[Rigid]:
    rng = np.random.default_rng([seed, 6])
    left = [Rigid.from_rotvec(rng.normal(0, 1, 3), rng.normal(0, 2, 3)) for _ in range(frames)]
    return [pose for one in left for pose in (one, RIGHT_FROM_LEFT @ one)]


@pytest.mark.slow
def test_the_relative_pose_of_sensors_has_the_error_that_it_states() -> None:
    scores = []
    for seed in range(40):
        survey, states = rig(6, verified={"left": set(range(6)), "right": set(range(6))})
        found = rigs_of(survey, states, solved(true_poses(6, seed), seed), Bodies([], {k: k for k in range(12)}))
        pair = found.pairs["head", "right", "left"]
        off = pose_difference(RIGHT_FROM_LEFT, pair.first_from_second)
        scores.append(float(off @ np.linalg.solve(pair.covariance, off)))
        assert len(pair.frames) == 6
        back = found.pairs["head", "left", "right"]
        assert back.first_from_second.distance_to(RIGHT_FROM_LEFT.inverse) < 0.02
    assert 0.7 < np.sqrt(np.mean(scores) / 6) < 1.2


def test_a_frame_that_does_not_fit_is_left_out() -> None:
    survey, states = rig(5, verified={"left": set(range(5)), "right": set(range(5))})
    poses = true_poses(5, 1)
    poses[3] = moved_pose(poses[3], np.array([0, 0, 0, 0.2, 0, 0]))
    pair = rigs_of(survey, states, solved(poses, 1), Bodies([], {k: k for k in range(10)})).pairs[
        "head", "left", "right"
    ]
    assert pair.frames == ("0", "2", "3", "4")


def test_too_few_frames_say_nothing_and_a_stated_pose_needs_none() -> None:
    both = {"left": {0, 1}, "right": {0, 1}}
    poses, bodies = true_poses(3, 2), Bodies([], {k: k for k in range(6)})
    survey, states = rig(3, verified=both)
    assert not rigs_of(survey, states, solved(poses, 2), bodies).pairs
    survey, states = rig(3, verified=both, stated=True)
    pair = rigs_of(survey, states, solved(poses, 2), bodies).pairs["head", "right", "left"]
    assert pair.frames == ()
    assert pair.first_from_second.distance_to(RIGHT_FROM_LEFT) < 1e-9


def test_a_photograph_that_no_scan_resolves_is_held_by_its_rig() -> None:
    survey, states = rig(5, verified={"left": set(range(5)), "right": {0, 1, 2, 3}})
    poses = true_poses(5, 3)
    bodies = Bodies([], {k: k for k in range(10)})
    adjusted = solved(poses, 3)
    found = rigs_of(survey, states, adjusted, bodies)
    for k, state in enumerate(states[:9]):
        state.pose = adjusted.problem.poses[k]
    start = start_from_rig(found, 9, states)
    assert start is not None
    assert start.distance_to(poses[9]) < 0.03
    (factor,) = rig_factors(found, states, bodies)
    assert (factor.body, factor.base, factor.name) == (9, 8, RIG)
    problem = adjusted.problem
    relative = (*(one for one in problem.relative if one.body != 9), factor)
    again = solve(Problem(problem.poses, problem.fixed, problem.views, problem.cameras, relative, Ties.none()))
    assert is_held_by_rig(again, 9)
    assert not is_held_by_rig(again, 8)
    off = pose_difference(poses[9], again.problem.poses[9])
    assert float(off @ np.linalg.solve(again.covariance_of(9), off)) < 30
    assert np.sqrt(again.covariance_of(9)[3, 3]) < 0.02


def test_without_a_verified_photograph_of_its_frame_nothing_holds_one() -> None:
    survey, states = rig(5, verified={"left": {0, 1, 2, 3}, "right": {0, 1, 2, 3}})
    bodies = Bodies([], {k: k for k in range(10)})
    found = rigs_of(survey, states, solved(true_poses(5, 4), 4), bodies)
    assert found.pairs
    assert rig_factors(found, states, bodies) == []
    assert start_from_rig(found, 9, states) is None


@pytest.mark.parametrize("what", ["id", "sensor"])
def test_photographs_of_rigs_that_are_not_there_are_refused(what: str) -> None:
    survey, _ = rig(1, verified={"left": set(), "right": set()})
    member = RigMember(**{"id": "head", "frame": "0", "sensor": "left", what: "other"})
    photo = SurveyPhoto(id="p", source=Path("photo.jpg"), camera="left", rig=member)
    with pytest.raises(lr.LadarregError, match="other"):
        lr.Survey(scans=survey.scans, cameras=survey.cameras, photos=(photo,), rigs=survey.rigs)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_dark_photograph_gets_the_pose_that_its_rig_has() -> None:
    pytest.importorskip("embreex")
    from testing.scenes.survey_set import simulate_rig_survey

    survey, truth = simulate_rig_survey(frames=7, dark={("0", "right")})
    found = lr.adjust(survey)
    dark = found.photos["right-0"]
    assert dark.evidence == "rig", dark.reasons
    assert dark.camera_from_world is not None
    off = pose_difference(truth["right-0"], dark.camera_from_world)
    assert float(off @ np.linalg.solve(dark.covariance, off)) < 30
    assert dark.camera_from_world.distance_to(truth["right-0"]) < 0.05
    assert len(found.rigs["head"]["right"].frames) >= 3
    assert found.document()["rigs"]["head"]["right"]["reference_from_sensor"]
