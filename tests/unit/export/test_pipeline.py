"""Exports: their folder, what replaces what, and that nothing half-made is left."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest

from ladarreg_core.errors import Cancelled, ExportError, OptionError
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan, photo_id
from ladarreg_core.export.targets.pipeline import export_files, export_to
from ladarreg_core.export.targets.zip_file import write_zip
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.storage.manifest import MANIFEST_FILE
from testing.scenes.small_registration import sample_photo, sample_registration, sample_scan


@pytest.fixture(scope="module")
def handed() -> RegisteredScan:
    return RegisteredScan(sample_scan(), (RegisteredPhoto("one", sample_photo(), sample_registration()),))


def test_every_file_stands_in_its_targets_folder_and_in_the_list(handed: RegisteredScan, tmp_path: Path) -> None:
    export_to(tmp_path / "out", handed, ["report"])
    listed = json.loads((tmp_path / "out" / "export.json").read_text())
    there = {path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert there == {"export.json", MANIFEST_FILE, *listed["files"]}
    assert "report/one.html" in there
    assert [one["mark"] for one in listed["photos"]] == [None]


def test_an_earlier_export_is_replaced_on_request_only_and_foreign_files_never(
    handed: RegisteredScan, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    export_to(out, handed, ["report"])
    with pytest.raises(ExportError, match="earlier results"):
        export_to(out, handed, ["report"])
    export_to(out, handed, ["report"], force=True)
    (out / "report" / "mine.txt").write_text("kept")
    with pytest.raises(ExportError, match=r"contains report next to export\.json, which ladarreg did not write"):
        export_to(out, handed, ["report"], force=True)
    assert (out / "report" / "mine.txt").read_text() == "kept"
    (out / "report" / "mine.txt").unlink()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "one.html").write_text("kept")
    for path in (out / "report").iterdir():
        path.unlink()
    (out / "report").rmdir()
    (out / "report").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ExportError, match="did not write"):
        export_to(out, handed, ["report"], force=True)
    assert (tmp_path / "elsewhere" / "one.html").read_text() == "kept"


@pytest.mark.parametrize("name", ["../mine.txt", "/mine.txt", "report/../../mine.txt", "a\\b", "C:x", ""])
def test_a_list_of_files_outside_of_the_folder_is_not_believed(
    handed: RegisteredScan, tmp_path: Path, name: str
) -> None:
    out = tmp_path / "out"
    export_to(out, handed, ["report"])
    (tmp_path / "mine.txt").write_text("kept")
    document = json.loads((out / "export.json").read_text())
    (out / "export.json").write_text(json.dumps({**document, "files": [*document["files"], name]}))
    with pytest.raises(ExportError):
        export_to(out, handed, ["report"], force=True)
    assert (tmp_path / "mine.txt").read_text() == "kept"


def test_a_cancelled_export_leaves_the_state_before_it(handed: RegisteredScan, tmp_path: Path) -> None:
    export_to(tmp_path / "out", handed, ["report"])
    before = (tmp_path / "out" / "export.json").read_bytes()
    seen = []

    def cancel(progress: Progress) -> None:
        seen.append(progress)
        if progress.done == 2:
            raise Cancelled("stopped")

    for target in ("out", "new"):
        with pytest.raises(Cancelled):
            export_to(tmp_path / target, handed, ["report"], force=True, report=cancel)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert (tmp_path / "out" / "export.json").read_bytes() == before
    assert len(seen) == 6


def test_the_same_files_go_into_a_zip(handed: RegisteredScan, tmp_path: Path) -> None:
    write_zip(tmp_path / "out.zip", lambda: export_files(handed, ["report"]))
    with zipfile.ZipFile(tmp_path / "out.zip") as file:
        assert set(file.namelist()) == {"export.json", "report/one.html", "report/one.json", MANIFEST_FILE}
    assert [path.name for path in tmp_path.iterdir()] == ["out.zip"]


def test_refusals(handed: RegisteredScan, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="'colmop' is not an export target; use one or several of"):
        export_to(tmp_path / "out", handed, ["colmop"])
    with pytest.raises(ExportError, match="no registered photograph"):
        RegisteredScan(handed.scan, ())
    with pytest.raises(ExportError, match="was refused"):
        replace(handed, photos=(RegisteredPhoto("one", handed.photos[0].photo, sample_registration(accepted=False)),))
    with pytest.raises(ExportError, match="same id"):
        replace(handed, photos=(*handed.photos, *handed.photos))
    assert not (tmp_path / "out").exists()


def test_ids_are_made_of_file_names_and_differ() -> None:
    assert photo_id("DSC 0123.JPG") == "DSC-0123"
    assert photo_id("/x/Größe?.png") == "Gr-e"
    assert photo_id("a.png", ["A", "a-2"]) == "a-3"
    assert photo_id("..") == "photo"
