"""Files that were being written when a process was killed, and a project's folder that is moved away."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from ladarreg_core.simulate import sample_folder
from tests.app.gateway_driver import hear, soon
from tests.app.serve_process import Server, ask, begin_upload, name_of, serving


def upload(server: Server, name: str = "photo.png") -> tuple[int, dict[str, object]]:
    data = (sample_folder() / name).read_bytes()
    status, _, body = server.there.ask("POST", "/upload?what=photo", {"X-File-Name": name}, data)
    return status, json.loads(body)


def planted(folder: Path) -> set[Path]:
    """Put down what killed processes leave, and what only looks like it; return the latter."""
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


def test_a_start_clears_away_what_a_killed_program_left(tmp_path: Path) -> None:
    project = tmp_path / "project"
    kept = planted(project)
    with serving(project) as server:
        assert parts(project) == kept
        with begin_upload(server.there):
            assert soon(lambda: parts(project) > kept)
            server.process.kill()
            server.end()
    assert parts(project) > kept
    with serving(project):
        assert parts(project) == kept


@pytest.mark.skipif(sys.platform == "win32", reason="an open folder cannot be moved there")
def test_an_upload_into_a_folder_that_is_gone_is_refused_in_plain_words(tmp_path: Path) -> None:
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
        assert not project.exists(), "it is not begun anew beside the right one"
        elsewhere.rename(project)
        assert upload(server)[0] == 200
        assert ask(page, "rename", name="kept")["ok"]
        server.process.terminate()
        server.end()
        assert server.process.returncode == 0
    assert name_of(project) == "kept"
    assert len(json.loads((project / "project.json").read_bytes())["photos"]) == 2


def test_a_deleted_folder_of_inputs_is_made_again(tmp_path: Path) -> None:
    with serving(tmp_path / "project") as server:
        (tmp_path / "project" / "inputs").rmdir()
        assert upload(server)[0] == 200
