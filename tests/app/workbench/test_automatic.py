"""Automatic solving after edits: quiet, newest first, and never in the way of the operator."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from ladarreg_core.project.document import Document
from ladarreg_core.project.history import NOBODY
from testing.scenes.true_matches import true_points
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench, sample_bench


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[WorkbenchDriver]:
    """A workbench that solves by itself."""
    found = sample_bench(tmp_path / "project", solve_automatically=True)
    yield found
    found.workbench.close()


def stages(bench: WorkbenchDriver) -> list[dict[str, Any]]:
    return list(bench.slice("poses:p1")["stages"])


def draw(bench: WorkbenchDriver, count: int, *, begin: int = 0) -> list[str]:
    return [bench.do("add_pick", photo="p1", **point)["pick"] for point in true_points(begin + count)[begin:]]


def solved(bench: WorkbenchDriver) -> dict[str, Any]:
    """Wait until the shown pose belongs to the present matches."""

    def shown() -> dict[str, Any] | None:
        poses = bench.slice("poses:p1")
        return next((s for s in poses["stages"] if s["stage"] == poses["shown"] and s["stale"] == ""), None)

    return dict(bench.eventually(shown))


def labels(bench: WorkbenchDriver) -> list[str]:
    return [entry["label"] for entry in bench.slice("history")["entries"]]


def settled(bench: WorkbenchDriver) -> None:
    """Wait until automatic solving had its chance."""
    time.sleep(0.5)
    bench.eventually(lambda: not bench.slice("solving:p1")["busy"])


@pytest.mark.slow
def test_drawn_matches_are_solved_and_verified_quietly(bench: WorkbenchDriver) -> None:
    draw(bench, 7)
    told = solved(bench)
    assert (told["stage"], told["accepted"], told["evidence"]) == ("refined", True, "image")
    assert told["matches"] == 7
    draw(bench, 1, begin=7)
    bench.eventually(lambda: solved(bench)["matches"] == 8)
    assert labels(bench)[-8:] == [f"Draw point {k}" for k in range(1, 9)], "no steps of its own"
    assert bench.slice("project")["undo"] == "Draw point 8"
    assert bench.slice("job") is None
    assert not [m for m in bench.received if m.get("event") == "notice"]
    bench.do("undo")
    assert [(s["matches"], s["stale"]) for s in stages(bench)] == 2 * [(7, "")], "the poses before the edit are back"
    assert bench.slice("project")["redo"] == "Draw point 8"
    bench.do("redo")
    assert [(s["matches"], s["stale"]) for s in stages(bench)] == 2 * [(8, "")]


@pytest.mark.slow
def test_below_the_minimum_and_above_the_limit_nothing_is_solved(bench: WorkbenchDriver) -> None:
    draw(bench, 3)
    settled(bench)
    assert stages(bench) == []
    bench.do("set_settings", solve_up_to=4)
    draw(bench, 2, begin=3)
    settled(bench)
    assert stages(bench) == []
    bench.do("set_settings", solve_automatically=False, solve_up_to=200)
    draw(bench, 1, begin=5)
    settled(bench)
    assert stages(bench) == []


@pytest.mark.long
def test_a_pose_below_the_minimum_is_out_of_date(bench: WorkbenchDriver) -> None:
    names = draw(bench, 7)
    solved(bench)
    bench.do("remove_picks", photo="p1", picks=names[:5])
    settled(bench)
    assert {stage["stale"] for stage in stages(bench)} == {"5 matches changed since: solve again"}


@pytest.mark.long
def test_a_job_goes_first(bench: WorkbenchDriver) -> None:
    draw(bench, 7)
    solved(bench)
    bench.do("run", photo="p1", job="simplex")
    bench.do("job_control", action="pause")
    bench.do("set_pick", photo="p1", pick="1", weight=2)
    settled(bench)
    assert not any(stage["stale"] == "" for stage in stages(bench)), "it waits for the paused job"
    bench.do("job_control", action="stop")
    assert solved(bench)["stage"] == "refined"


@pytest.mark.slow
def test_a_stage_that_the_operator_chose_stays(bench: WorkbenchDriver) -> None:
    bench.do("set_settings", solve_automatically=False)
    draw(bench, 12)
    assert bench.job("linear").state == "done"
    bench.do("set_settings", solve_automatically=True)
    bench.do("set_pick", photo="p1", pick="1", weight=2)
    settled(bench)
    assert [(s["stage"], s["stale"] == "") for s in stages(bench)] == [("linear", False)]


@pytest.mark.slow
def test_matches_that_determine_no_pose_say_why_and_give_no_verdict(bench: WorkbenchDriver) -> None:
    point = true_points(1)[0]
    for _ in range(5):
        bench.do("add_pick", photo="p1", **point)
    said = bench.eventually(lambda: bench.slice("solving:p1")["sentence"])
    assert stages(bench) == []
    assert "\n" not in said
    bench.do("remove_picks", photo="p1", picks=["1"])
    assert bench.slice("solving:p1")["sentence"] == ""


@pytest.mark.long
def test_moves_of_one_end_stay_one_step_though_they_are_solved_in_between(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ladarreg.session.session._MERGE_WITHIN_S", 3600)  # however slow this computer is
    bench = sample_bench(tmp_path / "project")
    names = draw(bench, 7)
    assert bench.job("solve").state == "done"
    ((u, v),) = bench.slice("picks:p1")[0]["photo"]
    before = len(labels(bench))
    bench.do("set_pick", photo="p1", pick=names[0], photo_uv=[[u + 0.1, v]])
    bench.workbench.session.commit("Solve automatically", _another_pose, author=NOBODY, automatic=True)
    bench.do("set_pick", photo="p1", pick=names[0], photo_uv=[[u + 0.2, v]])
    assert len(labels(bench)) == before + 1
    bench.do("undo")
    assert bench.slice("picks:p1")[0]["photo"] == [[u, v]]
    history = bench.workbench.session.history
    bench.workbench.close()
    again = open_bench(tmp_path / "project")
    assert again.workbench.session.document == history.document
    assert again.slice("project")["redo"] == "Move match 1"
    again.workbench.close()


def _another_pose(document: Document) -> Document:
    (photo,) = document.photos
    changed = replace(photo, poses=tuple(replace(pose, note="in between") for pose in photo.poses))
    return replace(document, photos=(changed,))
