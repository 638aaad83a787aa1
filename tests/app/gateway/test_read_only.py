"""The read-only token: what it opens, and that everything else is refused."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from ladarreg.gateway.protocol import READ_ONLY, Visitor
from ladarreg.gateway.viser_proxy import _only_looks
from ladarreg.workbench.commands.registry import COMMANDS

from testing.workbench.access import Access
from testing.workbench.gateway_driver import LOOK_TOKEN, PNG, Running, hear, running
from testing.workbench.workbench_driver import WorkbenchDriver, sample_bench


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Running]:
    with running(tmp_path) as found:
        found.enter(LOOK_TOKEN)
        yield found


def test_a_page_may_look(run: Running) -> None:
    (run.bench.room / "p1.zip").write_bytes(b"zip")
    assert run.ask("GET", "/")[0] == 200
    assert run.ask("GET", "/picture/scan?show=intensity")[2] == PNG
    assert run.ask("GET", "/export/p1.zip")[2] == b"zip"
    with run.socket() as page:
        assert "number" in hear(page)["slices"]
        assert run.bench.pages[-1].visitor.read_only


def test_with_the_other_token_it_is_not_read_only(run: Running) -> None:
    look = run.access
    run.enter()
    assert run.access.cookie != look.cookie
    assert run.access.path != look.path
    with run.socket() as page:
        hear(page)
        assert not run.bench.pages[-1].visitor.read_only


def test_a_session_says_what_it_permits(run: Running) -> None:
    assert run.ask("GET", "/access")[2] == b"look\n"
    look = run.access
    run.enter()
    assert run.ask("GET", "/access")[2] == b"edit\n"
    run.access = Access(run.access.cookie, look.path)
    assert run.ask("GET", "/access")[0] == 401, "the path of the one does not open the other"


def test_a_read_only_cookie_is_not_accepted_as_another(run: Running) -> None:
    name, _, value = run.access.cookie.partition("=")
    browser, _, signature = value.partition(".")
    for forged in (f"{browser}.{signature[::-1]}", f"{browser[::-1]}.{signature}"):
        run.access = Access(f"{name}={forged}", run.access.path)
        assert run.ask("GET", "/picture/scan")[0] == 401


@pytest.mark.slow
@pytest.mark.parametrize("method", ["POST", "PUT", "PATCH", "DELETE"])
@pytest.mark.parametrize("path", ["/upload?what=scan", "/", "/document", "/anything"])
def test_every_request_but_reading_is_refused(run: Running, method: str, path: str) -> None:
    status, _, body = run.ask(method, path, {"X-File-Name": "scan.npz"}, b"data")
    assert (status, json.loads(body)) == (403, {"ok": False, "error": READ_ONLY})
    assert run.bench.taken == []
    assert list(run.bench.room.iterdir()) == []


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    found = sample_bench(tmp_path_factory.mktemp("looking") / "project")
    yield found
    found.workbench.close()


@pytest.fixture(scope="module")
def looker(bench: WorkbenchDriver) -> WorkbenchDriver:
    return WorkbenchDriver(bench.workbench, bench.workbench.join(Visitor("elsewhere", read_only=True)))


LOOKING = {name for name, command in COMMANDS.items() if command.looks}
FIELDS: dict[str, Any] = {
    "photo": "p1", "kind": "point", "scan": [[1, 0, 0]], "photo_uv": [[10, 20]], "name": "Eve", "n": 0, "pick": "1",
    "picks": ["1"], "on": False, "above": 1, "focal_px": 500, "seed": 3, "stage": "auto", "job": "auto", "path": "x",
    "what": "scan", "action": "stop", "folder": "/tmp/nowhere", "force": True, "files": [], "side": "scan",
    "at": [5, 5],
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("do", sorted(COMMANDS.keys() - LOOKING))
def test_every_command_that_changes_anything_is_refused(
    bench: WorkbenchDriver, looker: WorkbenchDriver, do: str
) -> None:
    bench.do("add_pick", photo="p1", kind="point", scan=[[1, 0, 0]], photo_uv=[[30, 20]])
    before = bench.workbench.session.history
    for fields in ({}, FIELDS):
        assert looker.refused(do, **fields) == READ_ONLY
    assert bench.workbench.session.history is before
    assert bench.workbench.runner.job is None


def test_the_commands_of_a_read_only_page_change_only_its_own_view(
    bench: WorkbenchDriver, looker: WorkbenchDriver
) -> None:
    before, mine = bench.workbench.session.history, {name: bench.slice(name) for name in ("shown", "model")}
    assert {"show_photo", "set_model", "look", "point", "probe"} <= LOOKING
    assert not LOOKING & {"add_pick", "export", "run", "acquire_stop"}
    for do in sorted(LOOKING):
        looker.ask(do, **FIELDS)
    looker.do("set_model", rays=True)
    assert looker.slice("model")["rays"]
    assert bench.workbench.session.history is before
    assert {name: bench.slice(name) for name in mine} == mine
    assert {each["read_only"] for each in bench.slice("people")["clients"]} == {False, True}


def test_whoever_edits_is_alone_among_those_who_look(bench: WorkbenchDriver, looker: WorkbenchDriver) -> None:
    assert bench.workbench.clients.is_alone(bench.client)
    assert not bench.workbench.clients.is_alone(looker.client)


def test_only_those_who_edit_are_given_the_read_only_link(bench: WorkbenchDriver) -> None:
    assert "no read-only link" in bench.refused("read_only_link")
    bench.workbench.clients.read_only_token = "look-only"
    assert bench.do("read_only_link")["token"] == "look-only"


def test_a_message_to_the_3d_view_may_only_move_ones_own_camera() -> None:
    assert _only_looks(msgspec.msgpack.encode({"type": "ViewerCameraMessage", "fov": 1.0}))
    for hostile in (
        {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": 1}},
        {"type": "FileTransferPart"},
        {"type": ["ViewerCameraMessage"]},
        {},
        ["ViewerCameraMessage"],
    ):
        assert not _only_looks(msgspec.msgpack.encode(hostile))
    assert not _only_looks(b"")
    assert not _only_looks(b"\xff" * 10)
