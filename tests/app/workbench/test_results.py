"""Jobs of the workbench, their results, and the pictures of these."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.errors import LadarregError
from ladarreg_core.storage.manifest import MANIFEST_FILE
from testing.workbench.workbench_driver import WorkbenchDriver, sample_bench

LINE = {"kind": "line", "scan": [[1, 0, 0], [1, 0.1, 0.02]], "photo_uv": [[300.25, 200.5], [410.125, 220]]}


@pytest.fixture(scope="module")
def registered(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    """A workbench whose photograph was registered automatically; tests undo their edits."""
    found = sample_bench(tmp_path_factory.mktemp("registered") / "project")
    job = found.job("auto")
    assert job.state == "done", job.message
    yield found
    found.workbench.close()


def labels(bench: WorkbenchDriver) -> list[str]:
    return [entry["label"] for entry in bench.slice("history")["entries"]]


@pytest.mark.slow
def test_a_registration_yields_matches_a_pose_and_a_verdict(registered: WorkbenchDriver) -> None:
    picks = registered.slice("picks:p1")
    assert len(picks) > 30
    assert {pick["origin"] for pick in picks} == {"auto"}
    assert registered.slice("photos")[0]["state"] == "accepted"
    (stage,) = registered.eventually(lambda: registered.slice("poses:p1")["stages"])
    assert stage["accepted"]
    assert stage["verdict"].startswith("Accepted")
    assert [p["name"] for p in stage["parameters"]] == ["Tx", "Ty", "Tz", "alpha", "beta", "gamma"]
    judged = registered.eventually(lambda: (registered.slice("judged:p1") or {}).get("by_pick"))
    assert len(judged) > 0.9 * len(picks)
    assert np.median([said["px"] for said in judged.values()]) < 1.5
    job = registered.slice("job")
    assert job["state"] == "done"
    assert [step["name"] for step in job["steps"]][:1] == ["photo"]


@pytest.mark.slow
def test_a_pose_predicts_matches_in_both_directions(registered: WorkbenchDriver) -> None:
    pick = registered.slice("picks:p1")[3]
    there = registered.do("predict", photo="p1", side="scan", scan=pick["scan"])["photo_uv"][0]
    assert there == pytest.approx(pick["photo"][0], abs=4)
    back = registered.do("predict", photo="p1", side="photo", photo_uv=pick["photo"])["scan"][0]
    assert np.degrees(np.arccos(np.clip(np.dot(back, pick["scan"][0]), -1, 1))) < 0.5
    assert registered.do("where", photo="p1", scan=[-1, 0, 0])["photo_uv"] is None


@pytest.mark.slow
def test_a_threshold_disables_matches_above_and_enables_those_below(registered: WorkbenchDriver) -> None:
    registered.eventually(lambda: (registered.slice("judged:p1") or {}).get("by_pick"))
    judged = registered.slice("judged:p1")["by_pick"]
    px = sorted(said["px"] for said in judged.values())
    above = px[len(px) // 2]
    reply = registered.do("reject", photo="p1", by="px", above=above)
    on = {pick["id"]: pick["on"] for pick in registered.slice("picks:p1")}
    for name, said in judged.items():
        assert on[name] == (said["px"] <= above)
    assert reply["off"] == sum(said["px"] > above for said in judged.values())
    registered.do("undo")


def waits_of_a_paused_job(bench: WorkbenchDriver, monkeypatch: pytest.MonkeyPatch) -> list[None]:
    """Return a list that grows whenever the present job finds that it is paused."""
    looked: list[None] = []
    context = bench.workbench.runner._context
    assert context is not None
    wait = context._resumed.wait
    monkeypatch.setattr(context._resumed, "wait", lambda seconds: looked.append(None) or wait(seconds))
    return looked


@pytest.mark.slow
def test_the_simplex_can_be_watched_paused_and_stopped(
    registered: WorkbenchDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    registered.received.clear()
    registered.do("run", photo="p1", job="simplex")
    events = lambda: [m for m in registered.received if m.get("event") == "simplex"]  # noqa: E731
    registered.eventually(lambda: len(events()) > 3)
    looked = waits_of_a_paused_job(registered, monkeypatch)
    registered.do("job_control", action="pause")
    registered.eventually(lambda: looked)
    seen, before = len(events()), len(looked)
    registered.eventually(lambda: len(looked) > before + 5)
    assert len(events()) <= seen + 1
    assert registered.slice("job")["state"] == "paused"
    registered.do("job_control", action="step")
    registered.eventually(lambda: len(events()) > seen)
    waits = registered.do("run", photo="p1", job="robust")["job"]
    assert [(each["id"], each["label"]) for each in registered.slice("job")["waiting"]] == [(waits, "Robust solution")]
    registered.do("job_control", action="stop", job=waits)
    registered.do("job_control", action="stop")
    registered.workbench.runner.wait(60)
    job = registered.workbench.runner.job
    assert job is not None
    assert job.state == "stopped"
    assert "best pose so far is kept" in job.message
    last = events()[-1]
    assert last["last"]
    assert len(last["parameters"]) == 6
    costs = [event["cost"] for event in events()]
    assert costs == sorted(costs, reverse=True), "the cost of the best vertex never rises within one descent"
    assert registered.slice("photos")[0]["state"] in ("solved", "accepted", "refused")
    assert "simplex" in [stage.stage for stage in registered.workbench.session.document.photos[0].poses]
    registered.do("undo")


@pytest.mark.slow
def test_the_simplex_job_equals_the_estimator(registered: WorkbenchDriver) -> None:
    from dataclasses import replace

    from ladarreg_core.pose.estimate import solve_pose

    job = registered.job("reject_outliers", speed=0)
    assert job.state == "done", job.message
    entry = registered.workbench.session.document.photos[0].stage("simplex_outliers_removed")
    assert entry is not None
    inputs = registered.workbench.jobs._workspace.inputs("p1")
    options = replace(inputs.settings.pose_options, intrinsics="fixed", method="epipolar_simplex")
    alone = solve_pose(inputs.matches(), inputs.photo.camera, options)
    np.testing.assert_array_equal(alone.camera_from_scanner.matrix, np.array(entry.camera_from_scanner))
    np.testing.assert_allclose(alone.covariance, np.array(entry.covariance), rtol=1e-9)
    registered.do("undo")


@pytest.mark.slow
def test_a_result_is_discarded_if_its_inputs_have_changed(registered: WorkbenchDriver) -> None:
    registered.do("run", photo="p1", job="simplex")
    pick = registered.do("add_pick", photo="p1", **LINE)["pick"]
    registered.do("job_control", action="speed", value=0)
    registered.workbench.runner.wait(120)
    job = registered.workbench.runner.job
    assert job is not None
    assert job.state == "failed"
    assert "changed while the job ran" in job.message
    registered.do("undo")
    assert pick not in [entry["id"] for entry in registered.slice("picks:p1")]


def test_a_solver_explains_missing_matches(bench: WorkbenchDriver) -> None:
    assert "draw some" in bench.job("robust").message
    pick = bench.do("add_pick", photo="p1", kind="point", scan=[[0, 0, 1]], photo_uv=[[3, 4]])["pick"]
    job = bench.job("linear")
    assert (job.state, "no match lies where the scan has a range" in job.message.lower()) == ("failed", True)
    bench.do("switch_picks", photo="p1", picks=[pick], on=False)
    assert bench.job("robust").message == "The only match is disabled; enable it in the match table."


@pytest.mark.slow
def test_a_zip_holds_the_files_of_the_command_line(registered: WorkbenchDriver) -> None:
    registered.received.clear()
    job = registered.job("export")
    assert job.state == "done", job.message
    (ready,) = [m for m in registered.received if m.get("event") == "export_ready"]
    assert ready["url"] == "export/p1.zip"
    path, name = registered.workbench.export_file("p1") or (Path(), "")
    assert name.endswith(".zip")
    with zipfile.ZipFile(path) as file:
        assert file.testzip() is None
        assert set(file.namelist()) == {
            "registration.json", "report.html", "registered.png", "labels.png", "visibility.png", "uncertainty.png",
            "model.glb", "cloud.ply",
            "matches.json", MANIFEST_FILE,
        }  # fmt: skip
        told = json.loads(file.read("registration.json"))
    assert told["accepted"]
    assert {entry["name"] for entry in told["inputs"]} >= {"scan.npz"}


@pytest.mark.long
def test_an_export_replaces_a_folder_of_results_only_by_force(registered: WorkbenchDriver, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    registered.do("export_folder", photo="p1", folder=str(folder))
    registered.workbench.runner.wait(120)
    assert (folder / "registration.json").is_file()
    assert "contains earlier results" in registered.refused("export_folder", photo="p1", folder=str(folder))
    model = (folder / "model.glb").read_bytes()
    (folder / "model.glb").write_bytes(b"mine")
    said = registered.refused("export_folder", photo="p1", folder=str(folder), force=True)
    assert "model.glb, changed since ladarreg wrote it" in said
    (folder / "model.glb").write_bytes(model)
    before = (folder / "model.glb").stat().st_ino
    registered.do("export_folder", photo="p1", folder=str(folder), force=True)
    registered.workbench.runner.wait(120)
    assert (folder / "model.glb").stat().st_ino != before
    assert [path.name for path in tmp_path.iterdir()] == ["results"]


def test_a_folder_of_photographs_and_the_project_itself_are_never_replaced(
    registered: WorkbenchDriver, tmp_path: Path
) -> None:
    project = registered.workbench.session.folder.path
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    (photographs / "IMG_0001.jpg").write_bytes(b"precious")
    (tmp_path / "link").symlink_to(project.parent)
    for folder, said in (
        (photographs, "contains IMG_0001.jpg, which"),
        (project, "is a project"),
        (project.parent, "contains the project"),
        (project / "exports", "lies in the project"),
        (tmp_path / "link" / "project", "is a project"),
        (project / "arrays" / "..", "is a project"),
    ):
        for force in (True, False):
            assert said in registered.refused("export_folder", photo="p1", folder=str(folder), force=force)
    for odd in ("/" + "x" * 5000, "/a\0b", "/\ud800"):
        registered.refused("export_folder", photo="p1", folder=odd, force=True)
    assert (photographs / "IMG_0001.jpg").read_bytes() == b"precious"
    assert (project / "project.json").is_file()
    assert not list(project.glob("exports/.*"))


@pytest.mark.parametrize(
    ("path", "query"),
    [
        ("scan", {}),
        ("scan", {"show": "normals", "view": "0"}),
        ("photo/p1", {}),
        ("overlay/p1", {"show": "edges"}),
        ("registered/p1", {}),
        ("registered/p1", {"z_buffer": "0"}),
    ],
)
def test_images_are_rendered_in_the_right_size(registered: WorkbenchDriver, path: str, query: dict[str, str]) -> None:
    found = registered.workbench.picture(path, query)
    image = Image.open(io.BytesIO(found.data))
    scan, photo = registered.slice("scan")["views"][0], registered.slice("photos")[0]
    of_scan = path.startswith(("scan", "registered"))
    assert image.size == ((scan["width"], scan["height"]) if of_scan else (photo["width"], photo["height"]))
    assert registered.workbench.picture(path, query).etag == found.etag


def test_the_first_image_of_the_scan_is_rendered_once(registered: WorkbenchDriver) -> None:
    asked = {"show": "intensity", "low": "1", "high": "99.5", "equalise": "0", "gamma": "0.6", "view": "0", "rev": "7"}
    first = registered.workbench.picture("scan", {})
    assert registered.workbench.picture("scan", asked) is first, "explicit default values are the same request"
    assert registered.workbench.picture("scan", {**asked, "gamma": "1"}) is not first


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "query"),
    [("scan", {"view": "9"}), ("scan", {"low": "x"}), ("photo/p7", {}), ("sound", {}), ("scan/..", {})],
)
def test_missing_images_are_errors(registered: WorkbenchDriver, path: str, query: dict[str, str]) -> None:
    with pytest.raises(LadarregError):
        registered.workbench.picture(path, query)
