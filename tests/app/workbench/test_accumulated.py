"""Several clouds of one standpoint are one scan of a project; further ones are added without loss."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from ladarreg.session.exported import exported_pose
from ladarreg.workbench.given_files import Reading
from ladarreg.workbench.launch import open_workbench

from ladarreg_core.errors import LadarregError
from ladarreg_core.export.json import find_inputs, registration_document, write_document
from ladarreg_core.formats import read_scan
from ladarreg_core.project import edits
from ladarreg_core.project.history import NOBODY
from testing.scenes.room_frames import CAMERA, PHOTO, elsewhere, frame, room_matches, write_frames
from testing.scenes.small_registration import sample_registration
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench
from tests.app.workbench.test_batches import drop, kinds, waiting


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[WorkbenchDriver]:
    """A project with a cloud, a photograph and drawn matches, and a served folder with more clouds."""
    served = tmp_path / "served"
    served.mkdir()
    first, *_ = write_frames(served, 3)
    (served / "far.npz").write_bytes(elsewhere())
    found = open_bench(tmp_path / "project", first, PHOTO, camera=CAMERA, folder=served)
    for match in room_matches():
        found.do("add_pick", photo="p1", **match)
    yield found
    found.workbench.close()


def results(bench: WorkbenchDriver) -> dict[str, Any]:
    """Return the `registration.json` that an export would contain."""
    workbench = bench.workbench
    document, scan = workbench.session.document, workbench.loader.scan(workbench.session.document)
    assert scan is not None
    folder = workbench.session.folder
    return exported_pose(workbench.loader, folder, document, document.photos[0], scan).document()


def work(bench: WorkbenchDriver) -> Any:
    return bench.slice("picks:p1"), [photo["name"] for photo in bench.slice("photos")]


@pytest.mark.slow
def test_clouds_that_are_added_later_leave_matches_and_photos_as_they_are(tmp_path: Path) -> None:
    first, second, third = write_frames(tmp_path, 3)
    project = tmp_path / "project"
    workbench = open_workbench([first, second, PHOTO], project=project)
    try:
        document = workbench.session.document
        assert document.scan is not None
        assert document.scan.more == (str(second),)
        scan = workbench.loader.scan(document)
        assert scan is not None
        assert scan.valid.sum() == read_scan(first, more=[second]).valid.sum()
        named = workbench.session.folder.scan_options(document.scan)["more"]
        assert named == (second,)  # what an export records, with a checksum of each file
        (photo,) = document.photos
        drawn = edits.PickEntry(id="k1", number=1, kind="point", scan=((1.0, 0.0, 0.0),), photo=((20.0, 30.0),))
        workbench.session.commit(
            "Draw",
            lambda d: edits.edited_photo(d, photo.id, lambda p: msgspec.structs.replace(p, picks=(drawn,))),
            author=NOBODY,
        )
    finally:
        workbench.close()
    reopened = open_workbench([third, second, PHOTO], project=project)  # the first one need not be named again
    try:
        document = reopened.session.document
        assert document.scan is not None
        assert document.scan.more == (str(second), str(third))
        assert [p.picks for p in document.photos] == [(drawn,)]
        grown = reopened.loader.scan(document)
        assert grown is not None
        assert grown.valid.sum() > scan.valid.sum()
        (tmp_path / "bad.npz").write_bytes(frame(1)[:900])
        for wrong in (tmp_path / "bad.npz", second):
            with pytest.raises(LadarregError):
                reopened.files.open_scans([(wrong, wrong.name)], "frames", None)
        assert reopened.session.document == document
        reopened.session.undo()
        before = reopened.session.document
        assert before.scan is not None
        assert before.scan.more == (str(second),)
        assert [p.picks for p in before.photos] == [(drawn,)]
    finally:
        reopened.close()


def _result(folder: Path, scan: Path, *more: Path) -> Path:
    """Write a result that is no more than its pose and what it was made of."""
    document = registration_document(sample_registration(), inputs=[scan, PHOTO, *more], read_with=[{"more": more}, {}])
    write_document(folder / "registration.json", document)
    return folder / "registration.json"


@pytest.mark.slow
def test_an_earlier_result_says_which_clouds_belong_to_the_scan(tmp_path: Path) -> None:
    first, second, third = write_frames(tmp_path, 3)
    (tmp_path / "out").mkdir()
    initial = _result(tmp_path / "out", first, second, third)
    workbench = open_workbench([first, PHOTO], project=tmp_path / "project", reading=Reading(initial=initial))
    try:
        assert workbench.session.document.scan is not None
        assert workbench.session.document.scan.more == (str(second), str(third))
        assert not workbench.opening_remarks
    finally:
        workbench.close()
    third.unlink()
    workbench = open_workbench([first, PHOTO], project=tmp_path / "other", reading=Reading(initial=initial))
    try:
        assert workbench.session.document.scan is not None
        assert workbench.session.document.scan.more == (str(second),)
        assert "3 accumulated clouds; sweep2.npz was not found" in " ".join(workbench.opening_remarks)
    finally:
        workbench.close()


@pytest.mark.slow
def test_a_scan_that_replaces_another_is_said_and_comes_back(tmp_path: Path) -> None:
    first, second, _ = write_frames(tmp_path, 3)
    open_workbench([first, PHOTO], project=tmp_path / "project").close()
    workbench = open_workbench([second, PHOTO], project=tmp_path / "project")
    try:
        (remark,) = workbench.opening_remarks
        assert f"{first.name}, was replaced by {second.name}" in remark
        assert "Undo" in remark
        assert remark in workbench.opening_message
        workbench.session.undo()
        assert workbench.session.document.scan is not None
        assert workbench.session.document.scan.name == first.name
    finally:
        workbench.close()


@pytest.mark.slow
def test_dropped_frames_are_one_step_and_named_as_they_were_dropped(bench: WorkbenchDriver, tmp_path: Path) -> None:
    before = work(bench)
    assert bench.slice("scan")["files"] == ["sweep0.npz"]
    reply = drop(bench, {"sweep10.npz": frame(10), "sweep2.npz": frame(2)})
    assert (reply["asks"], reply["scans"], reply["opened"]) == ("scan", ["sweep2.npz", "sweep10.npz"], [])
    assert work(bench) == before
    steps = len(bench.slice("history")["entries"])
    reply = bench.do("open_files", files=reply["waiting"], scan="frames")
    assert kinds(reply) == ["frame", "frame"]
    assert bench.slice("scan")["files"] == ["sweep0.npz", "sweep2.npz", "sweep10.npz"]
    assert work(bench) == before
    entries = bench.slice("history")["entries"]
    assert [entry["label"] for entry in entries[steps:]] == ["Add 2 frames"]
    hidden = [Path(path).stem for path in bench.workbench.session.document.scan.more]  # type: ignore[union-attr]
    assert not any(name in json.dumps(bench.slice("scan")) for name in hidden), "uploads have random names"
    assert bench.job("robust").state == "done"
    written = results(bench)
    assert [one["name"] for one in written["inputs"]] == [
        "sweep0.npz", "photo.png", "camera.json", "sweep2.npz", "sweep10.npz"
    ]  # fmt: skip
    assert written["inputs"][0]["read_with"]["more"] == ["sweep2.npz", "sweep10.npz"]
    as_dropped, uploaded = tmp_path / "as dropped", bench.workbench.upload_folder()
    as_dropped.mkdir()
    for name, seed in (("sweep2.npz", 2), ("sweep10.npz", 10)):
        (as_dropped / name).write_bytes(frame(seed))
    for folder in (as_dropped, uploaded):
        found = find_inputs(written["inputs"][3:], [folder])
        assert [path.read_bytes() for path in found] == [frame(2), frame(10)]
    for _ in range(2):
        bench.do("undo")
    assert bench.slice("scan")["files"] == ["sweep0.npz"]
    assert work(bench) == before


@pytest.mark.slow
def test_a_frame_from_elsewhere_asks_again_and_can_be_a_station(bench: WorkbenchDriver) -> None:
    before, steps = work(bench), len(bench.slice("history")["entries"])
    ids = drop(bench, {"sweep2.npz": frame(2), "yard.npz": elsewhere()})["waiting"]
    reply = bench.do("open_files", files=ids, scan="frames")
    assert reply["asks"] == "scan"
    assert reply["said"].startswith("yard.npz was not taken from where sweep0.npz was: ")
    assert set(waiting(bench)) == {"sweep2.npz", "yard.npz"}
    assert (work(bench), len(bench.slice("history")["entries"])) == (before, steps)
    assert kinds(bench.do("open_files", files=reply["waiting"], scan="stations")) == ["station", "station"]
    names = [station["name"] for station in bench.slice("stations")["stations"]]
    assert names == ["sweep0.npz", "sweep2.npz", "yard.npz"]
    assert len(bench.slice("history")["entries"]) == steps + 1
    assert work(bench) == before
    assert bench.slice("waiting") == []


@pytest.mark.slow
def test_frames_that_are_there_already_are_left_out(bench: WorkbenchDriver) -> None:
    ids = drop(bench, {"again.npz": frame(0), "sweep1.npz": frame(1), "copy.npz": frame(1)})["waiting"]
    assert len(bench.do("open_files", files=ids, scan="frames")["opened"]) == 3
    assert bench.slice("scan")["files"] == ["sweep0.npz", "copy.npz"]
    assert len(list(bench.workbench.upload_folder().glob("*.npz"))) == 1
    ids = drop(bench, {"again.npz": frame(0)})["waiting"]
    assert "part of the scan already" in bench.do("open_files", files=ids, scan="frames")["said"]


@pytest.mark.slow
@pytest.mark.parametrize("how", ["frames", "stations", "replace"])
def test_several_clouds_in_an_empty_project(tmp_path: Path, how: str) -> None:
    bench = open_bench(tmp_path / "project")
    reply = drop(bench, {"b.npz": frame(1), "a.npz": frame(0), "photo.png": PHOTO.read_bytes()})
    assert (reply["asks"], reply["scans"], reply["opened"]) == ("scan", ["a.npz", "b.npz"], [])
    assert waiting(bench)["a.npz"].startswith("one of 2 scans, a.npz and b.npz: ")
    reply = bench.do("open_files", files=reply["waiting"], scan=how)
    assert kinds(reply)[-1] == "photo"
    assert bench.slice("scan")["name"] == "a.npz"
    if how == "stations":
        assert [one["name"] for one in bench.slice("stations")["stations"]] == ["a.npz", "b.npz"]
        assert bench.slice("scan")["files"] == ["a.npz"]
    else:
        assert bench.slice("scan")["files"] == ["a.npz", "b.npz"]
    assert bench.slice("project")["name"] == "a"
    bench.workbench.close()


@pytest.mark.slow
def test_scans_of_the_served_folder_ask_as_well(bench: WorkbenchDriver) -> None:
    before = work(bench)
    asked = bench.do("open_served", path="sweep1.npz", what="scan")
    assert (asked["asks"], asked["scans"]) == ("scan", ["sweep1.npz"])
    assert work(bench) == before
    refused = bench.do("open_served", paths=["sweep1.npz", "far.npz"], what="scan", scan="frames")
    assert (refused["asks"], refused["said"].partition(" was not")[0]) == ("scan", "far.npz")
    assert "frames, stations" in bench.refused("open_served", path="sweep1.npz", what="scan", scan="both")
    assert "no such file" in bench.refused("open_served", paths=["sweep1.npz", "none.npz"], what="scan", scan="frames")
    bench.do("open_served", paths=["sweep1.npz", "sweep2.npz"], what="scan", scan="frames")
    assert bench.slice("scan")["files"] == ["sweep0.npz", "sweep1.npz", "sweep2.npz"]
    assert work(bench) == before
    assert "part of the scan" in bench.do("open_served", path="sweep1.npz", what="scan", scan="frames")["said"]
    assert "in the project already" in bench.refused("open_served", path="sweep1.npz", what="station")
    bench.do("open_served", path="far.npz", what="scan", scan="stations")
    assert "is a station" in bench.do("open_served", path="far.npz", what="scan", scan="frames")["said"]
    bench.do("open_served", path="far.npz", what="scan", scan="replace")
    assert (bench.slice("scan")["name"], bench.slice("picks:p1")) == ("far.npz", [])
    bench.do("undo")
    assert work(bench) == before


@pytest.mark.slow
def test_a_pose_says_that_it_was_solved_on_fewer_clouds(bench: WorkbenchDriver, tmp_path: Path) -> None:
    job = bench.job("robust")
    assert job.state == "done", job.message
    bench.do("open_served", path="sweep1.npz", what="scan", scan="frames")
    stage, *_ = bench.slice("poses:p1")["stages"]
    assert stage["stale"] == "solved on fewer clouds: solve again"
    assert bench.slice("photos")[0]["state"] == "stale"
    assert "fewer clouds" in bench.refused("export_folder", photo="p1", folder=str(tmp_path / "a"), force=False)
    written = results(bench)
    assert written["rests_on"]["current"] is False
    assert "the scan had 1 cloud then, and has 2 clouds now" in written["rests_on"]["sentence"]
    bench.do("undo")
    assert bench.slice("poses:p1")["stages"][0]["stale"] == ""
    bench.do("redo")
    bench.job("robust")
    assert bench.slice("poses:p1")["stages"][0]["stale"] == ""
    written = results(bench)
    assert [one["name"] for one in written["inputs"]] == ["sweep0.npz", "photo.png", "camera.json", "sweep1.npz"]
    assert written["inputs"][0]["read_with"]["more"] == ["sweep1.npz"]
