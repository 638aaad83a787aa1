"""Locks of folders where there are none, and folders that can only be read."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ladarreg_core.errors import ExportError
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import History
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.storage.folder_lock import FolderLock

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="locks are others there")
WHEN = "2026-01-02T03:04:05Z"


def refusing(number: int) -> Callable[..., Any]:
    def refuse(*args: object, **kwargs: object) -> Any:
        raise OSError(number, os.strerror(number))

    return refuse


@pytest.fixture
def project(tmp_path: Path) -> Path:
    folder = ProjectFolder(tmp_path / "p")
    folder.begin(History.begun(Document(name="mine"), label="Begin", author="", when=WHEN))
    folder.close()
    return tmp_path / "p"


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL])
def test_a_file_system_without_locks_is_not_another_program(
    project: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr("fcntl.flock", refusing(number))
    kept = ProjectFolder(project)
    assert kept.read().document.name == "mine"
    assert "has no locks" in " ".join(kept.remarks)
    kept.close()


def test_a_lock_that_is_held_is_another_program(tmp_path: Path) -> None:
    lock = FolderLock(tmp_path, "lock", what="project")
    assert not lock.remark
    with pytest.raises(ExportError, match="open in another program"):
        FolderLock(tmp_path, "lock", what="project")
    lock.release()


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_what_can_only_be_read_can_be_viewed(project: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    before = {path.name: path.read_bytes() for path in project.iterdir() if path.is_file()}
    opened = os.open

    def open_to_read(path: Any, flags: int, *more: Any, **named: Any) -> int:
        if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            raise OSError(number, os.strerror(number))
        return opened(path, flags, *more, **named)

    with monkeypatch.context() as patched:
        patched.setattr(os, "open", open_to_read)
        patched.setattr(Path, "mkdir", refusing(number))
        patched.setattr(os, "replace", refusing(number))
        kept = ProjectFolder(project)
        assert kept.read().document.name == "mine"
        kept.close()
        assert "can be viewed" in " ".join(kept.remarks)
        with pytest.raises(ExportError, match="cannot write"):
            ProjectFolder(project.parent / "new")
    assert before == {path.name: path.read_bytes() for path in project.iterdir() if path.is_file()}
