"""One served workbench for all browser tests of a process; each test opens a project of its own in it."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from ladarreg.workbench.state.recent import project_id

from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.true_matches import true_points
from testing.workbench.served import Page as Socket
from testing.workbench.served import Served, served


def _with_camera(socket: Socket) -> None:
    camera = json.loads((sample_folder() / "camera.json").read_text())
    assert socket.ask("set_camera", photo="p1", focal_px=camera["fx"])["ok"]


def _solved(socket: Socket) -> None:
    """Solve the photograph from 16 right points; nothing is solved by itself from then on."""
    assert socket.ask("set_settings", solve_automatically=False)["ok"]
    for point in true_points(16):
        assert socket.ask("add_pick", photo="p1", **point)["ok"]
    assert socket.ask("run", photo="p1", job="robust")["ok"]
    socket.until(lambda slices: slices["photos"][0]["state"] == "accepted")


PREPARED: dict[str, tuple[str, Callable[[Socket], None]]] = {
    "camera": ("sample", _with_camera),
    "solved": ("camera", _solved),
}
"""How each project is prepared from another; `sample` is the scan and the photograph."""


class SharedWorkbench:
    """A served workbench, and prepared projects, of which tests open copies.

    A copy of the folder is a whole project even while it is open: a step is on disk before its reply.
    """

    def __init__(self, server: Served, folder: Path) -> None:
        self.server, self._folder = server, folder
        self._prepared = {"sample": folder / "project"}
        self._copies = 0
        self.folder = folder / "project"
        """The project that is open."""
        self._looked_at = ""
        """What is open, if only prepared and looked at."""
        socket = Socket(server)
        self.look_token: str = socket.ask("read_only_link")["token"]
        socket.socket.close()

    def open(self, name: str) -> None:
        """Open a fresh copy of a prepared project, in place of whatever is open."""
        self._open_copy(self._prepare(name))

    def open_new(self) -> None:
        """Open a project in which there is nothing yet."""
        reply = self._ask("new_project", sure=True)
        found = (path for path in self._folder.rglob("*") if path.is_dir() and project_id(path) == reply["opened"])
        self.folder = next(found)

    def reopen(self) -> None:
        """Close the open project and open it again, as a restart does."""
        folder = self.folder
        self.open("sample")
        self._open(folder)

    def _open(self, folder: Path) -> None:
        self._ask("open_project", folder=str(folder), sure=True)
        self.folder = folder

    def open_files(self, files: Sequence[Path]) -> Socket:
        """Open a project with these files; also return a connection to it."""
        self.open_new()
        socket = Socket(self.server)
        reply = socket.ask("open_files", files=[self.server.upload(path) for path in files])
        assert reply["ok"], reply
        assert not reply["refused"] + reply["waiting"], reply
        return socket

    def look_at(self, name: str) -> None:
        """Open a prepared project for a test that changes nothing in it."""
        if self._looked_at != name:
            self.open(name)
            self._looked_at = name

    def _prepare(self, name: str) -> Path:
        if name not in self._prepared:
            before, prepare = PREPARED[name]
            path = self._open_copy(self._prepare(before))
            socket = Socket(self.server)
            prepare(socket)
            socket.socket.close()
            self._prepared[name] = _copied(path, self._folder / name)
        return self._prepared[name]

    def _open_copy(self, prepared: Path) -> Path:
        self._copies += 1
        folder = _copied(prepared, self._folder / f"copy-{self._copies}")
        self._open(folder)
        return folder

    def _ask(self, do: str, **fields: Any) -> dict[str, Any]:
        """Send a command that opens another project, after which this connection ends."""
        self._looked_at = ""
        socket = Socket(self.server)
        socket.until(lambda slices: slices["people"]["count"] == 1)  # the clients of the test before have gone
        reply = socket.ask(do, **fields)
        socket.socket.close()
        assert reply["ok"], reply
        return reply


def _copied(project: Path, target: Path) -> Path:
    shutil.copytree(project, target, ignore=shutil.ignore_patterns("*.part", "lock"))
    return target


@pytest.fixture(scope="session")
def workbench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SharedWorkbench]:
    """The workbench that all browser tests of this process share."""
    if sys.platform == "win32":
        pytest.skip("the server is ended by a signal")
    folder = tmp_path_factory.mktemp("shared")
    with served(folder / "project") as (found, _):
        yield SharedWorkbench(found, folder)
