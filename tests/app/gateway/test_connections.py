"""Limits on waiting times and numbers of connections, on real sockets."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest
from ladarreg.gateway.connections import Connections
from ladarreg.gateway.options import ConnectionLimits
from ladarreg.gateway.protocol import Picture
from ladarreg.gateway.viser_backend import close_server, open_locked_server
from websockets.exceptions import ConnectionClosed, InvalidStatus

from testing.workbench.gateway_driver import LOOK_TOKEN, Running, hear, running, soon

FEW = ConnectionLimits(header_s=10.0, stall_s=120.0, anonymous=8, authenticated=4, views=2)
PROTOCOL = "viser-v1.1.1"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    monkeypatch.setattr("ladarreg.gateway.connections._MAX_SWEEP_INTERVAL_S", 0.02)
    with running(tmp_path, limits=FEW) as found:
        yield found


class StoppedClock:
    """A gateway's clock, which goes only when the test says so; its sweeps go on."""

    def __init__(self, run: Running) -> None:
        self.connections = run.gateway._server.connections
        self.now, self._sweeps, self._sweep = time.monotonic(), 0, self.connections.sweep
        self.connections.sweep = self._counted  # type: ignore[method-assign]
        self.connections.clock = lambda: self.now

    def advance(self, seconds: float) -> None:
        """Let time pass, and wait until the gateway has looked at every connection since."""
        self.now += seconds
        begun = self._sweeps
        assert soon(lambda: self._sweeps >= begun + 2)

    def has_answered(self) -> bool:
        """Whether no authenticated request is under way: the client may have its response a little earlier."""
        return not any(each.is_busy for each in self.connections._authenticated)

    def has_read(self) -> bool:
        """Whether the one authenticated connection, which is uploading, waits for its next bytes since now."""
        return [each._since for each in self.connections._authenticated if each.awaits_body] == [self.now]

    def _counted(self) -> None:
        self._sweep()
        self._sweeps += 1


@pytest.fixture
def clock(run: Running) -> StoppedClock:
    found = StoppedClock(run)
    found.advance(0)
    return found


@contextlib.contextmanager
def line_to(run: Running, sent: bytes = b"", *, receive_buffer: int | None = None) -> Iterator[socket.socket]:
    """Open a connection and send some bytes."""
    with socket.socket() as line:
        if receive_buffer is not None:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        line.settimeout(60)
        line.connect(("127.0.0.1", run.port))
        line.sendall(sent)
        yield line


def header(run: Running, method: str, path: str, *more: str, known: bool = True) -> bytes:
    lines = [
        f"{method} {run.access.within(path) if known else path} HTTP/1.1",
        f"Host: 127.0.0.1:{run.port}",
        f"Origin: {run.origin}",
        *more,
    ]
    lines += [f"Cookie: {run.access.cookie}"] if known else []
    return "\r\n".join([*lines, "", ""]).encode()


def received_until_closed(line: socket.socket) -> bytes:
    """Return all bytes until the other side closes; fails if it does not within a minute."""
    received = b""
    with contextlib.suppress(ConnectionError):
        while block := line.recv(1 << 16):
            received += block
    return received


def is_closed(line: socket.socket) -> bool:
    patience = line.gettimeout()
    line.setblocking(False)
    try:
        return not line.recv(1 << 16)
    except BlockingIOError:
        return False
    except ConnectionError:
        return True
    finally:
        line.settimeout(patience)


# --- waiting ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", [b"", b"GET / HTTP/1.1\r\nHost: x\r\nX-Slow: "])
def test_idle_connections_and_incomplete_headers_are_dropped(run: Running, clock: StoppedClock, words: bytes) -> None:
    with line_to(run, words) as line:
        clock.advance(0)
        for _ in range(3):
            clock.advance(0.3 * FEW.header_s)
            assert not is_closed(line)
            line.sendall(words[-1:])  # byte by byte, a header would never time out
        clock.advance(0.3 * FEW.header_s)
        assert soon(lambda: is_closed(line))


