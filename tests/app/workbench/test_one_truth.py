"""The verdict belongs to the matches on the screen: after an edit it is out of date, everywhere."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ladarreg_core.storage.manifest import MANIFEST_FILE
from testing.scenes.true_matches import true_points
from testing.workbench.workbench_driver import WorkbenchDriver, kept_bench, sample_bench


@pytest.fixture
def solved(tmp_path: Path) -> Iterator[WorkbenchDriver]:
    """A workbench whose photograph was solved from 16 right points, with one wrong one."""

    def solve(bench: WorkbenchDriver) -> None:
        for point in true_points(16):
            bench.do("add_pick", photo="p1", **point)
        wrong = true_points(17)[-1]
        wrong["photo_uv"] = [[wrong["photo_uv"][0][0] + 60, wrong["photo_uv"][0][1]]]
        bench.do("add_pick", photo="p1", **wrong)
        job = bench.job("robust")
        assert job.state == "done", job.message

    bench = kept_bench("solved-with-an-outlier", tmp_path / "project", solve)
    yield bench
    bench.workbench.close()


def stage(bench: WorkbenchDriver, name: str = "robust") -> dict[str, Any]:
    return next(stage for stage in bench.slice("poses:p1")["stages"] if stage["stage"] == name)


def ids(bench: WorkbenchDriver) -> list[str]:
    return [pick["id"] for pick in bench.slice("picks:p1")]


def state(bench: WorkbenchDriver) -> str:
    return str(bench.slice("photos")[0]["state"])


@pytest.mark.slow
def test_an_edit_makes_the_verdict_out_of_date_and_undoing_it_makes_it_current_again(solved: WorkbenchDriver) -> None:
    assert stage(solved)["accepted"]
    assert (stage(solved)["stale"], state(solved)) == ("", "accepted")
    names = ids(solved)
    solved.do("set_pick", photo="p1", pick=names[0], photo_uv=[[100, 100]])
    assert stage(solved)["stale"] == "1 match changed since: solve again"
    assert state(solved) == "stale"
    solved.do("set_pick", photo="p1", pick=names[1], on=False)
    solved.do("set_pick", photo="p1", pick=names[2], weight=2)
    solved.do("remove_picks", photo="p1", picks=[names[3]])
    assert stage(solved)["stale"] == "4 matches changed since: solve again"
    for _ in range(4):
        solved.do("undo")
    assert (stage(solved)["stale"], state(solved)) == ("", "accepted")


@pytest.mark.slow
def test_a_new_match_and_the_removal_of_all_leave_no_accepted_pose(solved: WorkbenchDriver) -> None:
    solved.do("add_pick", photo="p1", **true_points(18)[-1])
    assert stage(solved)["stale"] == "1 match changed since: solve again"
    solved.do("remove_picks", photo="p1", picks=ids(solved))
    assert stage(solved)["stale"] == "17 matches changed since: solve again"
    assert state(solved) == "stale"


@pytest.mark.slow
def test_a_match_that_was_disabled_when_solving_may_change(solved: WorkbenchDriver) -> None:
    last = ids(solved)[-1]
    solved.do("set_pick", photo="p1", pick=last, on=False)
    assert solved.job("robust").state == "done"
    solved.do("set_pick", photo="p1", pick=last, photo_uv=[[50, 50]])
    assert stage(solved)["stale"] == ""
    solved.do("set_pick", photo="p1", pick=last, on=True)
    assert stage(solved)["stale"] == "1 match changed since: solve again"


@pytest.mark.slow
def test_a_corrected_match_is_no_longer_an_outlier(solved: WorkbenchDriver) -> None:
    wrong = ids(solved)[-1]

    def inlier() -> Any:
        judged = solved.eventually(lambda: solved.slice("judged:p1"))
        return judged["by_pick"].get(wrong, {}).get("inlier", "unknown")

    solved.eventually(lambda: inlier() is False)
    right = true_points(17)[-1]
    solved.do("set_pick", photo="p1", pick=wrong, photo_uv=right["photo_uv"])
    solved.eventually(lambda: inlier() is None)
    assert solved.job("robust").state == "done"
    solved.eventually(lambda: inlier() is True)


def exported(bench: WorkbenchDriver) -> dict[str, Any]:
    path, _ = bench.workbench.export_file("p1") or (Path(), "")
    with zipfile.ZipFile(path) as file:
        return {name: json.loads(file.read(f"{name}.json")) for name in ("registration", "matches")}


@pytest.mark.long
def test_a_stale_pose_is_exported_only_on_request_with_the_matches_it_rests_on(
    solved: WorkbenchDriver, tmp_path: Path
) -> None:
    before = solved.slice("picks:p1")
    assert solved.job("export").state == "done"
    rests_on = exported(solved)["registration"]["rests_on"]
    assert (rests_on["current"], rests_on["matches"]) == (True, [pick["id"] for pick in before])
    solved.do("remove_picks", photo="p1", picks=ids(solved)[:9])
    said = solved.refused("run", photo="p1", job="export")
    assert "9 matches changed since: solve again" in said
    assert "export the last solved state" in said
    assert said == solved.refused("export_folder", photo="p1", folder=str(tmp_path / "results"))
    solved.do("run", photo="p1", job="export", last_solved=True)
    solved.workbench.runner.wait(120)
    files = exported(solved)
    rests_on = files["registration"]["rests_on"]
    assert (rests_on["current"], rests_on["matches"]) == (False, [pick["id"] for pick in before])
    assert "9 matches of the project changed" in rests_on["sentence"]
    assert [match["id"] for match in files["matches"]["matches"]] == [pick["id"] for pick in before]


def test_matches_without_a_pose_are_exported(fresh: WorkbenchDriver) -> None:
    for point in true_points(2):
        fresh.do("add_pick", photo="p1", **point)
    job = fresh.job("export")
    assert job.state == "done", job.message
    path, _ = fresh.workbench.export_file("p1") or (Path(), "")
    with zipfile.ZipFile(path) as file:
        assert file.namelist() == ["matches.json", MANIFEST_FILE]
        assert len(json.loads(file.read("matches.json"))["matches"]) == 2


@pytest.mark.long
def test_a_comparison_does_not_change_the_chosen_pose(solved: WorkbenchDriver) -> None:
    assert solved.job("linear").state == "done"
    solved.do("use_stage", photo="p1", stage="robust")
    before = stage(solved)
    job = solved.job("compare")
    assert job.state == "done", job.message
    poses = solved.slice("poses:p1")
    assert poses["shown"] == "robust"
    assert len(poses["stages"]) > 2
    assert (stage(solved)["parameters"], stage(solved)["seconds"]) == (before["parameters"], before["seconds"])
    assert "The chosen pose (Robust) is still in use." in job.message


def shifted(bench: WorkbenchDriver, count: int, px: float) -> None:
    """Draw points that are all shifted to the right, as with the wrong one of two similar objects."""
    for point in true_points(count):
        (uv,) = point["photo_uv"]
        bench.do("add_pick", photo="p1", **{**point, "photo_uv": [[uv[0] + px, uv[1]]]})


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[WorkbenchDriver]:
    """A workbench without matches."""
    bench = sample_bench(tmp_path / "project")
    yield bench
    bench.workbench.close()


@pytest.mark.slow
def test_a_pose_that_the_images_contradict_is_not_accepted_whatever_its_statistics(fresh: WorkbenchDriver) -> None:
    shifted(fresh, 16, 30)
    job = fresh.job("solve")
    told = stage(fresh)
    assert fresh.slice("poses:p1")["shown"] == "robust"
    assert (told["summary"]["light"], told["summary"]["words"]) == ("not_accepted", "not accepted")
    assert told["summary"]["next_step"]["stage"] == "refined"
    assert (told["accepted"], told["evidence"], state(fresh)) == (False, "none", "refused")
    assert told["verdict"] == "Not accepted: contradicted by the images."
    assert told["image"]["outcome"] == "contradicted"
    assert "another placement, 30 px in the photo" in told["reasons"][0]
    assert told["reasons"] == [told["image"]["sentence"]]
    assert told["verdict"] in job.message
    (notice,) = [m for m in fresh.received if m.get("event") == "notice"]
    assert (notice["text"], notice["level"]) == (job.message, "warn")
    assert fresh.job("verify").state == "done"
    assert stage(fresh)["reasons"] == told["reasons"], "verifying again changes nothing"
    fresh.do("use_stage", photo="p1", stage="refined")
    assert (stage(fresh, "refined")["summary"]["light"], state(fresh)) == ("verified", "accepted")


@pytest.mark.slow
def test_a_pose_that_is_off_by_little_is_refined_and_the_drawn_one_is_one_press_away(fresh: WorkbenchDriver) -> None:
    shifted(fresh, 16, 0.1)
    job = fresh.job("solve")
    assert job.state == "done", job.message
    assert fresh.slice("poses:p1")["shown"] == "refined"
    told = stage(fresh, "refined")
    assert (told["accepted"], told["evidence"]) == (True, "image")
    assert told["summary"]["other"] == {
        "sentence": "Use the pose as drawn", "action": "use_stage", "stage": "robust"
    }  # fmt: skip
    fresh.do("use_stage", photo="p1", stage="robust")
    assert stage(fresh)["image"]["outcome"] == "verified"
    assert told["steps"][0]["name"] == "matches"
    assert "Compare with the images" in [step["label"] for step in told["steps"]]


@pytest.mark.slow
def test_what_the_statistics_of_a_verified_pose_lack_is_a_note_and_no_reason(fresh: WorkbenchDriver) -> None:
    shifted(fresh, 6, 0)
    assert fresh.job("solve").state == "done"
    told = stage(fresh)
    assert (told["accepted"], told["evidence"]) == (True, "image")
    assert stage(fresh, "refined")["summary"]["matches"] == "6 of 6 matches agree"
    assert not [reason for reason in told["reasons"] if "needed" in reason]
    assert "too few matches agree" in told["note"]
    assert stage(fresh)["stale"] == ""


def test_an_offer_to_undo_undoes_its_own_step_only(fresh: WorkbenchDriver) -> None:
    first, second = (fresh.do("add_pick", photo="p1", **point) for point in true_points(2))
    fresh.do("undo", n=first["n"])
    assert ids(fresh) == [second["pick"]]
    assert "undone already" in fresh.refused("undo", n=first["n"])
    assert "n" not in fresh.do("set_pick", photo="p1", pick=second["pick"], on=True), "nothing changed"
    moved = fresh.do("set_pick", photo="p1", pick=second["pick"], weight=2)
    said = fresh.refused("undo", n=second["n"])
    assert said.startswith("You changed match 2 since ('Weight match 2', ")
    fresh.do("undo", n=moved["n"])
    fresh.do("undo", n=second["n"])
    assert fresh.slice("picks:p1") == []


@pytest.mark.slow
def test_what_was_written_is_that_of_the_shown_pose(solved: WorkbenchDriver) -> None:
    def written() -> dict[str, str]:
        return dict(solved.slice("progress:p1")["exported"])

    before = solved.slice("poses:p1")["shown"]
    solved.do("export", targets=["ply"])
    solved.workbench.runner.wait(240)
    assert written() == {"ply": "scanner"}, "no file of the results was written"
    solved.do("export", targets=["results"])
    solved.workbench.runner.wait(240)
    assert written() == {"ply": "scanner", "results": "scanner"}
    solved.job("linear")
    assert written() == {}, "another pose was not exported"
    solved.do("use_stage", photo="p1", stage=before)
    assert "results" in written()
