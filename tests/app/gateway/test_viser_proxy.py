"""viser: locked on its own port, reachable through the gateway."""

from __future__ import annotations

import http.client
import re
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import msgspec
import numpy as np
import pytest
import viser
import websockets.asyncio.server
import zstandard
from ladarreg.gateway.viser_backend import (
    CLIENT_HEADER,
    HOST,
    SECRET_HEADER,
    ViserAddress,
    close_server,
    locked,
    open_locked_server,
)
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from ladarreg_core.errors import DependencyError
from testing.workbench.gateway_driver import Running, closing_code, running, soon

PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def viewer() -> Iterator[tuple[viser.ViserServer, ViserAddress]]:
    server, address = open_locked_server(label="test")
    server.scene.add_point_cloud("/cloud", np.zeros((500_000, 3), np.float32), np.zeros((500_000, 3), np.uint8))
    try:
        yield server, address
    finally:
        close_server(server)


@pytest.fixture(scope="module")
def run(viewer: tuple[viser.ViserServer, ViserAddress], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("room"), viewer[1]) as found:
        yield found


def node_names(frame: bytes) -> set[str]:
    """Return the names of the scene nodes that a frame of viser creates."""
    size, packed = (int.from_bytes(frame[at : at + 8], "little") for at in (0, 8))
    inner = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + packed], max_output_size=size)
    return {str(message.get("name")) for message in msgspec.msgpack.decode(inner)["messages"]}


def test_early_requests_wait_for_viser(viewer: tuple[viser.ViserServer, ViserAddress], tmp_path: Path) -> None:
    where: Future[ViserAddress] = Future()
    with running(tmp_path, where.result) as run, ThreadPoolExecutor(2) as people:
        page = people.submit(run.ask, "GET", "/viser/")
        socket = people.submit(run.socket, "/viser", subprotocols=[PROTOCOL])
        assert run.ask("GET", "/")[0] == 200, "the page itself does not wait"
        assert not page.done()
        assert not socket.done()
        where.set_result(viewer[1])
        assert page.result(30)[0] == 200
        with socket.result(30) as line:
            assert line.recv(timeout=60)


def test_a_viser_that_never_opens_gives_502(tmp_path: Path) -> None:
    where: Future[ViserAddress] = Future()
    where.set_exception(ConnectionError("closed"))
    with running(tmp_path, where.result) as run:
        assert run.ask("GET", "/viser/")[0] == 502
        with pytest.raises(InvalidStatus):
            run.socket("/viser", subprotocols=[PROTOCOL])


# --- its own port ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("secret", [[], ["wrong"], [""], ["{secret}x"], ["{secret}", "{secret}"]])
@pytest.mark.parametrize("origin", [None, "https://elsewhere.example", "http://127.0.0.1:{port}"])
def test_its_own_port_requires_the_secret(
    viewer: tuple[viser.ViserServer, ViserAddress], secret: list[str], origin: str | None
) -> None:
    address = viewer[1]
    headers = [(SECRET_HEADER, word.format(secret=address.secret)) for word in secret]
    headers += [("Origin", origin.format(port=address.port))] if origin else []
    line = http.client.HTTPConnection(address.host, address.port, timeout=60)
    line.putrequest("GET", "/")
    for name, value in headers:
        line.putheader(name, value)
    line.endheaders()
    assert line.getresponse().status == 403
    line.close()
    with (
        pytest.raises(InvalidStatus) as caught,
        connect(
            f"ws://{address.host}:{address.port}",
            additional_headers=headers,
            subprotocols=[PROTOCOL],  # type: ignore[list-item]
            proxy=None,
        ),
    ):
        pass
    assert caught.value.response.status_code == 403


def test_it_is_on_loopback_and_cannot_be_shared(viewer: tuple[viser.ViserServer, ViserAddress]) -> None:
    server, address = viewer
    assert server.get_host() == address.host == HOST
    assert server.request_share_url() is None
    assert address.secret not in repr(address)
    assert len(address.secret) >= 40


def test_the_lock_is_removed_and_requires_a_server() -> None:
    plain = websockets.asyncio.server.serve
    with pytest.raises(DependencyError), locked("secret"):
        assert websockets.asyncio.server.serve is not plain
    assert websockets.asyncio.server.serve is plain
    with pytest.raises(KeyError), locked("secret"):
        raise KeyError
    assert websockets.asyncio.server.serve is plain


# --- through the gateway ---------------------------------------------------------------------------------------------


def test_the_workbenchs_page_names_the_page_that_all_clients_share(run: Running) -> None:
    def named() -> list[str]:
        return re.findall(r'<meta name="viewer" content="([^"]+)">', run.ask("GET", "/")[2].decode())

    assert soon(lambda: bool(named())), "it is loaded as soon as viser is open"
    status, headers, body = run.ask("GET", f"/{named()[0]}")
    assert status == 200
    assert "immutable" in headers["cache-control"]
    assert b"<html" in body


