"""Connections that occupy a server, and what other clients experience: edits that are saved, newcomers that get in."""

from __future__ import annotations

import http.client
import random
import selectors
import socket
import time
from pathlib import Path
from typing import Any

from testing.workbench.access import Access
from testing.workbench.served import Page, Served

KINDS = ("idle", "slow", "cookie", "document", "viser")
"""Silent connections, headers that never end, requests with a cookie, document sockets, and unread viser sockets."""
_NEWCOMER_S = 60.0
_PROTOCOL = "viser-v1.1.1"


class HeldConnections:
    """Connections that are held open, and reopened where the server closes them."""

    def __init__(self, kind: str, count: int, host: str, port: int, access: Access) -> None:
        if kind not in KINDS:
            raise ValueError(f"there is no kind of connection {kind!r}")
        self.kind, self.count, self.address, self.access = kind, count, (host, port), access
        self.selector = selectors.DefaultSelector()
        self.open: set[socket.socket] = set()
        self.opened = self.closed = self.failed = 0

    def first_request(self) -> bytes:
        host = f"Host: {self.address[0]}:{self.address[1]}\r\n"
        known = f"Cookie: {self.access.cookie}\r\n"
        if self.kind == "idle":
            return b""
        if self.kind == "slow":
            return f"GET / HTTP/1.1\r\n{host}X-Slow: ".encode()
        if self.kind == "cookie":
            return f"GET {self.access.path} HTTP/1.1\r\n{host}{known}\r\n".encode()
        path, more = (
            ("/viser", f"Sec-WebSocket-Protocol: {_PROTOCOL}\r\n") if self.kind == "viser" else ("/document", "")
        )
        return (
            f"GET {self.access.within(path)} HTTP/1.1\r\n{host}{known}Origin: http://{self.address[0]}:{self.address[1]}\r\n{more}"
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


def edits(page: Page, count: int) -> int:
    """Edit so many times, and return the number of edits that were not saved."""
    picks = [pick["id"] for pick in page.slices["picks:p1"]]
    unsaved = 0
    for _ in range(count):
        reply = page.ask(
            "set_pick",
            photo="p1",
            pick=_PLACES.choice(picks),
            photo_uv=[[_PLACES.uniform(5, 700), _PLACES.uniform(5, 500)]],
        )
        unsaved += bool(not reply["ok"] or reply.get("saved") is False or page.slices["project"].get("unsaved"))
    return unsaved


def newcomers(found: Served, count: int) -> list[bool]:
    """Return for so many new clients, one after the other, whether each got the page within a minute."""
    got = []
    for _ in range(count):
        try:
            line = http.client.HTTPConnection(found.host, found.port, timeout=_NEWCOMER_S)
            line.request("GET", f"/?token={found.token}")
            got.append(line.getresponse().status == 200)
            line.close()
        except OSError:
            got.append(False)
    return got


def descriptors(found: Served) -> int:
    """Return the number of open file descriptors of the server."""
    return len(list(Path(f"/proc/{found.process.pid}/fd").iterdir()))
