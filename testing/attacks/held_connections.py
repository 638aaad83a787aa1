"""Connections that occupy a server, and what other clients experience: latency of edits, waiting time of newcomers."""

from __future__ import annotations

import http.client
import random
import selectors
import socket
import time
from pathlib import Path
from typing import Any

from testing.workbench.served import Page, Served

KINDS = ("idle", "slow", "cookie", "document", "viser")
"""Silent connections, headers that never end, requests with a cookie, document sockets, and unread viser sockets."""
_NEWCOMER_S = 20.0
_PROTOCOL = "viser-v1.1.1"


class HeldConnections:
    """Connections that are held open, and reopened where the server closes them."""

    def __init__(self, kind: str, count: int, host: str, port: int, cookie: str) -> None:
        if kind not in KINDS:
            raise ValueError(f"there is no kind of connection {kind!r}")
        self.kind, self.count, self.address, self.cookie = kind, count, (host, port), cookie
        self.selector = selectors.DefaultSelector()
        self.open: set[socket.socket] = set()
        self.opened = self.closed = self.failed = 0

    def first_request(self) -> bytes:
        host = f"Host: {self.address[0]}:{self.address[1]}\r\n"
        known = f"Cookie: {self.cookie}\r\n"
        if self.kind == "idle":
            return b""
        if self.kind == "slow":
            return f"GET / HTTP/1.1\r\n{host}X-Slow: ".encode()
        if self.kind == "cookie":
            return f"GET / HTTP/1.1\r\n{host}{known}\r\n".encode()
        path, more = (
            ("/viser", f"Sec-WebSocket-Protocol: {_PROTOCOL}\r\n") if self.kind == "viser" else ("/document", "")
        )
        return (
            f"GET {path} HTTP/1.1\r\n{host}{known}Origin: http://{self.address[0]}:{self.address[1]}\r\n{more}"
            "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        ).encode()

    def fill(self) -> None:
        """Open connections up to the wanted number."""
        for _ in range(self.count - len(self.open)):
            line = socket.socket()
            try:
                if self.kind == "viser":  # a client that does not read
                    line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                line.settimeout(2.0)
                line.connect(self.address)
                line.sendall(self.first_request())
            except OSError:
                line.close()
                self.failed += 1
                return
            line.setblocking(False)
            self.open.add(line)
            self.opened += 1
            if self.kind != "viser":
                self.selector.register(line, selectors.EVENT_READ)

    def pass_time(self, seconds: float) -> None:
        """Read, send a byte on slow connections, and drop closed ones."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            for key, _ in self.selector.select(left) if self.selector.get_map() else ():
                self._read(key.fileobj)
            if not self.selector.get_map():
                time.sleep(max(0.0, end - time.monotonic()))
        for line in list(self.open):
            try:
                if self.kind == "slow":
                    line.send(b"x")
                elif self.kind == "viser":
                    self._drop_if_refused(line)
            except BlockingIOError:
                continue
            except OSError:
                self._drop(line)

    def _read(self, line: Any) -> None:
        try:
            gone = not line.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            gone = True
        if gone:
            self._drop(line)

    def _drop_if_refused(self, line: socket.socket) -> None:
        start = line.recv(64, socket.MSG_PEEK)
        if not start.startswith(b"HTTP/1.1 101"):
            self._drop(line)

    def _drop(self, line: socket.socket) -> None:
        if self.kind != "viser":
            self.selector.unregister(line)
        line.close()
        self.open.discard(line)
        self.closed += 1


_PLACES = random.Random(2)
"""Goes on from one flood to the next: an edit that repeats an earlier one would change nothing."""


def edits_until(page: Page, end: float) -> tuple[list[float], int]:
    """Edit every 20 ms; return the latency of each reply, ms, and the number of edits that were not saved."""
    picks = [pick["id"] for pick in page.slices["picks:p1"]]
    spent, unsaved = [], 0
    while time.monotonic() < end:
        begun = time.perf_counter()
        reply = page.ask(
            "set_pick",
            photo="p1",
            pick=_PLACES.choice(picks),
            photo_uv=[[_PLACES.uniform(5, 700), _PLACES.uniform(5, 500)]],
        )
        spent.append(1e3 * (time.perf_counter() - begun))
        unsaved += bool(not reply["ok"] or reply.get("saved") is False or page.slices["project"].get("unsaved"))
        time.sleep(0.02)
    return spent, unsaved


def newcomers_until(found: Served, end: float, *, least: int) -> list[float]:
    """Return the time in which new clients, so many at least, got the page, s; inf where they timed out."""
    spent: list[float] = []
    while time.monotonic() < end or len(spent) < least:
        begun = time.perf_counter()
        try:
            line = http.client.HTTPConnection(found.host, found.port, timeout=_NEWCOMER_S)
            line.request("GET", f"/?token={found.token}")
            ok = line.getresponse().status == 200
            line.close()
        except OSError:
            ok = False
        spent.append(time.perf_counter() - begun if ok else float("inf"))
        time.sleep(0.25)
    return spent


class Starvation:
    """How much longer a process took than it would have on idle processors, by the kernel's account of its threads."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._begun = self._spent()

    def factor(self) -> float:
        """Return (running + waiting for a processor) / running, since the start; 1 on idle processors."""
        running, waiting = (now - then for now, then in zip(self._spent(), self._begun, strict=True))
        return 1 + max(0, waiting) / running if running > 0 else 1.0

    def _spent(self) -> tuple[int, int]:
        running = waiting = 0
        for thread in Path(f"/proc/{self._pid}/task").iterdir():
            try:
                account = (thread / "schedstat").read_text().split()
            except OSError:  # the thread has ended, or the kernel keeps no account
                continue
            running, waiting = running + int(account[0]), waiting + int(account[1])
        return running, waiting


def descriptors(found: Served) -> int:
    """Return the number of open file descriptors of the server."""
    return len(list(Path(f"/proc/{found.process.pid}/fd").iterdir()))