@pytest.mark.parametrize("path", ["/viser/", "/viser/?fixedDpr=0.5", "/viser/index.html"])
def test_its_page_is_forwarded(run: Running, path: str) -> None:
    status, headers, body = run.ask("GET", path)
    assert status == 200
    assert headers["content-type"].startswith("text/html")
    assert b"<title>Viser</title>" in body
    assert int(headers["content-length"]) == len(body)
    packed = run.ask("GET", path, {"Accept-Encoding": "gzip"})
    assert packed[1]["content-encoding"] == "gzip"
    assert packed[2][:2] == b"\x1f\x8b"
    assert run.ask("GET", "/viser/none.js")[0] == 404
    assert run.ask("GET", "/viser")[1]["location"] == "viser/"


def test_each_page_has_a_view_of_its_own_and_all_share_the_large_page(
    run: Running, viewer: tuple[viser.ViserServer, ViserAddress]
) -> None:
    server, _ = viewer
    with run.socket() as document:
        document.recv(timeout=60)
        client = run.bench.pages[-1].id
        status, headers, shell = run.ask("GET", f"/viser/{client}/")
        assert status == 200
        assert "no-store" not in headers["cache-control"]
        named = re.search(rb'"\.\./(page\?\w+)"', shell)
        assert named is not None
        _, headers, page = run.ask("GET", f"/viser/{named[1].decode()}")
        assert "immutable" in headers["cache-control"]
        assert b"visibility: hidden" in page
        with run.socket(f"/viser/{client}", subprotocols=[PROTOCOL]):
            told: list[str] = []
            assert soon(lambda: bool(server._websock_server._live_connections))
            for connection in server._websock_server._live_connections.values():
                told.append(connection.request.headers[CLIENT_HEADER])  # type: ignore[union-attr]
            assert told == [client]
        for stranger in ("somebody-else", client[:-1]):
            assert run.ask("GET", f"/viser/{stranger}/")[0] == 403
            with pytest.raises(InvalidStatus) as caught, run.socket(f"/viser/{stranger}", subprotocols=[PROTOCOL]):
                pass
            assert caught.value.response.status_code == 403


@pytest.mark.parametrize("path", ["%00", "a%20b", "%0d%0aHost:x", "%7f", "%3Fx", "%C3%A9", "%", "a%", "..%2f", "%5c"])
def test_a_path_that_viser_cannot_serve_gives_404(run: Running, path: str) -> None:
    assert run.ask("GET", f"/viser/{path}")[0] == 404


@pytest.mark.parametrize("path", ["/viser", "/viser/"])
def test_its_websocket_is_forwarded_and_ends_with_the_page(
    run: Running, viewer: tuple[viser.ViserServer, ViserAddress], path: str
) -> None:
    server, _ = viewer
    with run.socket(path, subprotocols=[PROTOCOL]) as page:
        assert page.subprotocol == PROTOCOL
        assert not page.protocol.extensions
        names: set[str] = set()
        largest = 0
        while "/cloud" not in names:
            frame = page.recv(timeout=60)
            assert isinstance(frame, bytes)
            names |= node_names(frame)
            largest = max(largest, len(frame))
        assert largest > 500_000 * 3, "frames of any size"
        assert soon(lambda: len(server.get_clients()) <= 1)
        server.scene.add_frame("/later")
        while "/later" not in node_names(page.recv(timeout=60)):  # type: ignore[arg-type]
            pass
    assert soon(lambda: not server.get_clients())


def test_messages_of_the_page_arrive(run: Running, viewer: tuple[viser.ViserServer, ViserAddress]) -> None:
    server, _ = viewer
    box = server.gui.add_text("name", "before")
    with run.socket("/viser", subprotocols=[PROTOCOL]) as page:
        page.recv(timeout=60)
        update = {"type": "GuiUpdateMessage", "uuid": box._impl.uuid, "updates": {"value": "x" * 900_000}}
        page.send(msgspec.msgpack.encode(update))
        assert soon(lambda: len(box.value) == 900_000), "as long as a message may be"
        page.send("text")
        assert closing_code(page) == 1003
    box.remove()


def test_a_page_of_another_viser_version_is_closed_by_viser(run: Running) -> None:
    with run.socket("/viser", subprotocols=["viser-v0.0.1"]) as page:
        assert closing_code(page) not in (1000, 1006)


def test_a_slow_page_still_receives_everything(run: Running, viewer: tuple[viser.ViserServer, ViserAddress]) -> None:
    server, _ = viewer
    with run.socket("/viser", subprotocols=[PROTOCOL], max_queue=1) as page:
        for n in range(12):
            server.scene.add_point_cloud(
                f"/big{n}", np.zeros((300_000, 3), np.float32), np.zeros((300_000, 3), np.uint8)
            )
        names: set[str] = set()
        while "/big11" not in names:
            names |= node_names(page.recv(timeout=60))  # type: ignore[arg-type]
    server.scene.reset()


@pytest.mark.slow
def test_when_viser_ends_the_page_is_closed(tmp_path_factory: pytest.TempPathFactory) -> None:
    server, address = open_locked_server(label="short")
    with running(tmp_path_factory.mktemp("room"), address) as run:
        with run.socket("/viser", subprotocols=[PROTOCOL]) as page:
            page.recv(timeout=60)
            close_server(server)
            assert closing_code(page) != 1006
        with pytest.raises(InvalidStatus) as caught, run.socket("/viser"):
            pass
        assert caught.value.response.status_code == 502
        assert run.ask("GET", "/viser/")[0] == 502