def test_the_header_timeout_applies_again_after_a_response(run: Running, clock: StoppedClock) -> None:
    with line_to(run, header(run, "HEAD", "/")) as line:
        assert line.recv(1 << 20).startswith(b"HTTP/1.1 200")
        assert soon(clock.has_answered)
        clock.advance(0.6 * FEW.header_s)
        line.sendall(header(run, "HEAD", "/"))
        assert line.recv(1 << 20).startswith(b"HTTP/1.1 200"), "the connection is kept open"
        assert soon(clock.has_answered)
        line.sendall(b"GET / HTTP/1.1\r\n")
        clock.advance(0.6 * FEW.header_s)
        assert not is_closed(line)
        clock.advance(0.6 * FEW.header_s)
        assert received_until_closed(line) == b""


def test_an_anonymous_form_has_the_same_timeout(run: Running, clock: StoppedClock) -> None:
    with line_to(run, header(run, "POST", "/enter", "Content-Length: 4000", known=False)) as line:
        clock.advance(0)
        for _ in range(3):
            clock.advance(0.3 * FEW.header_s)
            assert not is_closed(line)
            line.sendall(b"x")
        clock.advance(0.3 * FEW.header_s)
        assert soon(lambda: is_closed(line))


def test_an_authenticated_upload_may_be_slow_but_not_stall(run: Running, clock: StoppedClock, tmp_path: Path) -> None:
    words = header(run, "POST", "/upload?what=scan", "X-File-Name: a.pcd", "Content-Length: 8")
    with line_to(run, words) as line:
        for _ in range(8):
            assert soon(clock.has_read)
            clock.advance(0.9 * FEW.stall_s)
            line.sendall(b"x")
        assert line.recv(1 << 16).startswith(b"HTTP/1.1 200")
    with line_to(run, words) as line:
        line.sendall(b"x")
        assert soon(lambda: bool(list(tmp_path.glob("*.part"))))
        assert soon(clock.has_read)
        clock.advance(1.1 * FEW.stall_s)
        assert received_until_closed(line) == b""
    assert soon(lambda: not list(tmp_path.glob("*.part")))


def test_a_response_that_is_not_read_is_dropped(run: Running, clock: StoppedClock, tmp_path: Path) -> None:
    (tmp_path / "p1.zip").write_bytes(bytes(24_000_000))
    server = run.gateway._server
    with line_to(run, header(run, "GET", "/export/p1.zip"), receive_buffer=4096) as line:
        assert line.recv(100).startswith(b"HTTP/1.1 200")
        assert soon(lambda: after(clock, 1.1 * FEW.stall_s, lambda: not server.server_state.connections))
    with line_to(run, header(run, "GET", "/export/p1.zip")) as line:
        for _ in range(6):  # slowly, but steadily
            left = 4_000_000
            while left > 0:
                block = line.recv(left)
                assert block
                left -= len(block)
            clock.advance(0.4 * FEW.stall_s)


def after(clock: StoppedClock, seconds: float, true: Callable[[], bool]) -> bool:
    """Return whether a condition is true after more time has passed."""
    clock.advance(seconds)
    return true()


# --- too many --------------------------------------------------------------------------------------------------------


def test_a_new_client_is_served_despite_many_idle_connections(tmp_path: Path) -> None:
    limits = ConnectionLimits(anonymous=8)
    with running(tmp_path, limits=limits) as run, contextlib.ExitStack() as crowd:
        StoppedClock(run)  # none of them times out
        idle = [crowd.enter_context(line_to(run)) for _ in range(60)]
        assert run.ask("GET", "/", known=False)[0] == 401
        assert run.ask("GET", "/")[0] == 200
        with run.socket() as page:
            assert "slices" in hear(page)
        assert soon(lambda: sum(map(is_closed, idle)) >= 60 - limits.anonymous)


def test_the_peer_with_the_most_connections_loses_its_oldest() -> None:
    connections = Connections(ConnectionLimits(anonymous=5))
    alone = connections.add("192.0.2.7")
    greedy = [connections.add(f"2001:db8::{k}") for k in range(40)]
    own = connections._anonymous
    assert list(own.pop("192.0.2.7")) == [alone]
    assert [list(lines) for lines in own.values()] == [greedy[-4:]], (
        "its oldest are gone; all its addresses are one peer"
    )


