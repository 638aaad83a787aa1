"""One server, several projects: the list, and the change from one to another without losing anything."""

from __future__ import annotations

import io
import json
import shutil
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from ladarreg.gateway.protocol import READ_ONLY, Visitor
from ladarreg.workbench.desk import Desk
from ladarreg.workbench.launch import data_folder, open_workbench
from ladarreg.workbench.state.clients import Client
from PIL import Image

from ladarreg_core.project.summary import read_summary
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.gateway_driver import soon

SCAN, PHOTO = sample_folder() / "scan.npz", next(sample_folder().glob("photo.*"))


class DeskDriver:
    """A desk, its first client, and the events that it received."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self.client = self.join("me")
        self.events: list[dict[str, Any]] = []
        desk.subscribe(self.events.append, self.client)

    def join(self, tab: str) -> Client:
        return self.desk.join(Visitor("test", tab=f"{tab:x<20}", name=tab))

    def ask(self, do: str, **fields: Any) -> dict[str, Any]:
        message = json.loads(json.dumps({"id": 1, "do": do, **fields}))
        return json.loads(json.dumps(self.desk.answer(self.client, message), allow_nan=False))

    def do(self, do: str, **fields: Any) -> dict[str, Any]:
        reply = self.ask(do, **fields)
        assert reply["ok"], reply
        return reply

    def slice(self, name: str) -> Any:
        return self.desk.slices(self.client)[name]

    def upload(self, name: str, data: bytes, *, folder: Path | None = None) -> str:
        path = (folder or self.desk.upload_folder()) / f"{abs(hash((name, data))):032x}"
        path.write_bytes(data)
        return self.desk.take_upload(path, name, "any", None, self.client)

    def drop(self, *files: Path, **choice: Any) -> dict[str, Any]:
        ids = [self.upload(file.name, file.read_bytes()) for file in files]
        return self.do("open_files", files=ids, **choice)

    def names(self) -> list[str]:
        return [each["name"] for each in self.do("list_projects")["projects"]]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[DeskDriver]:
    """A desk that was started without a project."""
    monkeypatch.setenv("LADARREG_HOME", str(tmp_path / "home"))
    opener = partial(open_workbench, upload_bytes=2 << 30)
    driver = DeskDriver(Desk(opener(()), open_workbench=opener, data=data_folder(), anywhere=False))
    yield driver
    driver.desk.close()


def test_the_start_page_ends_with_the_first_file(bench: DeskDriver) -> None:
    assert bench.slice("project")["start"]
    assert bench.names() == []
    bench.drop(SCAN)
    assert not bench.slice("project")["start"]
    assert bench.names() == ["scan"]


def test_an_unused_project_leaves_no_folder(bench: DeskDriver, tmp_path: Path) -> None:
    bench.do("new_project", name="Office 7")
    projects = tmp_path / "home/projects"
    assert soon(lambda: [path.name.rpartition("-")[0] for path in projects.iterdir()] == ["Office-7"])


@pytest.mark.slow
def test_changing_the_project_saves_tells_and_comes_back(bench: DeskDriver) -> None:
    bench.drop(SCAN, PHOTO)
    bench.do("add_pick", photo="p1", kind="point", scan=[[1, 0, 0]], photo_uv=[[300, 200]])
    first = bench.slice("project")["id"]
    bench.do("new_project", name="Office 7")
    second = bench.slice("project")
    assert (second["name"], bench.slice("scan"), second["start"]) == ("Office 7", None, False)
    assert soon(lambda: any(event.get("event") == "project" for event in bench.events))
    told = next(event for event in bench.events if event.get("event") == "project")
    assert told == {"event": "project", "id": second["id"], "name": "Office 7", "by": "me"}
    assert bench.names() == ["Office 7", "scan"]

    assert "nother project was opened" in bench.ask("rename", name="lost", project=first)["error"]
    bench.do("open_project", wanted=first)
    assert len(bench.slice("picks:p1")) == 1
    assert bench.slice("project")["name"] == "scan"


def test_a_list_entry_has_a_picture_and_a_state(bench: DeskDriver, tmp_path: Path) -> None:
    bench.drop(SCAN, PHOTO)
    assert soon(lambda: bench.do("list_projects")["projects"][0]["state"] == "1 photograph, not solved", seconds=20)
    assert soon(lambda: bench.do("list_projects")["projects"][0]["picture"], seconds=20)
    entry = bench.do("list_projects")["projects"][0]
    assert (entry["current"], entry["missing"]) == (True, False)
    picture = bench.desk.picture(f"project/{entry['id']}", {})
    assert Image.open(io.BytesIO(picture.data)).size in {(200, 150), (400, 150)}
    for wrong in ("project/../../recent", "project/0000000000000000", "project/"):
        with pytest.raises(Exception, match="no picture"):
            bench.desk.picture(wrong, {})


def test_a_missing_folder_is_told_and_forgotten(bench: DeskDriver) -> None:
    bench.drop(SCAN)
    first, folder = bench.slice("project")["id"], bench.desk.workbench.session.folder.path
    bench.do("new_project", name="other")
    assert soon(lambda: not any(thread.name == "retiring" for thread in threading.enumerate()))
    shutil.rmtree(folder)
    entry = bench.do("list_projects")["projects"][1]
    assert (entry["missing"], entry["state"].startswith("its folder is missing")) == (True, True)
    assert "not a project" in bench.ask("open_project", wanted=first)["error"]
    assert bench.slice("project")["name"] == "other", "nothing has happened"
    bench.do("forget_project", wanted=first)
    assert bench.names() == ["other"]


@pytest.mark.slow
def test_a_copy_has_everything_but_the_name(bench: DeskDriver) -> None:
    bench.drop(SCAN, PHOTO)
    bench.do("add_pick", photo="p1", kind="point", scan=[[1, 0, 0]], photo_uv=[[300, 200]])
    original = bench.desk.workbench.session.folder.path
    copy = bench.do("duplicate_project", wanted=bench.slice("project")["id"])["duplicate"]
    assert bench.names() == ["scan (copy)", "scan"]
    bench.do("remove_picks", photo="p1", picks=[bench.slice("picks:p1")[0]["id"]])
    bench.do("open_project", wanted=copy)
    assert len(bench.slice("picks:p1")) == 1
    assert bench.slice("scan")["returns"] > 1000
    assert bench.desk.workbench.session.folder.path.parent == original.parent
    assert "copy" in read_summary(bench.desk.workbench.session.folder.path).name
    assert soon(lambda: bench.ask("duplicate_project", wanted=copy)["ok"])


@pytest.mark.slow
def test_a_running_job_and_other_people_are_asked_about(bench: DeskDriver) -> None:
    bench.drop(SCAN, PHOTO)
    bench.do("set_camera", photo="p1", focal_px=972.8)
    other = bench.join("Anna")
    bench.do("run", photo="p1", job="self_test")
    reply = bench.do("new_project", name="next")
    assert len(reply["asks"]) == 2, reply
    assert "running and would be stopped" in reply["asks"][0]
    assert "Anna would see the other project" in reply["asks"][1]
    assert bench.slice("project")["name"] == "scan"
    bench.do("new_project", name="next", sure=True)
    assert bench.slice("project")["name"] == "next"
    assert bench.slice("job") is None
    bench.desk.leave(other)


@pytest.mark.slow
def test_a_second_scan_begins_a_second_project_with_its_batch(bench: DeskDriver) -> None:
    bench.drop(SCAN)
    reply = bench.drop(SCAN, PHOTO)
    assert reply["asks"] == "scan"
    bench.do("new_project", files=reply["waiting"])
    assert [photo["name"] for photo in bench.slice("photos")] == [PHOTO.name]
    assert bench.slice("scan")["name"] == SCAN.name
    assert bench.slice("waiting") == []
    assert bench.names() == ["scan", "scan"]


@pytest.mark.slow
def test_an_upload_during_the_change_is_not_put_into_the_other_project(bench: DeskDriver) -> None:
    bench.drop(SCAN)
    old = bench.desk.upload_folder()
    bench.do("new_project", name="other")
    with pytest.raises(Exception, match="drop the file again"):
        bench.upload("photo.jpg", PHOTO.read_bytes(), folder=old)
    assert bench.slice("waiting") == []


def test_where_projects_lie_is_only_told_on_this_machine(bench: DeskDriver, tmp_path: Path) -> None:
    bench.drop(SCAN)
    missing = tmp_path / "secret" / "gone"
    bench.desk.recent.remember(missing)
    wanted = next(each["id"] for each in bench.do("list_projects")["projects"] if each["missing"])
    for reply in (bench.do("list_projects"), bench.ask("open_project", wanted=wanted),
                  bench.ask("duplicate_project", wanted=wanted)):  # fmt: skip
        assert str(tmp_path) not in json.dumps(reply)
    bench.desk._anywhere = True
    assert str(missing) in json.dumps(bench.do("list_projects"))


def test_projects_of_earlier_versions_are_listed(bench: DeskDriver, tmp_path: Path) -> None:
    open_workbench((SCAN,), project=tmp_path / "home/projects/old-one").close()
    (tmp_path / "home/projects/no-project").mkdir()
    assert bench.names() == ["scan"]
    bench.drop(SCAN)
    assert bench.names() == ["scan", "scan"]


@pytest.mark.slow
def test_folders_are_opened_by_their_path_only_where_that_is_allowed(bench: DeskDriver, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    open_workbench((SCAN,), project=elsewhere).close()
    assert "only projects of the list" in bench.ask("open_project", folder=str(elsewhere))["error"]
    for wrong in ("", " ", "\0", 7, "x" * 5000):
        assert not bench.ask("open_project", folder=wrong)["ok"]
    bench.desk._anywhere = True
    assert "is not a project" in bench.ask("open_project", folder=str(tmp_path))["error"]
    bench.do("open_project", folder=str(elsewhere))
    assert bench.slice("scan")["name"] == SCAN.name


def test_who_may_only_look_does_not_change_projects(bench: DeskDriver) -> None:
    bench.drop(SCAN)
    bench.client.read_only = True
    wanted = bench.slice("project")["id"]
    for do in ("new_project", "open_project", "open_sample", "duplicate_project", "forget_project"):
        assert bench.ask(do, wanted=wanted)["error"] == READ_ONLY
    bench.client.read_only = False


def test_the_sample_opens_and_registers_itself(bench: DeskDriver) -> None:
    bench.do("open_sample")
    assert bench.slice("project")["name"] == "Sample"
    assert bench.slice("job")["kind"] == "auto"
    bench.do("job_control", action="stop")
