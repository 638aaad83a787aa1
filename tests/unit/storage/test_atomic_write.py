"""What a call that returns has brought to disk; what cannot be synchronised or listed is said."""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from ladarreg.session.session import Session

from ladarreg_core.acquisition.runs.earlier_run import begin_anew
from ladarreg_core.errors import ExportError
from ladarreg_core.export.targets.folder import write_folder
from ladarreg_core.project import edits
from ladarreg_core.project.history import NOBODY
from ladarreg_core.project.source import Source
from ladarreg_core.storage.atomic_write import files_below, make_folder, replaced_file, write_bytes
from ladarreg_core.storage.manifest import write_manifest
from ladarreg_core.storage.replacement import folder_content
from testing.attacks.drawing import begin

POSIX = pytest.mark.skipif(os.name == "nt", reason="folders cannot be synchronised there")


def refusing(monkeypatch: pytest.MonkeyPatch, wanted: Callable[[os.stat_result], bool], number: int) -> None:
    """Let the synchronisation of some files or folders fail."""
    real = os.fsync

    def fsync(descriptor: int) -> None:
        if wanted(os.fstat(descriptor)):
            raise OSError(number, os.strerror(number))
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)


def is_folder(status: os.stat_result) -> bool:
    return stat.S_ISDIR(status.st_mode)


def part(text: str) -> Callable[[Path], None]:
    return lambda path: write_bytes(path, text.encode())


def results(text: str) -> list[tuple[str, Callable[[Path], None]]]:
    fields = {"version": 1, "kind": "export", "software": {"name": "ladarreg"}, "files": [f"a/{text}"]}
    return [("export.json", part(json.dumps(fields))), (f"a/{text}", part(text))]


@POSIX
@pytest.mark.parametrize("exchanged", [True, False])
def test_results_whose_name_is_not_on_disk_do_not_replace_the_old_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchanged: bool
) -> None:
    write_folder(tmp_path / "out", lambda: results("old"))
    inode = tmp_path.stat().st_ino
    if not exchanged:
        monkeypatch.setattr("ladarreg_core.storage.staging._exchange", lambda first, second: False)
    with monkeypatch.context() as patch:
        refusing(patch, lambda status: status.st_ino == inode, errno.EIO)
        with pytest.raises(ExportError, match="input/output error"):
            write_folder(tmp_path / "out", lambda: results("new"), force=True)
        with pytest.raises(ExportError, match="input/output error"):
            write_folder(tmp_path / "other", lambda: results("new"))
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert (tmp_path / "out" / "a" / "old").read_text() == "old"


@POSIX
def test_a_folder_that_cannot_be_synchronised_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refusing(monkeypatch, is_folder, errno.EIO)
    with pytest.raises(ExportError, match="input/output error"), replaced_file(tmp_path / "file") as new:
        new.write_bytes(b"content")
    with pytest.raises(OSError, match="Input/output"):
        make_folder(tmp_path / "folder")


@POSIX
def test_a_file_system_that_synchronises_no_folders_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refusing(monkeypatch, is_folder, errno.EINVAL)
    write_folder(tmp_path / "deep" / "out", lambda: results("new"))
    assert (tmp_path / "deep" / "out" / "a" / "new").read_text() == "new"


def test_a_file_is_on_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_bytes(b"old")
    refusing(monkeypatch, lambda status: not is_folder(status), errno.EIO)
    with pytest.raises(ExportError, match="input/output error"), replaced_file(tmp_path / "file") as new:
        new.write_bytes(b"content")
    assert (tmp_path / "file").read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


def test_an_edit_is_saved_once_its_photograph_is_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg.session.session.RETRY_S", 0.05)
    session = begin(tmp_path / "p")
    photo = session.folder.inputs / "second.png"
    photo.write_bytes(b"a photograph")
    with monkeypatch.context() as patch:
        refusing(patch, lambda status: os.path.samestat(status, photo.stat()), errno.EIO)
        opened(session)
        assert "second.png: input/output error" in session.unsaved
    session.close()
    session = begin(tmp_path / "q")
    opened(session)  # one that is missing is said when it is read
    assert session.unsaved == ""
    session.close()


def opened(session: Session) -> None:
    source = Source(path="inputs/second.png", name="second.png", size=12)
    session.commit("Open", lambda document: edits.with_photo(document, source)[0], author=NOBODY)


def unlisted(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Let a folder refuse to be listed, whoever asks."""
    real = os.scandir

    def scandir(path: str | Path = ".") -> Iterator[os.DirEntry[str]]:
        if os.path.samefile(path, folder):
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return real(path)

    monkeypatch.setattr(os, "scandir", scandir)


def test_a_folder_that_cannot_be_listed_is_not_empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    write_folder(out, lambda: results("old"))
    (out / "a" / "deep").mkdir()
    (out / "a" / "deep" / "of somebody").write_bytes(b"mine")
    unlisted(monkeypatch, out / "a" / "deep")
    for looking in (lambda: list(files_below(out)), lambda: write_manifest(out), lambda: folder_content(out)):
        with pytest.raises(OSError, match="Input/output"):
            looking()
    with pytest.raises(ExportError, match="cannot be read: input/output error"):
        write_folder(out, lambda: results("new"), force=True)
    assert (out / "a" / "deep" / "of somebody").read_bytes() == b"mine"


def test_a_run_with_a_folder_that_cannot_be_listed_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "of somebody").write_bytes(b"mine")
    (tmp_path / "plan.json").write_text("{}")
    unlisted(monkeypatch, tmp_path / "photos")
    with pytest.raises(OSError, match="Input/output"):
        begin_anew(tmp_path, part("plan"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos", "plan.json"]
