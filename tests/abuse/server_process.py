"""The real server in a process of its own: started, asked, edited by several people, interrupted and killed."""

from __future__ import annotations

import http.client
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from ladarreg.gateway.delta import apply_change
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

CHECKOUT = Path(__file__).resolve().parents[2]
TOKEN = "a-token-of-abuse"
_ANSWERS_S = 60.0
_OPEN_FILES = 1024


class ServerGone(Exception):  # noqa: N818 - it is the event that is waited for
    """The server, or its connection, ended while something was asked of it."""


@dataclass
class Server:
    """A running server."""

    process: subprocess.Popen[str]
    port: int
    said: Path
    """The file of what it says on stderr."""
    cookie: str = ""

    @property
    def origin(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def ask(
        self, method: str, path: str, body: bytes | None = None, headers: Mapping[str, str] | None = None,
        *, timeout_s: float = _ANSWERS_S,
    ) -> tuple[int, dict[str, str], bytes]:  # fmt: skip
        """Send a request as a page would, and return status, headers and body."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=timeout_s)
        sent = {"Origin": self.origin, "Cookie": self.cookie} | dict(headers or {})
        try:
            connection.request(method, path, body, {name: value for name, value in sent.items() if value})
            answer = connection.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        finally:
            connection.close()

    def enter(self) -> None:
        """Show the token and keep the cookie."""
        status, headers, _ = self.ask("GET", f"/?token={TOKEN}")
        if status != 200:
            raise ServerGone(f"the token was answered by {status}")
        self.cookie = headers["set-cookie"].partition(";")[0]

    def upload(self, what: str, path: Path, *, photo: str = "", timeout_s: float = _ANSWERS_S) -> dict[str, Any]:
        """Upload a file and return the answer."""
        query = f"what={what}" + (f"&photo={photo}" if photo else "")
        _, _, body = self.ask(
            "POST", f"/upload?{query}", path.read_bytes(), {"X-File-Name": quote(path.name)}, timeout_s=timeout_s
        )
        answer = json.loads(body)
        assert isinstance(answer, dict)
        return answer

    def page(self) -> Page:
        """Open the document as a page does."""
        return Page(self)

    def memory_mb(self, field_: str = "VmRSS") -> float:
        """Return the memory of the server and of the processes that it started, MB; nan where it cannot be known."""
        known = [_status_mb(pid, field_) for pid in (self.process.pid, *_below(self.process.pid))]
        return sum(known) if known[0] == known[0] else float("nan")

    def kill(self) -> None:
        """End it without warning."""
        self.process.kill()
        self.process.wait(30)
        self._close()

    def stop(self, *signals: signal.Signals, apart_s: float = 0.1, within_s: float = 60.0) -> int:
        """Send signals one after the other, wait for the end, and return the exit code.

        Raises:
            subprocess.TimeoutExpired: if it does not end in time; it is killed then.
        """
        for k, sent in enumerate(signals or (signal.SIGTERM,)):
            if k:
                time.sleep(apart_s)
            with suppress(ProcessLookupError):
                self.process.send_signal(sent)
        try:
            return self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(30)
            raise
        finally:
            self._close()

    def stderr(self) -> str:
        """Return what it has said."""
        return self.said.read_text(encoding="utf-8", errors="replace")

    def _close(self) -> None:
        if self.process.stdout is not None:
            self.process.stdout.close()

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.kill()
        self._close()


def start_server(
    room: Path, project: Path, *inputs: Path, more: Sequence[str] = (), environment: Mapping[str, str] | None = None
) -> Server:
    """Start `ladarreg serve` and return when it answers.

    Args:
        room: a folder for what it says and for its own settings; it is also where it runs.
        project: the project's folder.
        inputs: files to begin the project with.
        more: further words of the command line.
        environment: further variables.

    Raises:
        ServerGone: if it does not come.
    """
    room.mkdir(parents=True, exist_ok=True)
    said = room / f"stderr-{time.monotonic_ns()}.txt"
    surroundings = {
        **os.environ, "LADARREG_HOME": str(room / "home"), "OMP_NUM_THREADS": "1", "PYTHONPATH": str(CHECKOUT),
        **(environment or {}),
    }  # fmt: skip
    words = [
        sys.executable, "-m", "ladarreg", "serve", *map(str, inputs), "--project", str(project), "--port", "0",
        "--no-browser", "--token", TOKEN, *more,
    ]  # fmt: skip
    with said.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=stream, text=True, cwd=room, env=surroundings,
            preexec_fn=_as_from_a_shell if os.name == "posix" else None,
        )  # fmt: skip
    server = Server(process, 0, said)
    try:
        assert process.stdout is not None
        address = next((word for word in process.stdout.readline().split() if "://" in word), None)
        if address is None:
            raise ServerGone(server.stderr().strip()[-600:] or "it said nothing")
        server.port = urlsplit(address).port or 0
        server.enter()
    except BaseException:
        server.kill()
        raise
    return server


def _as_from_a_shell() -> None:
    """Give a new process what it has in a terminal: signals that are heard, and 1,024 open files."""
    import resource

    for sent in (signal.SIGINT, signal.SIGHUP):
        signal.signal(sent, signal.SIG_DFL)
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(_OPEN_FILES, most) if most > 0 else _OPEN_FILES, most))


class Page:
    """A websocket as a page has it, and the slices that it was sent."""

    def __init__(self, server: Server, *, timeout_s: float = _ANSWERS_S) -> None:
        try:
            self.socket: ClientConnection = connect(
                f"ws://127.0.0.1:{server.port}/document",
                additional_headers={"Cookie": server.cookie, "Origin": server.origin},
                max_size=None, ping_interval=None, compression=None, proxy=None, open_timeout=timeout_s,
            )  # fmt: skip
        except (OSError, TimeoutError) as error:
            raise ServerGone(f"no page can be opened: {error}") from None
        self.number = 0
        self.timeout_s = timeout_s
        self.slices: dict[str, Any] = {}
        self.take(self.hear())

    def hear(self, timeout_s: float | None = None) -> dict[str, Any]:
        """Return the next message.

        Raises:
            ServerGone: if the connection ended.
            TimeoutError: if none comes in time.
        """
        try:
            message = json.loads(self.socket.recv(timeout=timeout_s or self.timeout_s))
        except (ConnectionClosed, OSError) as error:
            if isinstance(error, TimeoutError):
                raise
            raise ServerGone(str(error)) from None
        assert isinstance(message, dict), message
        return message

    def take(self, message: dict[str, Any]) -> dict[str, Any]:
        """Note what a message changes."""
        self.slices.update(message.get("slices", {}))
        for name, change in message.get("changes", {}).items():
            self.slices[name] = apply_change(self.slices[name], change)
        return message

    def send(self, text: str | bytes) -> None:
        """Send anything.

        Raises:
            ServerGone: if the connection ended.
        """
        try:
            self.socket.send(text)
        except (ConnectionClosed, OSError) as error:
            raise ServerGone(str(error)) from None

    def ask(self, do: str, **fields: Any) -> dict[str, Any]:
        """Ask, and return the reply; what is told before it is noted."""
        self.number += 1
        self.send(json.dumps({"id": self.number, "do": do, **fields}))
        return self.reply()

    def reply(self, timeout_s: float | None = None) -> dict[str, Any]:
        """Return the next reply, whatever it answers."""
        while "reply" not in (message := self.take(self.hear(timeout_s))):
            pass
        return message

    def is_saved(self, reply: Mapping[str, Any]) -> bool:
        """Tell whether a reply says, alone or with what the header shows, that the edit is on the disk."""
        if not reply.get("ok"):
            return False
        return bool(reply.get("saved", not self.slices["project"]["unsaved"]))

    def close(self) -> None:
        """Go."""
        with suppress(Exception):
            self.socket.close()


Spot = tuple[float, float]


@dataclass
class Editor:
    """One person who puts down, moves and removes matches of one photograph, and remembers what was answered."""

    photo: str
    rng: random.Random
    saved: dict[str, Spot | None] = field(default_factory=dict)
    """Matches whose last edit was answered as saved; None: removed."""
    open: dict[str, list[Spot | None]] = field(default_factory=dict)
    """What may have become of matches whose later edits were not answered as saved."""
    answered: int = 0
    """Edits that were answered as saved."""
    unsaved: int = 0
    """Edits that were answered, but not as saved."""

    def edit(self, page: Page, *, most: int = 30) -> bool:
        """Do something at random; return whether it was answered as saved."""
        there = [name for name, spot in self._newest().items() if spot is not None]
        spot = (round(self.rng.uniform(5, 700), 3), round(self.rng.uniform(5, 500), 3))
        what = self.rng.random()
        if not there or (what < 0.45 and len(there) < most):
            ray = [1.0, self.rng.uniform(-0.35, 0.35), self.rng.uniform(-0.2, 0.2)]
            reply = page.ask("add_pick", photo=self.photo, kind="point", scan=[ray], photo_uv=[list(spot)])
            if not reply["ok"]:
                raise AssertionError(reply)
            return self._note(page, reply, reply["pick"], spot)
        name = self.rng.choice(there)
        if what < 0.75:
            self.open.setdefault(name, []).append(spot)
            reply = page.ask("set_pick", photo=self.photo, pick=name, photo_uv=[list(spot)])
            return self._note(page, reply, name, spot)
        self.open.setdefault(name, []).append(None)
        reply = page.ask("remove_picks", photo=self.photo, picks=[name])
        return self._note(page, reply, name, None)

    def _newest(self) -> dict[str, Spot | None]:
        return self.saved | {name: spots[-1] for name, spots in self.open.items()}

    def _note(self, page: Page, reply: Mapping[str, Any], name: str, spot: Spot | None) -> bool:
        if not reply["ok"]:
            raise AssertionError(reply)
        self.open.setdefault(name, []).append(spot)
        if not page.is_saved(reply):
            self.unsaved += 1
            return False
        self.answered += 1
        # A project is saved whole: with this edit all that was answered before is on the disk.
        self.saved |= {other: spots[-1] for other, spots in self.open.items()}
        self.open.clear()
        return True

    def lost(self, there: Mapping[str, Spot]) -> list[str]:
        """Return what was answered as saved and is not there; then go on from what is there.

        Args:
            there: all matches of the photograph, found after opening the project again.
        """
        found = []
        for name, spot in self.saved.items():
            allowed = [spot, *self.open.get(name, [])]
            if there.get(name) not in allowed:
                found.append(f"match {name} of {self.photo} is {there.get(name)}, and {spot} was answered as saved")
        self.saved = {name: there[name] for name in self._newest() if name in there}
        self.open.clear()
        return found


def matches_of(page: Page, photo: str) -> dict[str, Spot]:
    """Return the matches of a photograph as a page shows them: where each stands in it."""
    return {pick["id"]: tuple(pick["photo"][0]) for pick in page.slices[f"picks:{photo}"]}


def _below(pid: int) -> list[int]:
    """Return the processes that a process started, and they."""
    found: list[int] = []
    for task in Path("/proc").glob(f"{pid}/task/*/children"):
        with suppress(OSError, ValueError):
            for child in map(int, task.read_text(encoding="ascii").split()):
                found += [child, *_below(child)]
    return found


def _status_mb(pid: int, name: str) -> float:
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return float("nan") if not Path("/proc/self/status").exists() else 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{name}:")), 0.0)
