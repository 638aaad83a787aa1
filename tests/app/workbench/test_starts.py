"""How a workbench starts: after a crash, on a full disk, with damaged and with invalid inputs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ladarreg.workbench.launch import open_workbench

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.formats import read_scan
from ladarreg_core.project.history import NOBODY
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import WorkbenchDriver, kept_bench, open_bench, registered, sample_bench

LINE = {"kind": "line", "scan": [[1, 0, 0], [1, 0.1, 0.02]], "photo_uv": [[300.25, 200.5], [410.125, 220]]}


def saved_picks(bench: WorkbenchDriver) -> list[dict[str, Any]]:
    """Return the picks in project.json."""
    kept = json.loads((bench.workbench.session.folder.path / "project.json").read_bytes())
    return [pick for photo in kept["photos"] for pick in photo["picks"]]


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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_edits_continue_on_a_full_disk_and_are_saved_later(
    bench: WorkbenchDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ladarreg_core.errors import ExportError
    from ladarreg_core.project.storage.folder import ProjectFolder
    from ladarreg_core.storage.atomic_write import AppendedFile

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


@pytest.mark.slow
def test_a_project_with_missing_arrays_shows_everything_else(tmp_path: Path) -> None:
    bench = kept_bench("registered", tmp_path / "p", registered)
    line = bench.do("add_pick", photo="p1", **LINE)["pick"]
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
        assert list(judged["lines"]) == [line], "samples of a line need no pose"
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


@pytest.mark.slow
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
