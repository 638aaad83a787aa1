"""A project and results saved by version 0.1 open in the present one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.formats.documents.registration_file import read_registration
from ladarreg_core.project.document import Document
from ladarreg_core.project.results import registration_of
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench

SAVED = Path(__file__).parent / "saved_by_0_1"
STEPS = [
    "Begin",
    "Open scan desk.npz",
    "Open photograph desk.jpg",
    "Camera file camera.json",
    *(f"Draw point {number}" for number in range(1, 14)),
    *(f"Draw line {number}" for number in range(14, 17)),
    "Solve: linear",
    "Solve: simplex",
    "Solve: robust",
    "Register automatically: 14 matches",
    "Set t1",
    "Rename to Desk by the window",
    "Switch off a match",
    "Remove a match",
]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[WorkbenchDriver]:
    found = open_bench(shutil.copytree(SAVED / "project", tmp_path / "project"))
    yield found
    found.workbench.close()


def document(bench: WorkbenchDriver) -> Document:
    return bench.workbench.session.document


def labels(bench: WorkbenchDriver) -> list[str]:
    return [entry["label"] for entry in bench.slice("history")["entries"]]


def picks(bench: WorkbenchDriver) -> dict[int, dict[str, Any]]:
    return {pick["number"]: pick for pick in bench.slice("picks:p1")}


def test_the_document_opens_as_it_was_saved(bench: WorkbenchDriver) -> None:
    project = bench.slice("project")
    assert project["name"] == "Desk by the window"
    assert project["amiss"] == ""
    assert (project["undo"], project["redo"]) == ("Switch off a match", "Remove a match")
    scan = bench.slice("scan")
    assert (scan["rows"], scan["columns"], scan["returns"]) == (175, 250, 43749)
    (photo,) = bench.slice("photos")
    assert (photo["name"], photo["state"], photo["width"], photo["height"]) == ("desk.jpg", "accepted", 384, 256)
    assert photo["camera"]["fx"] == 487.0
    assert bench.slice("settings")["t1"]["value"] == 0.15
    saved = json.loads((SAVED / "project" / "project.json").read_bytes())
    assert [pick["id"] for pick in picks(bench).values()] == [pick["id"] for pick in saved["photos"][0]["picks"]]
    assert [number for number, pick in picks(bench).items() if not pick["on"]] == [6]
    assert sum(pick["kind"] == "line" for pick in picks(bench).values()) == 3


def test_its_answers_are_shown_with_their_verdicts(bench: WorkbenchDriver) -> None:
    poses = bench.slice("poses:p1")
    assert poses["shown"] == "auto"
    verdicts = {stage["stage"]: (stage["accepted"], stage["evidence"]) for stage in poses["stages"]}
    assert set(verdicts) == {"linear", "simplex", "robust", "auto"}
    assert verdicts["robust"] == (True, "statistics")
    assert verdicts["auto"] == (True, "image")
    assert not verdicts["linear"][0]
    for entry in document(bench).photos[0].poses:
        result = registration_of(entry)
        assert len(result.matches) == len(result.inliers) > 0
        assert result.reasons == entry.reasons


@pytest.mark.slow
def test_its_history_can_be_walked_to_both_ends(bench: WorkbenchDriver) -> None:
    assert labels(bench) == STEPS
    assert len(STEPS) == 28
    saved = document(bench)
    for _ in range(26):
        bench.do("undo")
    assert bench.slice("project")["undo"] is None
    assert document(bench).scan is None
    for _ in range(27):
        bench.do("redo")
    assert bench.slice("project")["redo"] is None
    assert 3 not in picks(bench)
    bench.do("undo")
    assert document(bench) == saved
    bench.do("go_to", n=16)
    assert len(picks(bench)) == 13
    assert document(bench).photos[0].poses == ()


def test_work_goes_on_and_is_saved(tmp_path: Path) -> None:
    folder = shutil.copytree(SAVED / "project", tmp_path / "project")
    bench = open_bench(folder)
    try:
        bench.do("rename", name="Desk again")
        assert labels(bench) == [*STEPS[:-1], "Rename to Desk again"]
        job = bench.job("linear")
        assert job.state == "done", job.said
        expected, expected_labels = document(bench), labels(bench)
    finally:
        bench.workbench.close()
    again = open_bench(folder)
    try:
        assert document(again) == expected
        assert labels(again) == expected_labels
    finally:
        again.workbench.close()


@pytest.mark.long
def test_its_registration_is_an_initial_pose(bench: WorkbenchDriver) -> None:
    pose = read_pose(SAVED / "registration.json")
    saved = next(entry for entry in document(bench).photos[0].poses if entry.stage == "auto")
    assert np.abs(pose.matrix - saved.camera_from_scanner).max() < 0.02
    registration = read_registration(SAVED / "registration.json")
    assert (registration.accepted, registration.evidence) == (True, "image")
    inputs = SAVED / "project" / "inputs"
    scan = lr.read_scan(inputs / "desk.npz")
    photo = lr.read_photo(inputs / "desk.jpg", camera=inputs / "camera.json")
    drawn = [pick.as_pick() for pick in document(bench).photos[0].picks]
    found = lr.register(scan, photo, method="manual", picks=drawn, initial=pose)
    assert found.accepted
    assert np.linalg.norm(found.camera_from_scanner.centre - pose.centre) < 0.02
