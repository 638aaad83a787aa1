"""A served workbench and the websocket clients of its pages, for tests and benchmarks that drive it from outside."""

from __future__ import annotations

import http.client
import json
import os
import random
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from ladarreg.gateway.delta import apply_change
from websockets.sync.client import ClientConnection, connect

from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.access import Access

CHECKOUT = Path(__file__).parents[2]
_CLIENTS, _MAX_PICKS = 10, 12
_SHORT_PAUSE_S, _LONG_PAUSE_S, _SHORT_MIN = (0.1, 0.5), (0.5, 3.0), 5.0  # between the edits of one client


@dataclass
class Served:
    """A running server."""

    process: subprocess.Popen[str]
    host: str
    port: int
    token: str
    access: Access = field(default_factory=Access)

    @property
    def address(self) -> str:
        return f"http://{self.host}:{self.port}/"

    def get(self, path: str) -> tuple[int, bytes, dict[str, str]]:
        connection = http.client.HTTPConnection(self.host, self.port, timeout=60)
        cookie = self.access.cookie
        connection.request("GET", self.access.within(f"/{path}"), headers={"Cookie": cookie} if cookie else {})
        reply = connection.getresponse()
        body = reply.read()
        connection.close()
        return reply.status, body, {name.lower(): value for name, value in reply.getheaders()}

    def upload(self, path: Path, *, name: str = "") -> str:
        """Upload a file, by default under its own name; it then waits to be opened. Return its id."""
        connection = http.client.HTTPConnection(self.host, self.port, timeout=60)
        headers = {
            "Cookie": self.access.cookie,
            "Origin": self.address.rstrip("/"),
            "X-File-Name": quote(name or path.name),
        }
        connection.request("POST", self.access.within("/upload?what=any"), path.read_bytes(), headers)
        reply = json.loads(connection.getresponse().read())
        connection.close()
        assert reply["ok"], reply
        return str(reply["id"])

    def enter(self) -> None:
        status, _, headers = self.get(f"?token={self.token}")
        assert status == 200, status
        self.access = Access.granted(headers)

    def memory_mb(self) -> float:
        """Resident memory of the server process."""
        total = 0
        for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines():
            if line.startswith("VmRSS"):
                total += int(line.split()[1])
        return total / 1024


class Page:
    """The document socket of a page, with the slices that it was sent."""

    def __init__(self, served: Served) -> None:
        self.socket: ClientConnection = connect(
            f"ws://{served.host}:{served.port}{served.access.within('/document')}",
            additional_headers={"Cookie": served.access.cookie, "Origin": served.address.rstrip("/")},
            max_size=None,
            ping_interval=None,
        )
        self.number = 0
        self.slices: dict[str, Any] = {}
        self.events: dict[str, dict[str, Any]] = {}
        """The newest event of each kind."""
        self.take(json.loads(self.socket.recv(timeout=60)))

    def take(self, message: dict[str, Any]) -> dict[str, Any]:
        if "event" in message:
            self.events[message["event"]] = message
        self.slices.update(message.get("slices", {}))
        for name, change in message.get("changes", {}).items():
            self.slices[name] = apply_change(self.slices[name], change)
        return message

    def ask(self, do: str, **fields: Any) -> dict[str, Any]:
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "do": do, **fields}))
        while True:
            message = self.take(json.loads(self.socket.recv(timeout=120)))
            if message.get("reply") == self.number:
                return message

    def until(self, true: Any, seconds: float = 120) -> None:
        end = time.monotonic() + seconds
        while not true(self.slices):
            self.take(json.loads(self.socket.recv(timeout=max(0.1, end - time.monotonic()))))


@contextmanager
def served(
    project: Path, *, port: int = 0, photo: Path | None = None, program: Sequence[str] = ("-m", "ladarreg")
) -> Iterator[tuple[Served, float]]:
    """Start a server on the sample or its scan and another photo; also yield the time until its first picture, s."""
    folder = sample_folder()
    photo = photo or next(folder.glob("photo.*"))
    begun = time.perf_counter()
    errors = project.parent / "errors.txt"  # a pipe that nobody reads would fill up
    with errors.open("ab") as stderr:
        process = subprocess.Popen(
            [sys.executable, *program, "serve", str(folder / "scan.npz"), str(photo),
             "--project", str(project), "--port", str(port), "--no-browser"],
            stdout=subprocess.PIPE, stderr=stderr, text=True,
            env={**os.environ, "LADARREG_HOME": str(project.parent / "home"), "OMP_NUM_THREADS": "1"},
        )  # fmt: skip
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        address = next((word for word in line.split() if "://" in word), None)
        if address is None:
            raise SystemExit(errors.read_text())
        parts = urlsplit(address)
        found = Served(process, parts.hostname or "", parts.port or 0, parts.query.removeprefix("token="))
        found.enter()
        status, picture, _ = found.get("picture/scan?view=0&show=intensity")
        assert status == 200, status
        assert picture[:4] == b"\x89PNG"
        yield found, time.perf_counter() - begun
    finally:
        process.terminate()
        process.wait(60)


def with_camera_and_picks(page: Page, count: int) -> None:
    """Set the camera, and add picks at random."""
    camera = json.loads((sample_folder() / "camera.json").read_text())
    assert page.ask("set_camera", photo="p1", focal_px=camera["fx"])["ok"]
    rng = random.Random(0)
    for _ in range(count):
        ray, uv = random_pick(rng)
        assert page.ask("add_pick", photo="p1", kind="point", scan=[ray], photo_uv=[uv])["ok"]


def random_pick(rng: random.Random) -> tuple[list[float], list[float]]:
    return [1, rng.uniform(-0.35, 0.35), rng.uniform(-0.2, 0.2)], [rng.uniform(5, 700), rng.uniform(5, 500)]


def many_clients(found: Served, minutes: float) -> tuple[list[tuple[float, float]], int]:
    """Let ten clients edit at random; return memory over time (s, MB) and the number of edits."""
    pause_s = _SHORT_PAUSE_S if minutes < _SHORT_MIN else _LONG_PAUSE_S
    end = time.monotonic() + 60 * minutes
    edits = [0] * _CLIENTS

    def work(k: int) -> None:
        rng = random.Random(k)
        page = Page(found)
        mine: list[str] = []
        while time.monotonic() < end:
            what = rng.random()
            if (what < 0.4 and len(mine) < _MAX_PICKS) or not mine:
                ray, uv = random_pick(rng)
                reply = page.ask("add_pick", photo="p1", kind="point", scan=[ray], photo_uv=[uv])
                mine += [reply["pick"]] if reply["ok"] else []
            elif what < 0.7:
                page.ask("set_pick", photo="p1", pick=rng.choice(mine), photo_uv=[random_pick(rng)[1]])
            elif what < 0.95:
                page.ask("remove_picks", photo="p1", picks=[mine.pop(rng.randrange(len(mine)))])
            else:
                page.ask(rng.choice(["undo", "redo"]))
            edits[k] += 1
            time.sleep(rng.uniform(*pause_s))
        page.socket.close()

    workers = [threading.Thread(target=work, args=(k,)) for k in range(_CLIENTS)]
    for worker in workers:
        worker.start()
    begun, memory = time.monotonic(), []
    while time.monotonic() < end:
        memory.append((time.monotonic() - begun, found.memory_mb()))
        time.sleep(min(5.0, 60 * minutes / 12))
    for worker in workers:
        worker.join()
    return memory, sum(edits)
