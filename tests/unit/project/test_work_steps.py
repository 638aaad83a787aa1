"""Ticks follow from the document in every state, and every sentence beside them from the same state."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace

from ladarreg_core.project import edits
from ladarreg_core.project.document import Document
from ladarreg_core.project.work_steps import missing_matches, progress_of, stations_step
from testing.scenes.documents import a_document, with_an_answer


def ticks(document: Document, **state: Any) -> dict[str, bool]:
    entry = document.photos[0] if document.photos else None
    return {step.name: step.done for step in progress_of(document, entry, **state).steps}


def judged(document: Document, *, accepted: bool, evidence: str) -> Document:
    """Return the document with another verdict on its pose."""

    def other(photo: Any) -> Any:
        (pose,) = photo.poses
        return replace(photo, poses=(replace(pose, accepted=accepted, evidence=evidence),))

    return edits.edited_photo(document, document.photos[0].id, other)


def test_an_empty_project_has_no_tick() -> None:
    assert not any(ticks(Document()).values())
    assert progress_of(Document(), None).next_action == "Open a scan and a photograph first."


def test_matches_have_their_tick_as_soon_as_they_are_enough() -> None:
    few, enough = a_document(picks=1), a_document(picks=6)
    assert ticks(few)["match"] is (missing_matches(few.photos[0].picks) == "")
    assert ticks(enough) == {"match": True, "solve": False, "judge": False, "export": False}


@pytest.mark.parametrize(
    ("accepted", "evidence", "stale", "done"),
    [
        (True, "image", "", True),
        (True, "statistics", "", True),
        (True, "image", "1 match changed since: solve again", False),
        (False, "none", "", False),
        (False, "given", "", False),
    ],
)
def test_a_pose_has_its_ticks_only_while_it_is_accepted(accepted: bool, evidence: str, stale: str, done: bool) -> None:
    document = judged(with_an_answer(a_document(picks=6)), accepted=accepted, evidence=evidence)
    found = ticks(document, stale=stale)
    assert (found["solve"], found["judge"]) == (done, done)
    assert not found["export"], "nothing was exported"
    assert ticks(document, stale=stale, exported=True)["export"] is (stale == "")


def test_the_status_of_an_export_says_what_was_done() -> None:
    document = with_an_answer(a_document(picks=6))
    for exported, said in ((False, "Not exported yet."), (True, "Exported.")):
        step = progress_of(document, document.photos[0], exported=exported).steps[-1]
        assert (step.status, step.done) == (said, exported)


@pytest.mark.parametrize(
    ("states", "current", "done", "said"),
    [
        (["fixed", "registered"], True, True, "2 stations registered."),
        (["fixed", "registered"], False, False, "2 stations."),
        (["fixed", "out"], True, False, "None of 2 stations registered."),
        (["fixed", "registered", "out"], True, False, "2 of 3 stations registered."),
        (["fixed", "stated"], True, False, "None of 2 stations registered."),
    ],
)
def test_stations_of_a_refused_pair_have_no_tick(states: list[str], current: bool, done: bool, said: str) -> None:
    found = stations_step(states, current=current)
    assert found[:2] == (done, said)
    assert (found[2] == "") == done