def test_authenticated_connections_have_their_own_limit_with_a_message(run: Running) -> None:
    with contextlib.ExitStack() as pages:
        idle = pages.enter_context(line_to(run, header(run, "HEAD", "/")))
        assert idle.recv(1 << 20).startswith(b"HTTP/1.1 200")
        for _ in range(FEW.authenticated):  # the last one replaces the idle connection
            hear(pages.enter_context(run.socket()))
        assert soon(lambda: is_closed(idle))
        status, _, said = run.ask("GET", "/")
        assert (status, b"close pages" in said) == (503, True)
        with pytest.raises(InvalidStatus) as caught, run.socket():
            pass
        assert caught.value.response.status_code == 503
        assert run.ask("GET", "/", known=False)[0] == 401, "anonymous connections do not count"
    assert soon(lambda: run.ask("GET", "/")[0] == 200)


def test_readers_take_no_connection_that_is_reserved_for_editors(run: Running) -> None:
    editor = run.access
    run.enter(LOOK_TOKEN)
    reader = run.access
    with contextlib.ExitStack() as pages:
        for _ in range(FEW.authenticated // 2):
            hear(pages.enter_context(run.socket()))
        status, _, said = run.ask("GET", "/")
        assert (status, b"close pages" in said) == (503, True), "their share is taken"
        run.access = editor
        for _ in range(FEW.authenticated // 2):
            hear(pages.enter_context(run.socket()))
        assert run.ask("GET", "/")[0] == 503, "and so is the rest"
    run.access = reader
    assert soon(lambda: run.ask("GET", "/")[0] == 200)
    with contextlib.ExitStack() as pages:
        idle = [pages.enter_context(line_to(run, header(run, "HEAD", "/"))) for _ in range(2)]
        for line in idle:
            assert line.recv(1 << 20).startswith(b"HTTP/1.1 200")
        run.access = editor
        for _ in range(FEW.authenticated):
            hear(pages.enter_context(run.socket()))
        assert all(soon(lambda line=line: is_closed(line)) for line in idle), "idle ones make room"
        run.access = reader
        assert run.ask("GET", "/")[0] == 503, "an editor's are not closed for them"


def test_an_idle_connection_of_an_editor_does_not_make_room_for_a_reader() -> None:
    connections = Connections(ConnectionLimits(authenticated=4))
    editors = [connections.add("192.0.2.7") for _ in range(4)]
    assert all(connections.authenticate(line, read_only=False) for line in editors)
    reader = connections.add("192.0.2.8")
    assert not connections.authenticate(reader, read_only=True)
    newcomer = connections.add("192.0.2.9")
    assert connections.authenticate(newcomer, read_only=False), "but for another editor"
    assert list(connections._authenticated) == [*editors[1:], newcomer]


def test_an_editors_picture_waits_for_at_most_one_of_the_readers(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    held, drawing = threading.Event(), []
    picture = run.bench.picture

    def draw(path: str, query: Mapping[str, str]) -> Picture:
        if query["show"] == "reader":
            drawing.append(path)
            held.wait(60)
        return picture(path, query)

    monkeypatch.setattr(run.bench, "picture", draw)
    editor = run.access
    run.enter(LOOK_TOKEN)
    with contextlib.ExitStack() as lines:
        try:
            asked = header(run, "GET", "/picture/scan?show=reader")
            for _ in range(2):
                lines.enter_context(line_to(run, asked))
            assert soon(lambda: bool(drawing))
            run.access = editor
            assert run.ask("GET", "/picture/scan?show=intensity")[0] == 200
            assert len(drawing) == 1
        finally:
            held.set()


def test_pictures_do_not_wait_for_the_model(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """The colours of a large survey take half a minute, for which nobody's panes and lists may stay empty."""
    held, drawing = threading.Event(), []
    picture = run.bench.picture

    def draw(path: str, query: Mapping[str, str]) -> Picture:
        if path.startswith("model/"):
            drawing.append(path)
            held.wait(60)
        return picture("scan", query)

    monkeypatch.setattr(run.bench, "picture", draw)
    with contextlib.ExitStack() as lines:
        try:
            for number in range(3):
                lines.enter_context(
                    line_to(run, header(run, "GET", f"/picture/model/texture?show=intensity&n={number}"))
                )
            assert soon(lambda: len(drawing) == 2)
            assert run.ask("GET", "/picture/scan?show=intensity")[0] == 200
            assert len(drawing) == 2
        finally:
            held.set()


def test_a_page_beyond_the_limit_gets_a_reason(run: Running) -> None:
    run.bench.most = 1
    with run.socket() as first:
        hear(first)  # it has the only seat; opened together, either of two might
        with run.socket() as second, pytest.raises(ConnectionClosed) as caught:
            second.recv(timeout=60)
        assert caught.value.rcvd is not None
        assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1013, "1 page is open, the most: close it.")


@pytest.mark.slow
def test_a_view_beyond_the_limit_gets_a_reason(tmp_path: Path) -> None:
    server, address = open_locked_server(label="test")
    try:
        with running(tmp_path, address, limits=ConnectionLimits(views=2)) as run:
            first, second = (run.socket("/viser", subprotocols=[PROTOCOL]) for _ in range(2))
            with pytest.raises(InvalidStatus) as caught:
                run.socket("/viser", subprotocols=[PROTOCOL])
            assert caught.value.response.status_code == 503
            status, headers, said = run.ask("GET", "/viser/")
            assert (status, headers["content-type"].partition(";")[0]) == (503, "text/plain")
            assert said.startswith(b"2 pages show the 3-D view")
            first.close()
            assert soon(lambda: run.ask("GET", "/viser/")[0] == 200)
            run.socket("/viser", subprotocols=[PROTOCOL]).close()
            second.close()
            assert soon(lambda: run.ask("GET", "/viser/")[0] == 200)
            editor = run.access
            run.enter(LOOK_TOKEN)
            with run.socket("/viser", subprotocols=[PROTOCOL]):
                assert run.ask("GET", "/viser/")[0] == 503, "the share of readers is taken"
                with pytest.raises(InvalidStatus):
                    run.socket("/viser", subprotocols=[PROTOCOL])
                run.access = editor
                run.socket("/viser", subprotocols=[PROTOCOL]).close()
    finally:
        close_server(server)


def test_limits_leave_descriptors_for_files() -> None:
    asked = ConnectionLimits()
    assert asked.within(None) == asked
    for descriptors in (64, 256, 1024, 4096):
        found = asked.within(descriptors)
        most = found.anonymous + 2 * found.authenticated + 2 * found.views
        assert descriptors - most >= min(128, descriptors // 4)
        assert min(found.anonymous, found.authenticated, found.views) >= 8
    assert asked.within(4096) == asked


# --- the process -----------------------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limit")
def test_the_descriptor_limit_is_raised() -> None:
    code = (
        "import resource as r; h = r.getrlimit(r.RLIMIT_NOFILE)[1]; r.setrlimit(r.RLIMIT_NOFILE, (64, h));"
        "from ladarreg.process_resources import raise_descriptor_limit as f;"
        "print(f(), r.getrlimit(r.RLIMIT_NOFILE)[0], h)"
    )
    found, soft, hard = map(int, subprocess.check_output([sys.executable, "-c", code], text=True).split())
    assert found == soft
    assert soft == (4096 if hard < 0 else min(4096, hard))


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux") or not os.confstr("CS_GNU_LIBC_VERSION"), reason="glibc only")
def test_memory_is_returned_to_the_system() -> None:
    code = """
import gc, time
from ladarreg.process_resources import _resident_bytes, limit_arenas, return_memory_soon
limit_arenas()
before = _resident_bytes()
class Circle: pass
circles, between = [], []
for k in range(2000):
    circles.append(Circle())
    circles[-1].own, circles[-1].block = circles[-1], bytes(100_000)
    between.append(bytes(1000))
gc.collect()
del circles
return_memory_soon()
grown = _resident_bytes() - before
end = time.monotonic() + 60
while _resident_bytes() - before >= 30 << 20 and time.monotonic() < end:
    time.sleep(0.02)
print(grown, _resident_bytes() - before)
"""
    words = subprocess.check_output([sys.executable, "-c", code], text=True).split()
    grown, left = (int(word) / 2**20 for word in words)
    assert grown > 100, "garbage in reference cycles is not collected at once"
    assert left < 30
