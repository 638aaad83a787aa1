"""The workbench behind the page: edits, history, jobs, files, clients, and the published state."""

from __future__ import annotations

import io
import json
import math
import os
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ladarreg.gateway.protocol import Visitor
from ladarreg.workbench.commands import COMMANDS
from ladarreg.workbench.launch import open_workbench
from PIL import Image

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.formats import read_scan
from ladarreg_core.manifest import MANIFEST_FILE
from ladarreg_core.project.history import NOBODY
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench, sample_bench

LINE = {"kind": "line", "scan": [[1, 0, 0], [1, 0.1, 0.02]], "photo_uv": [[300.25, 200.5], [410.125, 220]]}


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[WorkbenchDriver]:
    found = sample_bench(tmp_path / "project")
    yield found
    found.workbench.close()


@pytest.fixture(scope="module")
def registered(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    """A workbench whose photograph was registered automatically; tests undo their edits."""
    found = sample_bench(tmp_path_factory.mktemp("registered") / "project")
    job = found.job("auto")
    assert job.state == "done", job.message
    yield found
    found.workbench.close()


def saved_picks(bench: WorkbenchDriver) -> list[dict[str, Any]]:
    """Return the picks in project.json."""
    kept = json.loads((bench.workbench.session.folder.path / "project.json").read_bytes())
    return [pick for photo in kept["photos"] for pick in photo["picks"]]


def labels(bench: WorkbenchDriver) -> list[str]:
    return [entry["label"] for entry in bench.slice("history")["entries"]]


def test_a_new_client_receives_all_slices(bench: WorkbenchDriver) -> None:
    slices = bench.workbench.slices(bench.client)
    assert {"project", "scan", "photos", "shown", "picks:p1", "history", "settings", "job", "people", "limits"} <= set(
        slices
    )
    json.dumps(slices, allow_nan=False)
    assert slices["people"]["you"] == bench.client.id
    view = slices["scan"]["views"][0]
    assert view["width"] > 100
    assert slices["photos"][0]["camera"]["fx"] > 100
    for setting in slices["settings"].values():
        assert setting["label"]
        assert setting["kind"] in ("number", "choice", "switch")


def test_edits_are_published_saved_labelled_and_undone(bench: WorkbenchDriver) -> None:
    before = len(labels(bench))
    pick = bench.do("add_pick", photo="p1", **LINE)["pick"]
    (told,) = bench.slice("picks:p1")
    assert told["id"] == pick
    assert told["photo"] == LINE["photo_uv"]
    assert np.linalg.norm(told["scan"], axis=1) == pytest.approx(1)
    bench.do("set_pick", photo="p1", pick=pick, on=False)
    bench.do("set_pick", photo="p1", pick=pick, weight=2.5)
    assert labels(bench)[before:] == ["Draw line 1", "Disable match 1", "Weight match 1"]
    bench.eventually(lambda: [pick["weight"] for pick in saved_picks(bench)] == [2.5])
    assert bench.slice("project")["undo"] == "Weight match 1"
    bench.do("undo")
    bench.do("undo")
    assert bench.slice("picks:p1")[0]["on"]
    assert bench.slice("project")["redo"] == "Disable match 1"
    bench.do("redo")
    assert not bench.slice("picks:p1")[0]["on"]
    bench.do("go_to", n=bench.slice("history")["entries"][0]["n"])
    assert not bench.workbench.session.document.photos


def test_moves_of_one_end_are_merged_into_one_step(bench: WorkbenchDriver) -> None:
    pick = bench.do("add_pick", photo="p1", **LINE)["pick"]
    before = len(labels(bench))
    for k in range(5):
        bench.do("set_pick", photo="p1", pick=pick, photo_uv=[[300 + k / 10, 200], [410, 220]])
    assert labels(bench)[before:] == ["Move match 1"]
    bench.do("undo")
    assert bench.slice("picks:p1")[0]["photo"] == LINE["photo_uv"]


def test_only_changed_slices_are_published(bench: WorkbenchDriver) -> None:
    bench.workbench.slices(bench.client)
    bench.eventually(lambda: "judged:p1" in bench.workbench.slices(bench.client))
    bench.received.clear()
    bench.do("add_pick", photo="p1", **LINE)
    slices = [name for message in bench.received if "slices" in message for name in message["slices"]]
    assert "picks:p1" in slices
    assert "scan" not in slices
    assert "settings" not in slices
    versions = [message["version"] for message in bench.received if "slices" in message]
    assert versions == sorted(set(versions))


@pytest.mark.parametrize(
    ("do", "fields", "says"),
    [
        ("nonsense", {}, "no command"),
        ("add_pick", {"photo": "p9", **LINE}, "no longer in the project"),
        ("add_pick", {"photo": "p1", "kind": "curve"}, "'point' or a 'line'"),
        ("add_pick", {"photo": "p1", "kind": "line", "scan": [[1, 0, 0]], "photo_uv": [[1, 2]]}, "must be 2 x 3"),
        ("add_pick", {"photo": "p1", "kind": "point", "scan": [[0, 0, 0]], "photo_uv": [[1, 2]]}, "zero length"),
        ("add_pick", {"photo": "p1", "kind": "point", "scan": "abc", "photo_uv": [[1, 2]]}, "coordinate"),
        ("set_pick", {"photo": "p1", "pick": "77", "on": True}, "no longer exists"),
        ("set_pick", {"photo": "p1", "pick": "1", "weight": -1}, "positive"),
        ("remove_picks", {"photo": "p1", "picks": []}, "no matches are selected"),
        ("switch_picks", {"photo": "p1", "picks": ["1"], "on": "yes"}, "enabled with true"),
        ("reject", {"photo": "p1", "by": "depth", "above": 0.1}, "solve first"),
        ("reject", {"photo": "p1", "by": "taste", "above": 0.1}, "'depth' or to 'px'"),
        ("set_camera", {"photo": "p1"}, "focal length"),
        ("set_camera", {"photo": "p1", "focal_mm": 35}, "sensor width"),
        ("set_camera", {"photo": "p1", "focal_35mm": 26, "focal_px": 900}, "or pixels"),
        ("set_camera", {"photo": "p1", "focal_px": 5}, "most lenses have 384 to 7680 px"),
        ("set_camera", {"photo": "p1", "focal_mm": 35, "sensor_mm": 36000}, "check the figures"),
        ("set_settings", {"t1": 9}, "t1 is 9; it must be from 0 to 1"),
        ("set_settings", {"seed": 10**400}, "seed is too large"),
        ("set_pick", {"photo": "p1", "pick": 1, "on": True}, "no match is selected"),
        ("set_camera", {"photo": "p1", "focal_px": 10**400}, "must be a positive number"),
        ("open_served", {"path": "a\0b", "what": "scan"}, "no folder is served"),
        ("export_folder", {"photo": "p1", "folder": "/tmp/a\0b"}, "control characters"),
        ("export_folder", {"photo": "p1", "folder": "/tmp/" + "a" * 300}, "too long"),
        ("go_to", {"n": 10**400}, "0 or more"),
        ("rename", {"name": " \n "}, "name"),
        ("go_to", {"n": 999}, "no step 999"),
        ("use_stage", {"photo": "p1", "stage": "simplex"}, "no pose yet"),
        ("set_model", {"texture": "smell"}, "texture"),
        ("open_served", {"path": "../../etc/passwd", "what": "scan"}, "no folder is served"),
        ("predict", {"photo": "p1", "side": "scan", "scan": [[1, 0, 0]]}, "no pose yet"),
        ("run", {"photo": "p1", "job": "dance"}, "no job"),
        ("run", {"photo": "p1", "job": "export"}, None),
        ("job_control", {"action": "pause"}, "no job is running"),
        ("export_folder", {"photo": "p1", "folder": "here"}, "absolute path"),
        ("sample_line", {"scan": [[1, 0, 0]]}, "two ends"),
    ],
)
def test_a_refused_command_returns_a_sentence_and_changes_nothing(
    bench: WorkbenchDriver, do: str, fields: dict[str, Any], says: str | None
) -> None:
    before = bench.workbench.session.document
    if says is None:
        bench.do(do, **fields)
        bench.workbench.runner.wait(60)
        job = bench.workbench.runner.job
        assert job is not None
        assert (job.state, job.message) == (
            "failed",
            "There is nothing to export yet; draw matches and solve, or register automatically.",
        )
    else:
        assert says.lower() in bench.refused(do, **fields).lower()
    assert bench.workbench.session.document is before


def test_invalid_fields_are_never_an_internal_error(bench: WorkbenchDriver) -> None:
    for do in sorted(COMMANDS):
        for junk in ({}, {"photo": 7, "pick": [], "picks": 3, "scan": {}, "at": None, "n": "x"}, {"photo": "p1"}):
            reply = bench.ask(do, **junk)
            assert "Internal error" not in reply.get("error", ""), (do, junk)


# jobs


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


def test_a_pose_predicts_matches_in_both_directions(registered: WorkbenchDriver) -> None:
    pick = registered.slice("picks:p1")[3]
    there = registered.do("predict", photo="p1", side="scan", scan=pick["scan"])["photo_uv"][0]
    assert there == pytest.approx(pick["photo"][0], abs=4)
    back = registered.do("predict", photo="p1", side="photo", photo_uv=pick["photo"])["scan"][0]
    assert np.degrees(np.arccos(np.clip(np.dot(back, pick["scan"][0]), -1, 1))) < 0.5
    assert registered.do("where", photo="p1", scan=[-1, 0, 0])["photo_uv"] is None


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
    assert registered.refused("run", photo="p1", job="robust").startswith("'Simplex' is running")
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


@pytest.mark.parametrize(
    ("path", "query"),
    [("scan", {"view": "9"}), ("scan", {"low": "x"}), ("photo/p7", {}), ("sound", {}), ("scan/..", {})],
)
def test_missing_images_are_errors(registered: WorkbenchDriver, path: str, query: dict[str, str]) -> None:
    with pytest.raises(LadarregError):
        registered.workbench.picture(path, query)


# files


def test_invalid_uploads_are_refused_and_deleted(bench: WorkbenchDriver, tmp_path: Path) -> None:
    room = bench.workbench.upload_folder()
    before = bench.workbench.session.document

    def upload(data: bytes, name: str, what: str) -> str:
        path = room / f"upload-{name}"
        path.write_bytes(data)
        return bench.workbench.take_upload(path, name, what, "p1", bench.client)

    whole = (sample_folder() / "scan.npz").read_bytes()
    picture = next(sample_folder().glob("photo.*")).read_bytes()
    for data, name, what in (
        (b"hello", "a.png", "photo"),
        (picture[: len(picture) // 2], "cut.png", "photo"),
        (whole[:5000], "cut.npz", "scan"),
        (picture, "picture.npz", "scan"),
        (b"{}", "camera.json", "camera"),
        (b"a,b\n1,2\n", "matches.csv", "matches"),
        (picture, "x.png", "virus"),
    ):
        with pytest.raises(LadarregError) as caught:
            upload(data, name, what)
        assert str(bench.workbench.session.folder.path) not in str(caught.value)
    assert bench.workbench.session.document is before
    assert not [path for path in room.iterdir() if path.name.startswith("upload-")], "refused files are deleted"

    second = upload(picture, "second.png", "photo")
    assert second == "p2"
    assert bench.slice("shown") == "p2"


def unviewable_scan(path: Path) -> Path:
    """Write a valid scan of 24 x 36 cells whose rows span a hundredth of a degree."""
    counts = np.random.default_rng(0).integers(100, 200, (24, 36)).astype(np.uint16)
    steps = {"d_azimuth_rad": 0.01, "d_elevation_rad": 1e-5}
    np.savez(path, intensity=np.ones((24, 36), np.float32), counts=counts, r0_m=0.5, dr_m=0.01, **steps)
    return path


def test_a_scan_without_views_is_refused_and_clients_can_still_join(bench: WorkbenchDriver) -> None:
    before = bench.workbench.session.document
    path = unviewable_scan(bench.workbench.upload_folder() / "sliver.npz")
    with pytest.raises(LadarregError, match="no single image resolves") as caught:
        bench.workbench.take_upload(path, "sliver.npz", "scan", None, bench.client)
    assert "\n" not in str(caught.value)
    assert not path.exists()
    assert bench.workbench.session.document is before
    bench.workbench.leave(bench.workbench.join(Visitor("somebody else")))
    assert bench.slice("scan")["views"]


def test_a_project_whose_scan_has_no_views_opens_with_a_message(tmp_path: Path) -> None:
    import msgspec

    bench = sample_bench(tmp_path / "p")
    truth = json.loads((sample_folder() / "truth.json").read_bytes())
    draw_matches(bench, np.array(truth["camera_from_scanner"]))
    job = bench.job("linear")
    assert job.state == "done", job.message
    path = unviewable_scan(bench.workbench.upload_folder() / "sliver.npz")
    source = msgspec.structs.replace(bench.workbench.session.document.scan, path="inputs/sliver.npz", name="sliver")
    bench.workbench.session.commit("Open it", lambda d: msgspec.structs.replace(d, scan=source), author=NOBODY)
    assert path.exists()
    before = bench.workbench.session.history
    bench.workbench.close()

    bench = open_bench(tmp_path / "p")
    try:
        assert bench.workbench.session.document == before.document
        assert labels(bench) == [entry.label for entry in before.entries]
        assert "The scan cannot be shown: the scan's 24 rows span" in bench.slice("project")["opened"]
        assert "which no single image resolves" in bench.slice("scan")["error"]
        assert bench.slice("scan")["views"] == []
        with pytest.raises(LadarregError, match="no single image resolves"):
            bench.workbench.picture("scan", {})
        bench.workbench.leave(bench.workbench.join(Visitor("somebody else")))
        matches = len(bench.slice("picks:p1"))
        bench.do("add_pick", photo="p1", **LINE)
        bench.do("run", photo="p1", job="export", last_solved=True)
        bench.workbench.runner.wait(240)
        job = bench.workbench.runner.job
        assert job is not None
        assert job.state == "done", job.message
        zipped, _ = bench.workbench.export_file("p1") or (None, None)
        assert zipped is not None
        with zipfile.ZipFile(zipped) as file:
            assert len(json.loads(file.read("matches.json"))["matches"]) == matches, "those it was solved on"
        bench.do("undo")
        bench.do("undo")
        assert bench.slice("scan")["views"], "the previous scan is back"
        assert "cannot be shown" not in bench.slice("project")["opened"]
    finally:
        bench.workbench.close()


def draw_matches(bench: WorkbenchDriver, pose: np.ndarray) -> None:
    """Add two dozen exact points."""
    scan = bench.workbench.loader.scan(bench.workbench.session.document)
    camera = bench.workbench.loader.photo(bench.workbench.session.document.photos[0]).camera
    assert scan is not None
    points = scan.points[20::60, 20::60].reshape(-1, 3).astype(float)
    points = points[np.isfinite(points).all(axis=1)]
    uv = camera.project(points @ pose[:3, :3].T + pose[:3, 3])
    seen = np.flatnonzero(camera.contains(uv))
    for k in seen[:: max(1, len(seen) // 24)].tolist():
        bench.do("add_pick", photo="p1", kind="point", scan=[points[k].tolist()], photo_uv=[uv[k].tolist()])


def test_a_failing_listener_affects_neither_commits_nor_other_listeners(bench: WorkbenchDriver) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("a faulty listener")

    bench.workbench.session._listeners.insert(0, fails)
    bench.workbench.subscribe(fails, bench.client)
    path = bench.workbench.upload_folder() / "second.png"
    path.write_bytes(next(sample_folder().glob("photo.*")).read_bytes())
    bench.received.clear()
    assert bench.workbench.take_upload(path, "second.png", "photo", None, bench.client) == "p2"
    assert path.exists()
    assert any("photos" in message.get("slices", {}) for message in bench.received), "other listeners are notified"
    bench.do("add_pick", photo="p2", **LINE)
    bench.workbench.leave(bench.workbench.join(Visitor("somebody else")))


def test_a_file_of_the_project_is_never_deleted(bench: WorkbenchDriver) -> None:
    path = bench.workbench.upload_folder() / "second.png"
    path.write_bytes(next(sample_folder().glob("photo.*")).read_bytes())
    bench.workbench.take_upload(path, "second.png", "photo", None, bench.client)
    bench.do("undo")
    with pytest.raises(LadarregError):
        bench.workbench.take_upload(path, "second.png", "scan", None, bench.client)
    assert path.exists(), "the history refers to it"
    bench.do("redo")
    assert bench.slice("photos")[-1]["width"] > 0


@pytest.mark.skipif(sys.platform != "linux", reason="file names are text here")
def test_a_file_name_that_is_not_unicode_is_not_listed(tmp_path: Path) -> None:
    served = tmp_path / "served"
    served.mkdir()
    name = os.fsdecode(b"b\xfcro.npz")
    (served / name).write_bytes((sample_folder() / "scan.npz").read_bytes())
    bench = open_bench(tmp_path / "project", folder=served)
    try:
        assert bench.slice("served")["files"] == []
        with pytest.raises(OptionError, match="not valid Unicode"):
            bench.workbench.files.open(served / name, name, "scan", None, "")
        assert bench.workbench.session.document.scan is None
        bench.do("rename", name="still works")
    finally:
        bench.workbench.close()


def test_a_photo_without_focal_length_is_shown_and_a_camera_requested(bench: WorkbenchDriver, tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (90, 120, 3), np.uint8)).save(buffer, "PNG")
    path = bench.workbench.upload_folder() / "plain.png"
    path.write_bytes(buffer.getvalue())
    photo = bench.workbench.take_upload(path, "plain.png", "photo", None, bench.client)
    told = bench.slice("photos")[-1]
    assert told["camera"] is None
    assert "focal length" in told["camera_error"]
    assert (told["width"], told["height"]) == (120, 90)
    assert bench.workbench.picture(f"photo/{photo}", {}).data
    assert "focal length" in bench.refused("run", photo=photo, job="robust")
    bench.do("set_camera", photo=photo, focal_mm=35, sensor_mm=36)
    assert bench.slice("photos")[-1]["camera"]["fx"] == pytest.approx(120 * 35 / 36)
    bench.do("set_camera", photo=photo, focal_35mm=26)
    assert bench.slice("photos")[-1]["camera"]["fx"] == pytest.approx(26 * math.hypot(120, 90) / math.hypot(36, 24))


def test_a_served_folder_offers_only_files_below_it(tmp_path: Path) -> None:
    served = tmp_path / "served"
    (served / "deep").mkdir(parents=True)
    for path in sample_folder().iterdir():
        (served / "deep" / path.name).write_bytes(path.read_bytes())
    (served / "notes.txt").write_text("nothing")
    (tmp_path / "secret.png").write_bytes(b"secret")
    bench = open_bench(tmp_path / "project", folder=served)
    try:
        listed = bench.slice("served")
        assert "deep/scan.npz" in [entry["path"] for entry in listed["files"]]
        assert not [entry for entry in listed["files"] if "notes" in entry["path"]]
        bench.do("open_served", path="deep/scan.npz", what="scan")
        assert bench.slice("scan")["rows"] > 10
        for path in ("../secret.png", str(tmp_path / "secret.png"), "deep/../../secret.png", "nothing.png", ""):
            assert "no such file" in bench.refused("open_served", path=path, what="photo")
    finally:
        bench.workbench.close()


def test_hidden_files_of_a_served_folder_are_neither_listed_nor_opened(tmp_path: Path) -> None:
    served = tmp_path / "served"
    scan = (sample_folder() / "scan.npz").read_bytes()
    camera = (sample_folder() / "camera.json").read_bytes()
    secret = "password: correct horse battery staple\n"
    for folder in ("", ".ssh", "deep/.config"):
        (served / folder).mkdir(parents=True, exist_ok=True)
        (served / folder / ".hidden.npz").write_bytes(scan)
        (served / folder / "secret.yaml").write_text(secret)
    (served / ".ssh" / "scan.npz").write_bytes(scan)
    (served / "deep" / ".config" / "camera.json").write_bytes(camera)
    (served / "accounts.json").write_text(json.dumps({"client_secret": "staple"}))
    (served / "notes.csv").write_text("name,password\nme,staple\n")
    (served / "camera.json").write_bytes(camera)
    if sys.platform != "win32":
        (served / "looks-plain.npz").symlink_to(served / ".ssh" / "scan.npz")
        (served / "plain").symlink_to(served / ".ssh")
    bench = open_bench(tmp_path / "project", folder=served)
    try:
        bench.do("list_served")
        assert [entry["path"] for entry in bench.slice("served")["files"]] == ["camera.json"]
        for path in (
            ".hidden.npz", ".ssh/.hidden.npz", ".ssh/scan.npz", "deep/.config/camera.json", "deep/../.ssh/scan.npz",
            "./.ssh/scan.npz", ".ssh/secret.yaml", "secret.yaml", "accounts.json", "notes.csv", "looks-plain.npz",
            "plain/scan.npz", "a\0b.npz", ".", "..", "",
        ):  # fmt: skip
            for what in ("scan", "photo", "camera", "matches"):
                said = bench.refused("open_served", path=path, what=what)
                assert said == "There is no such file in the served folder; refresh the list."
    finally:
        bench.workbench.close()


# clients, crashes, starts


def test_client_names_are_unique(bench: WorkbenchDriver) -> None:
    other = bench.workbench.join(Visitor("elsewhere"))
    assert other.name != bench.client.name
    bench.do("call_me", name="Ann")
    reply = bench.workbench.answer(other, {"id": 1, "do": "call_me", "name": "Ann"})
    assert reply["you"] != "Ann"
    bench.do("add_pick", photo="p1", **LINE)
    assert bench.slice("history")["entries"][-1]["author"] == "Ann"
    assert bench.slice("people")["count"] == 2
    bench.workbench.leave(other)
    assert bench.slice("people")["count"] == 1


_DIES = """
import os, sys
sys.path.insert(0, os.getcwd())
from pathlib import Path
from testing.workbench.workbench_driver import sample_bench
bench = sample_bench(Path(sys.argv[1]))
for k in range(3):
    bench.do("add_pick", photo="p1", kind="point", scan=[[1, k / 20, 0]], photo_uv=[[100 + k, 50]])
bench.do("undo")
print(bench.slice("scan")["id"], bench.slice("photos")[0]["rev"], flush=True)
os.kill(os.getpid(), 9)
"""


@pytest.mark.skipif(os.name == "nt", reason="no kill -9 to send")
def test_a_crash_loses_neither_edits_nor_undo(tmp_path: Path, checkout: Path) -> None:
    died = subprocess.run([sys.executable, "-c", _DIES, str(tmp_path / "p")], cwd=checkout, capture_output=True)
    assert died.returncode == -9, died.stderr.decode()
    bench = open_bench(tmp_path / "p")
    try:
        assert len(bench.slice("picks:p1")) == len(saved_picks(bench)) == 2
        assert bench.slice("project")["opened"].startswith("Reopened scan, last edited at 2")
        names = [bench.slice("scan")["id"], bench.slice("photos")[0]["rev"]]
        assert names == died.stdout.decode().split(), "a page keeps its images"
        bench.do("redo")
        assert [pick["photo"] for pick in bench.slice("picks:p1")] == [[[100 + k, 50]] for k in range(3)]
    finally:
        bench.workbench.close()


def test_a_reopened_project_shows_the_photograph_edited_last(tmp_path: Path) -> None:
    bench = sample_bench(tmp_path / "p")
    path = bench.workbench.upload_folder() / "second.png"
    path.write_bytes(next(sample_folder().glob("photo.*")).read_bytes())
    second = bench.workbench.take_upload(path, "second.png", "photo", None, bench.client)
    worked_on = {}
    for photo in ("p1", second):
        bench.do("add_pick", photo=photo, **LINE)
        bench.do("rename", name=f"Work on {photo}")
        bench.workbench.close()
        bench = open_bench(tmp_path / "p")
        worked_on[photo] = bench.slice("shown")
    bench.workbench.close()
    assert worked_on == {"p1": "p1", second: second}


def test_edits_continue_on_a_full_disk_and_are_saved_later(
    bench: WorkbenchDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ladarreg_core.atomic_write import AppendedFile
    from ladarreg_core.errors import ExportError
    from ladarreg_core.project.folder import ProjectFolder

    def full(*arguments: Any, **options: Any) -> None:
        raise ExportError("cannot write project.json: no space left on device")

    def notices() -> list[str]:
        return [message["text"] for message in bench.received if message.get("event") == "notice"]

    monkeypatch.setattr("ladarreg.session.session.RETRY_S", 0.05)
    for count, (kind, writing) in enumerate(((AppendedFile, "append"), (ProjectFolder, "_replace")), start=1):
        with monkeypatch.context() as patch:
            patch.setattr(kind, writing, full)
            bench.do("add_pick", photo="p1", **LINE)
            bench.eventually(lambda: bench.slice("project")["unsaved"])
            assert bench.do("add_pick", photo="p1", **LINE)["saved"] is False
            assert bench.do("set_model", rays=count == 1)["saved"] is False, "every reply says so"
            assert ["no space" in text for text in notices()] == [True], "and a notice once"
        bench.eventually(lambda: not bench.slice("project")["unsaved"])
        assert notices()[1:] == ["Everything is saved again."], "without another edit"
        bench.received.clear()
        assert "saved" not in bench.do("add_pick", photo="p1", **LINE)
        bench.workbench.session.folder.settle()
        assert len(saved_picks(bench)) == 3 * count, "all edits are saved"


def test_a_project_with_missing_arrays_shows_everything_else(tmp_path: Path) -> None:
    bench = sample_bench(tmp_path / "p")
    bench.do("add_pick", photo="p1", **LINE)
    bench.job("auto")
    picks = bench.slice("picks:p1")
    bench.workbench.close()
    for path in (tmp_path / "p" / "arrays").iterdir():
        path.unlink()
    (tmp_path / "p" / "project.json").unlink()
    bench = open_bench(tmp_path / "p")
    try:
        assert "missing" in bench.slice("project")["amiss"]
        assert bench.slice("scan")["views"]
        assert bench.slice("picks:p1") == picks
        (stage,) = bench.slice("poses:p1")["stages"]
        assert "solve again" in stage["verdict"]
        judged = bench.eventually(lambda: bench.slice("judged:p1"))
        assert list(judged["lines"]) == ["1"], "samples of a line need no pose"
        assert bench.job("auto").state == "done"
        assert bench.slice("poses:p1")["stages"][0]["accepted"] is True
    finally:
        bench.workbench.close()


def test_invalid_inputs_at_the_start_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="no such file"):
        open_workbench([tmp_path / "nothing.npz"], project=tmp_path / "p")
    (tmp_path / "empty").mkdir()
    with pytest.raises(OptionError, match="not a project"):
        open_workbench([tmp_path / "empty"])
    (tmp_path / "bad.npz").write_bytes(b"bad")
    with pytest.raises(LadarregError):
        open_workbench([tmp_path / "bad.npz"], project=tmp_path / "p")
    open_workbench([], project=tmp_path / "p").close()  # the failed start has released the folder


def test_the_project_of_a_scan_is_reopened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LADARREG_HOME", str(tmp_path / "home"))
    scan = sample_folder() / "scan.npz"
    workbench = open_workbench([scan])
    workbench.session.commit("Rename", lambda d: _named(d, "kept"), author=NOBODY)
    place = workbench.session.folder.path
    workbench.close()
    for inputs in ([scan], [place]):
        again = open_workbench(inputs)
        assert again.session.folder.path == place
        assert again.session.document.name == "kept"
        assert read_scan(scan).shape == again.loader.scan(again.session.document).shape  # type: ignore[union-attr]
        again.close()


def _named(document: Any, name: str) -> Any:
    import msgspec

    return msgspec.structs.replace(document, name=name)
