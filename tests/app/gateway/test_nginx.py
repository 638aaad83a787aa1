"""The recipe of docs/remote.md: nginx in front, under a folder, without TLS."""

from __future__ import annotations

import http.client
import json
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ladarreg.gateway.viser_backend import close_server, open_locked_server
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from testing.workbench.access import Access
from testing.workbench.gateway_driver import TOKEN, Running, running, soon

NGINX = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin:/usr/local/sbin:/opt/homebrew/bin")
pytestmark = pytest.mark.skipif(NGINX is None or sys.platform == "win32", reason="no nginx here")

AROUND = """
daemon off; master_process off; pid {folder}/pid; error_log stderr error;
events {{ worker_connections 64; }}
http {{
    access_log off;
    client_body_temp_path {folder}/body; proxy_temp_path {folder}/proxy; fastcgi_temp_path {folder}/f;
    uwsgi_temp_path {folder}/u; scgi_temp_path {folder}/s;
    {map}
    server {{ listen 127.0.0.1:{port}; {location} }}
}}
"""


@pytest.fixture(scope="module", params=["port", "socket"])
def front(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, checkout: Path
) -> Iterator[tuple[Running, int]]:
    """The gateway behind nginx, configured as documented."""
    assert NGINX is not None
    folder = tmp_path_factory.mktemp("nginx")
    location, upgrade = re.findall(r"```nginx\n(.*?)```", (checkout / "docs/remote.md").read_text("utf-8"), re.DOTALL)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    viser, address = open_locked_server(label="nginx")
    room = tmp_path_factory.mktemp("room")
    try:
        where = {"socket": folder / "room.sock"} if request.param == "socket" else {"behind_proxy": True}
        with running(room, address, allowed_hosts=("scans.example",), **where) as run:
            target = f"http://unix:{run.path}:/" if run.path else f"http://127.0.0.1:{run.port}/"
            location = location.replace("http://127.0.0.1:8700/", target)
            text = AROUND.format(folder=folder, map=upgrade, port=port, location=location)
            (folder / "nginx.conf").write_text(text)
            process = subprocess.Popen([NGINX, "-p", str(folder), "-c", str(folder / "nginx.conf")])
            try:
                assert soon(lambda: reachable(port))
                yield run, port
            finally:
                process.terminate()
                process.wait(timeout=60)
    finally:
        close_server(viser)


def reachable(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def ask(port: int, method: str, path: str, body: object = None, **headers: str) -> tuple[int, dict[str, str], bytes]:
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    sent = {"Host": "scans.example", "Origin": "http://scans.example"} | headers
    line.request(method, path, body, sent)  # type: ignore[arg-type]
    answer = line.getresponse()
    result = answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
    line.close()
    return result


def websocket(
    port: int, access: Access, path: str = "document", *, origin: str = "http://scans.example", **more: Any
) -> ClientConnection:
    return connect(
        f"ws://scans.example{access.within(path)}",
        sock=socket.create_connection(("127.0.0.1", port), timeout=60),
        additional_headers={"Origin": origin, "Cookie": access.cookie or "none=0"},
        compression=None,
        max_size=None,
        **more,
    )


def test_the_documented_recipe_works(front: tuple[Running, int]) -> None:
    run, port = front
    assert ask(port, "GET", "/ladar/")[0] == 401
    status, headers, _ = ask(port, "GET", f"/ladar/?token={TOKEN}", **{"X-Forwarded-For": "6.6.6.6"})
    assert status == 200
    access = Access.granted(headers)
    assert access.path.startswith("/ladar/s/")
    cookie = access.cookie

    for path in ("", "tokens.css", "picture/scan?rev=1", "viser/"):
        assert ask(port, "GET", access.within(f"/{path}"), Cookie=cookie)[0] == 200
    # A name that is relative and a folder that is the proxy's: the redirect must stay under it.
    assert ask(port, "GET", access.within("/viser"), Cookie=cookie)[1]["location"] in (
        "viser/",
        f"http://scans.example{access.path}viser/",
    )
    expired = ask(port, "GET", "/ladar/s/0123456789abcdef0123456789abcdef/")
    assert (expired[0], b'action="../../enter"' in expired[2]) == (401, True)

    with websocket(port, access) as page:
        assert "number" in json.loads(page.recv(timeout=60))["slices"]
        assert [page.visitor.address for page in run.bench.pages] == ["127.0.0.1"]
        page.send('{"id": 1, "do": "set", "number": 5}')
        assert json.loads(page.recv(timeout=60))["slices"]["number"] == 5
        data = bytes(range(256)) * 1000
        sent = {"Cookie": cookie, "X-File-Name": "a.e57"}
        status, _, body = ask(port, "POST", access.within("/upload?what=scan"), data, **sent)
        assert (status, json.loads(body)["ok"]) == (200, True)
        assert run.bench.taken[-1][3] == data
    with websocket(port, access, "viser", subprotocols=["viser-v1.1.1"]) as view:
        assert view.subprotocol == "viser-v1.1.1"
        assert isinstance(view.recv(timeout=60), bytes)


def test_foreign_requests_are_refused_behind_nginx(front: tuple[Running, int]) -> None:
    run, port = front
    assert ask(port, "POST", "/ladar/enter", f"token={TOKEN}", Origin="http://elsewhere.example")[0] == 403
    assert ask(port, "GET", "/ladar/", Host="elsewhere.example")[0] == 403
    known = Access(run.access.cookie, f"/ladar{run.access.path}")
    for access, origin, status in (
        (known, "http://elsewhere.example", 403),
        (known, "https://scans.example", 403),
        (Access("", known.path), "http://scans.example", 401),
        (Access(known.cookie, "/ladar/"), "http://scans.example", 401),
    ):
        with pytest.raises(InvalidStatus) as caught, websocket(port, access, origin=origin):
            pass
        assert caught.value.response.status_code == status
