"""The audit of a survey: single answers judged together, and a moved camera found among right ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.survey.audit import FALSE_ALARM, judged
from ladarreg_core.survey.least_squares.problem import moved_pose
from ladarreg_core.survey.parts import PosePrior
from ladarreg_core.survey.survey_audit import StatedPoses, audit_survey, judged_together

COVARIANCE = np.diag([2e-4, 3e-4, 1e-4, 0.004, 0.006, 0.003]) ** 2
GRID = Rigid.from_rotvec([0.0, 0.0, 0.4], [512_000.0, 5_400_000.0, 100.0])


@pytest.fixture(scope="module")
def case() -> lr.simulate.SimulatedCase:
    return lr.simulate_case("office", seed=2)


@pytest.mark.slow
def test_as_many_surveys_of_right_poses_are_called_wrong_as_stated(case: lr.simulate.SimulatedCase) -> None:
    found = lr.register(case.scan, case.photo)
    at, rng = case.camera_from_scanner, np.random.default_rng(3)
    wrong, single, trials, each = 0, 0, 150, 8
    for _ in range(trials):
        audits = {}
        for k in range(each):
            pose = moved_pose(at, rng.normal(0, 1, 6) * np.sqrt(np.diag(COVARIANCE)))
            audits[str(k)] = judged(replace(found, camera_from_scanner=pose, covariance=COVARIANCE), at)
        single += sum(one.outcome == "wrong" for one in audits.values())
        wrong += judged_together(audits).outcome == "wrong"
    assert abs(wrong / trials - FALSE_ALARM) < 0.054, "three standard deviations of the count"
    assert single > 2 * wrong


@pytest.mark.slow
def test_what_one_photograph_excuses_several_do_not(case: lr.simulate.SimulatedCase) -> None:
    found = judged(lr.register(case.scan, case.photo), case.camera_from_scanner)
    audits = {name: replace(found, outcome="wrong", p_value=p) for name, p in (("a", 0.001), ("b", 0.04))}
    audits |= {name: replace(found, outcome="right", p_value=0.5) for name in "cd"}
    together = judged_together(audits)
    assert [one.outcome for one in together.photos.values()] == ["wrong", "right", "right", "right"]
    assert together.p_values["a"] == pytest.approx(0.004)
    assert together.p_values["b"] == pytest.approx(0.12)
    assert "among 4 poses" in together.photos["b"].sentence
    assert together.sentence == "3 of 4 poses are right, 1 wrong."
    assert judged_together({"c": found}, left_out={"x": "why"}).outcome == "undecidable"


@pytest.mark.slow
def test_nothing_stated_is_refused(case: lr.simulate.SimulatedCase) -> None:
    survey = lr.Survey.of([case.scan], [case.photo])
    with pytest.raises(OptionError, match=r"no pose .* 'initial'"):
        audit_survey(survey)
    two = lr.Survey.of([case.scan, replace(case.scan, name="other")], [case.photo])
    stated = StatedPoses(photos={two.photos[0].id: case.camera_from_scanner})
    with pytest.raises(OptionError, match="where any of the scanners stood"):
        audit_survey(two, stated)


@pytest.mark.slow
def test_a_moved_camera_is_found_in_a_survey(case: lr.simulate.SimulatedCase, tmp_path: Path) -> None:
    truth = case.camera_from_scanner @ GRID.inverse
    scan = replace(case.scan, world_from_scanner=GRID)
    photos = [replace(case.photo, name=name) for name in ("right", "moved", "unknown")]
    survey = lr.Survey.of([scan], photos)
    off = moved_pose(truth, np.array([0, 0.01, 0, 0.05, 0, 0]))
    given = dict(zip((one.id for one in survey.photos), (truth, off, None), strict=True))
    prior = PosePrior(pose=off, covariance=np.eye(6))
    survey = replace(
        survey,
        photos=tuple(
            replace(one, prior=prior) if given[one.id] is off else replace(one, initial=given[one.id])
            for one in survey.photos
        ),
    )
    told: list[str] = []
    found = audit_survey(survey, report=lambda progress: told.append(progress.label))
    assert {name: one.outcome for name, one in found.photos.items()} == {"right": "right", "moved": "wrong"}
    assert list(found.left_out) == ["unknown"]
    assert found.outcome == "wrong"
    correction = found.photos["moved"].correction
    assert np.linalg.norm(correction[3:]) == pytest.approx(0.05, abs=0.02)
    fields = found.as_fields()
    assert fields["photos"]["right"]["p_value_of_survey"] > FALSE_ALARM
    assert any(label == "judging moved" for label in told)
