"""`ladarreg report`: of a folder of results, of a project, and what it refuses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

from ladarreg_core.simulate.sample import sample_folder
from testing.files.rewritten import rewrite, without_hints
from testing.workbench.workbench_driver import WorkbenchDriver, kept_bench, registered


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    """A workbench whose photograph was registered automatically, its results exported into `results`."""
    found = kept_bench("registered", tmp_path_factory.mktemp("reported") / "project", registered)
    yield found
    found.workbench.close()


@pytest.fixture(scope="module")
def results(bench: WorkbenchDriver) -> Path:
    folder = bench.workbench.session.folder.path.parent / "results"
    bench.do("export_folder", photo="p1", folder=str(folder), force=False)
    bench.workbench.runner.wait(240)
    assert (folder / "report.html").is_file()
    return folder


@pytest.fixture
def moved(results: Path, tmp_path: Path) -> Path:
    """A copy of the results' JSON alone."""
    folder = tmp_path / "moved"
    folder.mkdir()
    shutil.copy(results / "registration.json", folder)
    return folder


def complaint(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Run the command, which must refuse in one line."""
    capsys.readouterr()
    assert main(["report", "--quiet", *words]) == ExitCode.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ladarreg: ")
    return line


@pytest.mark.slow
def test_a_report_of_results_is_the_one_that_was_exported(results: Path, moved: Path) -> None:
    assert main(["report", str(moved), "--inputs", str(sample_folder()), "--quiet"]) == ExitCode.ACCEPTED
    assert (moved / "report.html").read_bytes() == (results / "report.html").read_bytes()
    again = moved / "again.html"
    words = ["report", str(moved), "--inputs", str(sample_folder()), "--quiet", "-o", str(again)]
    assert main(words) == ExitCode.ACCEPTED
    assert again.read_bytes() == (moved / "report.html").read_bytes()
    assert sorted(path.name for path in moved.iterdir()) == ["again.html", "registration.json", "report.html"]


@pytest.mark.slow
def test_the_page_writes_the_same_report(bench: WorkbenchDriver, results: Path) -> None:
    job = bench.job("report")
    assert (job.state, job.message[:16]) == ("done", "Wrote a report o")
    (ready,) = [m for m in bench.received if m.get("event") == "export_ready" and m["url"].endswith(".html")]
    assert (ready["name"], ready["url"]) == ("p1", "export/p1.html")
    path, name = bench.workbench.export_file("p1", "html") or (Path(), "")
    assert path.read_bytes() == (results / "report.html").read_bytes()
    assert name.endswith("-report.html")
    assert bench.workbench.export_file("p9", "html") is None


@pytest.mark.slow
def test_a_refused_result_has_a_report_too(moved: Path) -> None:
    path = moved / "registration.json"
    document = json.loads(path.read_bytes())
    rewrite(path, {**document, "accepted": False, "evidence": "none", "reasons": ["No."]})
    assert main(["report", str(moved), "--inputs", str(sample_folder()), "--quiet"]) == ExitCode.ACCEPTED
    text = (moved / "report.html").read_text(encoding="utf-8")
    assert "not accepted</span>" in text
    assert "Rejected guess" in text


def test_inputs_that_are_missing_or_changed_are_refused(
    moved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    without_hints(moved / "registration.json")
    assert "the input scan.npz is needed, but there is no such file" in complaint(capsys, str(moved))
    other = tmp_path / "other"
    other.mkdir()
    shutil.copy(sample_folder() / "scan.npz", other)
    (other / "photo.png").write_bytes((sample_folder() / "photo.png").read_bytes() + b"\0")
    assert "another SHA-256" in complaint(capsys, str(moved), "--inputs", str(other))
    assert not (moved / "report.html").exists()


@pytest.mark.long
def test_a_file_is_replaced_only_if_that_is_wanted(moved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, inputs = moved / "mine.html", ["--inputs", str(sample_folder())]
    out.write_text("mine")
    assert "exists" in complaint(capsys, str(moved), *inputs, "-o", str(out))
    assert out.read_text() == "mine"
    for foreign in (b"mine", b"<!DOCTYPE html>" + b"x" * 5000):
        out.write_bytes(foreign)
        assert "not a report as ladarreg wrote it" in complaint(capsys, str(moved), *inputs, "-o", str(out), "--force")
        assert out.read_bytes() == foreign
    out.unlink()
    assert main(["report", str(moved), *inputs, "-o", str(out), "--quiet"]) == ExitCode.ACCEPTED
    written = out.read_bytes()
    assert written.startswith(b"<!DOCTYPE html>")
    assert main(["report", str(moved), *inputs, "-o", str(out), "--force", "--quiet"]) == ExitCode.ACCEPTED
    assert out.read_bytes() == written
    out.write_bytes(written.replace(b"</title>", b" with a remark of mine</title>", 1))
    assert "not a report as ladarreg wrote it" in complaint(capsys, str(moved), *inputs, "-o", str(out), "--force")
    (moved / "link.html").symlink_to(out)
    assert "not a report" in complaint(capsys, str(moved), *inputs, "-o", str(moved / "link.html"), "--force")
    shutil.copy(sample_folder() / "scan.npz", moved)
    assert "does not end in .html" in complaint(capsys, str(moved), *inputs, "-o", str(moved / "scan.npz"), "--force")
    assert "does not exist" in complaint(capsys, str(moved), *inputs, "-o", str(moved / "no" / "a.html"))
    assert "is a folder" in complaint(capsys, str(moved), *inputs, "-o", str(moved))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"matches": [{"ray": 1}]}, "'matches' is damaged"),
        ({"inputs": []}, "does not name the scan"),
        ({"findings": [1]}, "is damaged"),
        ({"steps": 3}, "is damaged"),
        ({"covariance": None}, "covariance"),
    ],
)
def test_a_damaged_registration_is_refused(
    moved: Path, capsys: pytest.CaptureFixture[str], change: dict[str, object], said: str
) -> None:
    path = moved / "registration.json"
    rewrite(path, {**json.loads(path.read_bytes()), **change})
    assert said in complaint(capsys, str(moved), "--inputs", str(sample_folder()))
    assert [entry.name for entry in moved.iterdir()] == ["registration.json"]


def test_folders_without_a_result_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "folder not found" in complaint(capsys, str(tmp_path / "none"))
    assert "neither a registration.json nor a project.json" in complaint(capsys, str(tmp_path))


@pytest.mark.slow
def test_a_report_of_a_project(
    bench: WorkbenchDriver, results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = bench.workbench.session.folder.path
    assert "open" in complaint(capsys, str(folder)), "while the workbench has it open"
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    assert main(["report", str(copy), "--quiet"]) == ExitCode.ACCEPTED
    assert (copy / "exports" / "p1.html").read_bytes() == (results / "report.html").read_bytes()
    assert "called 'p2'" in complaint(capsys, str(copy), "--photo", "p2")
    out = tmp_path / "by-name.html"
    assert main(["report", str(copy), "--photo", "photo.png", "-o", str(out), "--quiet"]) == ExitCode.ACCEPTED
    assert out.is_file()
