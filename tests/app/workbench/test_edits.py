"""Edits at the workbench: published, saved, labelled, undone, refused."""

from __future__ import annotations

import errno
import json
from typing import Any

import numpy as np
import pytest
from ladarreg.gateway.protocol import Visitor
from ladarreg.workbench.commands.registry import COMMANDS, reply_to

from ladarreg_core.errors import OptionError
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import WorkbenchDriver

LINE = {"kind": "line", "scan": [[1, 0, 0], [1, 0.1, 0.02]], "photo_uv": [[300.25, 200.5], [410.125, 220]]}


def saved_picks(bench: WorkbenchDriver) -> list[dict[str, Any]]:
    """Return the picks in project.json."""
    kept = json.loads((bench.workbench.session.folder.path / "project.json").read_bytes())
    return [pick for photo in kept["photos"] for pick in photo["picks"]]


def labels(bench: WorkbenchDriver) -> list[str]:
    return [entry["label"] for entry in bench.slice("history")["entries"]]


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_moves_of_one_end_are_merged_into_one_step(bench: WorkbenchDriver, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg.session.session._MERGE_WITHIN_S", 3600)  # however slow this computer is
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


@pytest.mark.slow
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
        ("run", {"photo": "p1", "job": "export"}, "it has no pose; register it"),
        ("run", {"photo": "p1"}, "give the name of a job"),
        ("look", {"viewpoint": "there"}, "viewpoint is 'there'; it must be 'start', 'overview', 'scanner' or 'camera'"),
        ("export_targets", {"frame": "moon"}, "frame is 'moon'; it must be 'scanner' or 'world'"),
        ("export_targets", {"full": 1}, "full is 1; it must be true or false"),
        ("snap", {"side": "photo", "photo": "p1", "ends": [[1, "x"]]}, "a coordinate of a picture is two numbers"),
        ("job_control", {"action": "pause"}, "no job is running"),
        ("export_folder", {"photo": "p1", "folder": "here"}, "absolute path"),
        ("sample_line", {"scan": [[1, 0, 0]]}, "two ends"),
    ],
)
def test_a_refused_command_returns_a_sentence_and_changes_nothing(
    bench: WorkbenchDriver, do: str, fields: dict[str, Any], says: str
) -> None:
    before = bench.workbench.session.document
    assert says.lower() in bench.refused(do, **fields).lower()
    assert bench.workbench.session.document is before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("do", "fields", "field"),
    [
        ("export", {"targets": ["results"], "photos": ["p1"], "folder": "here"}, "folder"),
        ("export", {"targets": ["results"], "photos": ["p1"], "folder": "/"}, "folder"),
        ("export", {"targets": ["results"], "frame": "moon"}, "frame"),
        ("set_camera", {"photo": "p1", "focal_px": -1}, "focal_px"),
        ("open_files", {"files": [], "reading": {"seconds": 0}}, "seconds"),
        ("open_files", {"files": [], "reading": {"origin": [1, 2]}}, "origin"),
        ("use_stage", {"photo": "p1", "stage": "simplex"}, None),
    ],
)
def test_a_refusal_names_the_field_that_is_wrong(
    bench: WorkbenchDriver, do: str, fields: dict[str, Any], field: str | None
) -> None:
    reply = bench.ask(do, **fields)
    assert not reply["ok"]
    assert reply.get("field") == field, reply


@pytest.mark.slow
def test_invalid_fields_are_never_an_internal_error(bench: WorkbenchDriver) -> None:
    for do in sorted(COMMANDS):
        for junk in ({}, {"photo": 7, "pick": [], "picks": 3, "scan": {}, "at": None, "n": "x"}, {"photo": "p1"}):
            reply = bench.ask(do, **junk)
            assert "Internal error" not in reply.get("error", ""), (do, junk)


@pytest.mark.slow
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


def test_an_error_of_the_system_is_answered_with_what_to_do() -> None:
    def fail() -> dict[str, Any]:
        raise PermissionError(errno.EACCES, "Permission denied", "/a/secret/place")

    reply = reply_to({"id": 3, "do": "hand_over"}, fail)
    assert (reply["reply"], reply["ok"]) == (3, False)
    assert reply["error"] == "System error: permission denied; check the path, its permissions and the free space."


def test_a_long_reason_is_cut() -> None:
    def refuse() -> dict[str, Any]:
        raise OptionError("long " * 1000)

    error = reply_to({"id": 1, "do": "acquire_start"}, refuse)["error"]
    assert len(error) < 1000
    assert error.endswith("...")
