"""The summary of a verdict: its light, its figures and the next step, in every state."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from ladarreg_core.quality.verdict import LIGHT_WORDS, Verdict, verdict_of
from ladarreg_core.results.registration import PoseResult, StageId
from testing.scenes.documents import a_result

CONTRADICTED: dict[str, Any] = {"verification": {"outcome": "contradicted"}}


def summary(stage: StageId = "robust", *, stale: str = "", stages: tuple[StageId, ...] = (), **changes: Any) -> Verdict:
    result = a_result()
    diagnostics = {**result.diagnostics, **changes.pop("diagnostics", {})}
    return verdict_of(replace(result, diagnostics=diagnostics, **changes), stage=stage, stale=stale, stages=stages)


@pytest.mark.parametrize(
    ("accepted", "evidence", "stale", "light"),
    [
        (True, "image", "", "verified"),
        (True, "statistics", "", "matches_only"),
        (False, "given", "", "given"),
        (False, "none", "", "not_accepted"),
        (True, "image", "1 match changed since: solve again", "out_of_date"),
        (True, "statistics", "1 match changed since: solve again", "out_of_date"),
    ],
)
def test_each_state_has_its_own_light(accepted: bool, evidence: str, stale: str, light: str) -> None:
    found = summary(accepted=accepted, evidence=evidence, stale=stale)
    assert found.light == light
    assert set(LIGHT_WORDS) >= {light}
    assert found.line.endswith(".")
    assert found.line.count(". ") == 0, "one line"
    assert found.next_step.sentence


def test_matches_alone_are_never_called_verified() -> None:
    found = summary(accepted=True, evidence="statistics")
    assert "on matches only" in found.line
    assert found.light != "verified"


def test_a_pose_that_was_not_compared_with_the_images_is_not_called_beyond_their_judgement() -> None:
    alone = summary(accepted=True, evidence="statistics")
    assert "not compared with the images" in alone.line
    assert alone.next_step.action == "verify"
    judged = summary(accepted=True, evidence="statistics", diagnostics={"verification": {"outcome": "undecidable"}})
    assert "could not judge" in judged.line
    assert judged.next_step.action == ""


def test_the_position_is_the_sigma_that_the_result_states_and_matches_are_counted_as_such() -> None:
    result = a_result()
    found = verdict_of(result, stage="robust")
    value, unit = re.fullmatch(r"([\d.]+) (mm|m)", found.position).groups()  # type: ignore[union-attr]
    assert float(value) * {"mm": 1e-3, "m": 1.0}[unit] == pytest.approx(result.sigma_position_m, rel=0.06)
    assert found.matches == "35 of 40 matches agree"
    assert found.pixels == "", "nothing is said before it is computed"


def test_a_contradicted_pose_offers_that_of_the_images() -> None:
    refused: dict[str, Any] = {"accepted": False, "evidence": "none", "diagnostics": CONTRADICTED}
    found = summary(stages=("robust", "refined"), **refused)
    assert (found.next_step.action, found.next_step.stage, found.other) == ("use_stage", "refined", None)
    assert summary(**refused).next_step.action != "use_stage", "there is nothing to use"


def test_a_refined_pose_offers_the_drawn_one_and_the_other_way_round() -> None:
    good: dict[str, Any] = {"accepted": True, "evidence": "image"}
    stages: tuple[StageId, ...] = ("robust", "refined")
    for stage, other in (("refined", "robust"), ("robust", "refined")):
        found = summary(stage, stages=stages, **good)  # type: ignore[arg-type]
        assert found.other is not None
        assert found.other.stage == other
    assert summary("refined", stages=stages, stale="1 match changed", **good).other is None


def test_where_nothing_agrees_it_asks_whether_the_pair_is_right() -> None:
    result: PoseResult = a_result()
    none = replace(result, accepted=False, evidence="none", inliers=result.inliers & False)
    diagnostics = {**result.diagnostics, "verification": {"fraction": 0.05}}
    found = verdict_of(replace(none, diagnostics=diagnostics), stage="auto")
    assert "right pair" in found.next_step.sentence
    assert "right pair" not in summary(accepted=False, evidence="none").next_step.sentence
