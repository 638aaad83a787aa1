"""Reader processes of the workbench: a file whose reader crashes or hangs affects nothing else."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from ladarreg.session.isolated_readers import READERS

from ladarreg_core import formats
from ladarreg_core.errors import FormatError
from ladarreg_core.formats.isolated import ReaderLimits
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench, sample_bench
from tests.formats import misbehaving

MAX_PARALLEL = READERS._slots._initial_value  # type: ignore[attr-defined]
LINE = {"kind": "line", "scan": [[1, 0, 0], [1, 0.1, 0.02]], "photo_uv": [[300.25, 200.5], [410.125, 220]]}


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[WorkbenchDriver]:
    """A workbench whose readers, real processes, behave as the end of each file demands."""
    found = sample_bench(tmp_path / "project")
    monkeypatch.setattr(formats, "read_photo", misbehaving.read_photo)
    monkeypatch.setattr(formats, "read_scan", misbehaving.read_scan_or_misbehave)
    monkeypatch.setattr(READERS, "limits", ReaderLimits(silent_s=120.0))
    yield found
    found.workbench.close()


def arrived(bench: WorkbenchDriver, name: str, ending: bytes = b"") -> Path:
    """Create an uploaded photograph."""
    path = bench.workbench.upload_folder() / name
    path.write_bytes(next(sample_folder().glob("photo.*")).read_bytes() + ending)
    return path


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="a crash is described differently there")
@pytest.mark.parametrize(("what", "named"), [("photo", "x1.png"), ("scan", "mine.png")])
def test_a_file_whose_reader_crashes_is_refused(bench: WorkbenchDriver, what: str, named: str) -> None:
    labels = [entry["label"] for entry in bench.slice("history")["entries"]]
    path = arrived(bench, "x1.png", b"crash")
    with pytest.raises(FormatError, match=rf"{named}: its reader crashed \(Seg"):
        bench.workbench.take_upload(path, "mine.png", what, None, bench.client)
    assert not path.exists()
    assert [entry["label"] for entry in bench.slice("history")["entries"]] == labels
    assert bench.workbench.take_upload(arrived(bench, "x2.png"), "good.png", "photo", None, bench.client) == "p2"


@pytest.mark.slow
def test_edits_and_other_files_do_not_wait_for_a_reader_that_hangs(bench: WorkbenchDriver) -> None:
    refusals: list[str] = []

    def upload() -> None:
        try:
            bench.workbench.take_upload(arrived(bench, "x1.png", b"hang"), "bad.png", "photo", None, bench.client)
        except FormatError as error:
            refusals.append(str(error))

    thread = threading.Thread(target=upload)
    thread.start()
    bench.eventually(lambda: READERS._slots._value < MAX_PARALLEL)  # the reader has the file
    for _ in range(40):
        bench.do("add_pick", photo="p1", **LINE)
    assert bench.workbench.take_upload(arrived(bench, "x2.png"), "good.png", "photo", None, bench.client) == "p2"
    assert len(bench.workbench.slices(bench.client)["photos"]) == 2
    assert thread.is_alive(), "the reader was supposed to hang"
    READERS.close()
    thread.join(60)
    assert "x1.png: its reader was killed" in refusals[0]
    assert not (bench.workbench.upload_folder() / "x1.png").exists()


@pytest.mark.slow
def test_a_project_opens_without_a_photograph_whose_reader_crashes(bench: WorkbenchDriver) -> None:
    path = arrived(bench, "x1.png")
    photo = bench.workbench.take_upload(path, "good.png", "photo", None, bench.client)
    home = bench.workbench.session.folder.path
    bench.workbench.close()
    path.write_bytes(path.read_bytes() + b"crash")
    again = open_bench(home)
    bench.workbench = again.workbench
    shown = {entry["id"]: entry for entry in again.slice("photos")}
    assert "its reader" in shown[photo]["error"]
    assert shown["p1"]["width"] > 100
    again.do("add_pick", photo="p1", **LINE)
