"""Partial files of killed processes, and project folders that were moved away."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from ladarreg_core.simulate import sample_folder
from testing.workbench.gateway_driver import hear, soon
from testing.workbench.serve_process import Server, ask, begin_upload, name_of, serving


def upload(server: Server, name: str = "photo.png") -> tuple[int, dict[str, object]]:
    data = (sample_folder() / name).read_bytes()
    status, _, body = server.there.ask("POST", "/upload?what=photo", {"X-File-Name": name}, data)
    return status, json.loads(body)


def plant_partial_files(folder: Path) -> set[Path]:
    """Create partial files as killed processes leave them, and similar files to keep; return the latter."""
    for path in (
        ".project.json.0123abcd.part", "arrays/.f00.npz.0123abcd.part", "exports/.p1.0123abcd.part/model.glb",
        "exports/p1.zip.part", f"inputs/{'0a' * 16}.part",
    ):  # fmt: skip
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(b"half")
    kept = {
        folder / path
        for path in (
            "mine.part",
            ".mine.part",
            "inputs/mine.part",
            "exports/.p1.0123abcd.old",
            "exports/p1.0123abcd.part",
        )
    }
    for path in kept:
        path.write_bytes(b"whole")
    return kept


def parts(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.name.endswith((".part", ".old"))}


@pytest.mark.slow
def test_partial_files_of_a_killed_process_are_removed_at_the_start(tmp_path: Path) -> None:
    project = tmp_path / "project"
    kept = plant_partial_files(project)
    with serving(project) as server:
        assert parts(project) == kept
        with begin_upload(server.there):
            assert soon(lambda: parts(project) > kept)
            server.process.kill()
            server.end()
    assert parts(project) > kept
    with serving(project):
        assert parts(project) == kept


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="an open folder cannot be moved there")
def test_an_upload_into_a_moved_project_folder_is_refused(tmp_path: Path) -> None:
    project, elsewhere = tmp_path / "project", tmp_path / "elsewhere"
    with serving(project) as server, server.there.socket() as page:
        hear(page)
        assert upload(server)[0] == 200
        project.rename(elsewhere)
        status, said = upload(server)
        assert (status, said["ok"]) == (409, False)
        assert "moved, renamed or deleted" in str(said["error"])
        assert "still in memory" in str(said["error"])
        assert str(tmp_path) not in str(said["error"])
        assert not project.exists(), "no second project is created"
        elsewhere.rename(project)
        assert upload(server)[0] == 200
        assert ask(page, "rename", name="kept")["ok"]
        server.process.terminate()
        server.end()
        assert server.process.returncode == 0
    assert name_of(project) == "kept"
    assert len(json.loads((project / "project.json").read_bytes())["photos"]) == 2


@pytest.mark.slow
def test_a_deleted_inputs_folder_is_created_again(tmp_path: Path) -> None:
    with serving(tmp_path / "project") as server:
        (tmp_path / "project" / "inputs").rmdir()
        assert upload(server)[0] == 200
