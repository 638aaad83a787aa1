"""Floods of connections against a running workbench: python -m benchmarks.floods [--seconds S] [KIND ...].

A process of its own opens the connections and opens again what the server closes; meanwhile one page edits, and
newcomers ask for the first page. Kinds: idle, loris, cookie, document, viser.
"""

from __future__ import annotations

import argparse
import http.client
import json
import random
import selectors
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.workbench import Page, Served, served, with_camera_and_picks

COUNTS = {"idle": 1100, "loris": 1100, "cookie": 100, "document": 100, "viser": 200}
"""Connections of each kind of flood."""
_NEWCOMER_S = 20.0
_PROTOCOL = "viser-v1.1.1"


# --- the attacker: a process of its own ------------------------------------------------------------------------------


class Held:
    """Connections that are kept open, and opened again where the server closes them."""

    def __init__(self, kind: str, count: int, host: str, port: int, cookie: str) -> None:
        self.kind, self.count, self.address, self.cookie = kind, count, (host, port), cookie
        self.selector = selectors.DefaultSelector()
        self.open: set[socket.socket] = set()
        self.opened = self.closed = self.failed = 0

    def first_words(self) -> bytes:
        host = f"Host: {self.address[0]}:{self.address[1]}\r\n"
        known = f"Cookie: {self.cookie}\r\n"
        if self.kind == "idle":
            return b""
        if self.kind == "loris":
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
        """Open what is missing."""
        for _ in range(self.count - len(self.open)):
            line = socket.socket()
            try:
                if self.kind == "viser":  # a page that does not listen
                    line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                line.settimeout(2.0)
                line.connect(self.address)
                line.sendall(self.first_words())
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
        """Read, dribble, and notice what was closed."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            for key, _ in self.selector.select(left) if self.selector.get_map() else ():
                self._hear(key.fileobj)
            if not self.selector.get_map():
                time.sleep(max(0.0, end - time.monotonic()))
        for line in list(self.open):
            try:
                if self.kind == "loris":
                    line.send(b"x")
                elif self.kind == "viser":
                    self._see_whether_refused(line)
            except BlockingIOError:
                continue
            except OSError:
                self._drop(line)

    def _hear(self, line: Any) -> None:
        try:
            gone = not line.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            gone = True
        if gone:
            self._drop(line)

    def _see_whether_refused(self, line: socket.socket) -> None:
        start = line.recv(64, socket.MSG_PEEK)
        if not start.startswith(b"HTTP/1.1 101"):
            self._drop(line)

    def _drop(self, line: socket.socket) -> None:
        if self.kind != "viser":
            self.selector.unregister(line)
        line.close()
        self.open.discard(line)
        self.closed += 1


def attack(kind: str, count: int, host: str, port: int, cookie: str, seconds: float) -> None:
    """Hold connections for a while and print how it went."""
    held = Held(kind, count, host, port, cookie)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        held.fill()
        held.pass_time(1.0)
    print(json.dumps({"held": len(held.open), "opened": held.opened, "closed": held.closed, "failed": held.failed}))


# --- what the others feel --------------------------------------------------------------------------------------------


def edits_until(page: Page, end: float) -> tuple[list[float], int]:
    """Edit every 20 ms; return how long each answer took, ms, and how many edits were not saved."""
    rng = random.Random(2)
    picks = [pick["id"] for pick in page.slices["picks:p1"]]
    spent, unsaved = [], 0
    while time.monotonic() < end:
        begun = time.perf_counter()
        reply = page.ask(
            "set_pick", photo="p1", pick=rng.choice(picks), photo_uv=[[rng.uniform(5, 700), rng.uniform(5, 500)]]
        )
        spent.append(1e3 * (time.perf_counter() - begun))
        unsaved += bool(not reply["ok"] or reply.get("saved") is False or page.slices["project"].get("unsaved"))
        time.sleep(0.02)
    return spent, unsaved


def newcomers_until(found: Served, end: float) -> list[float]:
    """Return how long the first page took strangers, s; inf where they gave up."""
    spent = []
    while time.monotonic() < end:
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


def descriptors(found: Served) -> int:
    """Return how many the server has open."""
    return len(list(Path(f"/proc/{found.process.pid}/fd").iterdir()))


def flood(found: Served, page: Page, kind: str, seconds: float) -> dict[str, Any]:
    """Return what a flood does to the others."""
    before = found.memory_mb()
    attacker = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.floods", "attack", kind, str(COUNTS[kind]), found.host, str(found.port),
         found.cookie, str(seconds)],
        stdout=subprocess.PIPE, text=True,
    ) if kind != "nothing" else None  # fmt: skip
    end = time.monotonic() + seconds
    waits: list[float] = []
    newcomers = threading.Thread(target=lambda: waits.extend(newcomers_until(found, end)))
    peak, most = [before], [descriptors(found)]

    def watch() -> None:
        while time.monotonic() < end:
            peak.append(found.memory_mb())
            most.append(descriptors(found))
            time.sleep(0.1)

    watching = threading.Thread(target=watch)
    newcomers.start()
    watching.start()
    spent, unsaved = edits_until(page, end)
    newcomers.join()
    watching.join()
    said = json.loads(attacker.communicate()[0]) if attacker else {}
    time.sleep(5)
    return {
        "edits": len(spent), "edit p50, ms": float(np.median(spent)), "edit p99, ms": float(np.percentile(spent, 99)),
        "edit worst, ms": max(spent), "unsaved": unsaved,
        "newcomers": len(waits), "newcomer median, s": float(np.median(waits)), "newcomer worst, s": max(waits),
        "RSS before, MB": before, "RSS peak, MB": max(peak), "RSS 5 s later, MB": found.memory_mb(),
        "descriptors, most": max(most), "attacker": said,
    }  # fmt: skip


@contextmanager
def limited(soft: int | None) -> Iterator[None]:
    """Start processes under a soft limit of descriptors."""
    if soft is None:
        yield
        return
    import resource

    was = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, was[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, was)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", default=["nothing", *COUNTS])
    parser.add_argument("--seconds", type=float, default=20.0, help="of each flood")
    parser.add_argument("--soft-limit", type=int, help="descriptors that the server finds allowed, softly")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    figures = {}
    for kind in arguments.kinds:
        with tempfile.TemporaryDirectory() as folder, ExitStack() as running:
            with limited(arguments.soft_limit):
                found, _ = running.enter_context(served(Path(folder) / "project"))
            page = Page(found)
            with_camera_and_picks(page, 50)
            page.ask("run", photo="p1", job="auto")
            page.until(lambda slices: slices["job"] and slices["job"]["state"] not in ("running", "paused"))
            time.sleep(6)
            figures[kind] = flood(found, page, kind, arguments.seconds)
        print(kind)
        for name, value in figures[kind].items():
            print(f"    {name:22} {value if isinstance(value, int | dict) else f'{value:.3g}'}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1:2] == ["attack"]:
        attack(sys.argv[2], int(sys.argv[3]), sys.argv[4], int(sys.argv[5]), sys.argv[6], float(sys.argv[7]))
    else:
        main()
