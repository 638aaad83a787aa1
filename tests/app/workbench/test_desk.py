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

import numpy as np
import pytest
from ladarreg.gateway.protocol import READ_ONLY, Visitor
from ladarreg.workbench.batch_jobs import BatchJobs
from ladarreg.workbench.desk import Desk
from ladarreg.workbench.launch import data_folder, open_workbench
from ladarreg.workbench.state.clients import Client
from PIL import Image

import ladarreg_core as lr
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.project.summary import read_summary
from ladarreg_core.simulate.sample import sample_folder
from testing.jobs import Here
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
    for do in ("new_project", "open_project", "open_sample", "duplicate_project", "forget_project", "open_job"):
        assert bench.ask(do, wanted=wanted)["error"] == READ_ONLY
    bench.client.read_only = False


@pytest.mark.slow
def test_the_sample_opens_and_registers_itself(bench: DeskDriver) -> None:
    bench.do("open_sample")
    assert bench.slice("project")["name"] == "Sample"
    assert bench.slice("job")["kind"] == "auto"
    bench.do("job_control", action="stop")


@pytest.fixture
def batch(tmp_path: Path) -> Path:
    """The folder of a batch on the sample: a pair that is accepted, one that failed, and one that has not been done."""
    site = tmp_path / "site"
    site.mkdir()
    for file in (SCAN, PHOTO, sample_folder() / "camera.json"):
        shutil.copy(file, site)
    (site / "damaged.png").write_bytes(b"no picture")
    row = {"scan": SCAN.name, "camera": "camera.json"}
    jobs = [{**row, "photo": PHOTO.name, "name": "good"}, {**row, "photo": "damaged.png", "name": "bad"}]
    (site / "list.json").write_text(json.dumps(jobs))
    lr.batch(site / "list.json", site / "out", executor=Here())
    return site / "out"


@pytest.mark.slow
def test_a_batch_is_listed_and_its_jobs_are_projects(bench: DeskDriver, batch: Path) -> None:
    assert "No batch is open" in bench.ask("list_jobs")["error"]
    bench.desk._batch = BatchJobs(batch, data_folder() / "projects")
    assert bench.do("list_projects")["batch"]
    found = bench.do("list_jobs")
    assert (found["name"], found["runs"]) == ("out", False)
    assert (found["counts"]["failed"], found["counts"]["accepted"]) == (1, 1)
    assert [(one["id"], one["outcome"], one["project"]) for one in found["jobs"]] == [
        ("bad", "failed", False), ("good", "accepted", False),
    ]  # fmt: skip
    assert found["jobs"][1]["sigma"].startswith("Sigma")
    assert bench.desk.picture("job/good", {}).data.startswith(b"\xff\xd8")
    assert [one["id"] for one in bench.do("list_jobs", words="DAMAGED.png")["jobs"]] == ["bad"]
    assert [one["id"] for one in bench.do("list_jobs", outcome="accepted")["jobs"]] == ["good"]

    assert "damaged.png" in bench.ask("open_job", wanted="bad")["error"]
    assert "not in the list" in bench.ask("open_job", wanted="other")["error"]
    assert not any(one["project"] for one in bench.do("list_jobs")["jobs"])  # nothing is left of what failed
    bench.do("open_job", wanted="good")
    assert bench.slice("project")["name"] == "good"
    found_pose = read_pose(batch / "jobs/good/registration.json")
    assert np.allclose(bench.slice("photos")[0]["stated_pose"], found_pose.matrix)
    assert soon(lambda: bench.slice("photos")[0].get("light") == "verified", seconds=60)
    first = bench.slice("project")["id"]
    assert bench.do("list_jobs", outcome="accepted")["jobs"][0]["project"]

    bench.do("new_project", name="between")
    (batch.parent / SCAN.name).unlink()  # the project is there, and says what is missing itself
    bench.do("open_job", wanted="good")
    assert bench.slice("project")["id"] == first
    assert "is not there" in bench.ask("open_job", wanted="bad")["error"]


@pytest.mark.slow
def test_the_list_follows_a_batch_that_runs(bench: DeskDriver, batch: Path) -> None:
    bench.desk._batch = BatchJobs(batch, data_folder() / "projects")
    lines = (batch / "manifest.jsonl").read_bytes().splitlines(keepends=True)
    (batch / "manifest.jsonl").write_bytes(b"".join(lines[:-1]) + lines[-1][:40])  # as while it writes
    found = bench.do("list_jobs")
    assert (found["runs"], found["counts"]["waiting"]) == (True, 1)
    (batch / "manifest.jsonl").write_bytes(b"".join(lines))
    assert not bench.do("list_jobs")["runs"]
    shutil.rmtree(batch)
    assert "not there any more" in bench.ask("list_jobs")["error"]
