"""The real server in a separate process: started, queried, edited by several clients, interrupted and killed."""

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

from testing.workbench.access import Access

CHECKOUT = Path(__file__).resolve().parents[2]
TOKEN = "a-token-of-abuse-for-all"
_ANSWERS_S = 60.0
_OPEN_FILES = 1024


class ServerGone(Exception):  # noqa: N818 - it is an expected event
    """The server or its connection ended during a request."""


@dataclass
class Server:
    """A running server."""

    process: subprocess.Popen[str]
    port: int
    said: Path
    """File with its stderr."""
    access: Access = field(default_factory=Access)

    @property
    def origin(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def ask(
        self, method: str, path: str, body: bytes | None = None, headers: Mapping[str, str] | None = None,
        *, timeout_s: float = _ANSWERS_S,
    ) -> tuple[int, dict[str, str], bytes]:  # fmt: skip
        """Send a request as a page would, and return status, headers and body."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=timeout_s)
        sent = {"Origin": self.origin, "Cookie": self.access.cookie} | dict(headers or {})
        try:
            connection.request(
                method, self.access.within(path), body, {name: value for name, value in sent.items() if value}
            )
            answer = connection.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        finally:
            connection.close()

    def enter(self) -> None:
        """Log in with the token and keep the session."""
        status, headers, _ = self.ask("GET", f"/?token={TOKEN}")
        if status != 200:
            raise ServerGone(f"the token was answered by {status}")
        self.access = Access.granted(headers)

    def upload(self, what: str, path: Path, *, photo: str = "", timeout_s: float = _ANSWERS_S) -> dict[str, Any]:
        """Upload a file and return the reply."""
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
        """Return the memory of the server and of its child processes, MB; NaN where unknown."""
        known = [_status_mb(pid, field_) for pid in (self.process.pid, *_below(self.process.pid))]
        return sum(known) if known[0] == known[0] else float("nan")

    def kill(self) -> None:
        """Kill it without warning."""
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
        """Return its stderr so far."""
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
    """Set up a new process as in a terminal: signals are not ignored, and 1,024 open files."""
    import resource

    for sent in (signal.SIGINT, signal.SIGHUP):
        signal.signal(sent, signal.SIG_DFL)
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(_OPEN_FILES, most) if most > 0 else _OPEN_FILES, most))


class Page:
    """A websocket like that of a page, and the slices received."""

    def __init__(self, server: Server, *, timeout_s: float = _ANSWERS_S) -> None:
        try:
            self.socket: ClientConnection = connect(
                f"ws://127.0.0.1:{server.port}{server.access.within('/document')}",
                additional_headers={"Cookie": server.access.cookie, "Origin": server.origin},
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
        """Apply the changes in a message."""
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
        """Send a request and return the reply; changes received before it are applied."""
        self.number += 1
        self.send(json.dumps({"id": self.number, "do": do, **fields}))
        return self.reply()

    def reply(self, timeout_s: float | None = None) -> dict[str, Any]:
        """Return the next reply to any request."""
        while "reply" not in (message := self.take(self.hear(timeout_s))):
            pass
        return message

    def is_saved(self, reply: Mapping[str, Any]) -> bool:
        """Return whether a reply, by itself or with the header's state, reports the edit as saved."""
        if not reply.get("ok"):
            return False
        return bool(reply.get("saved", not self.slices["project"]["unsaved"]))

    def close(self) -> None:
        """Close the connection."""
        with suppress(Exception):
            self.socket.close()


Spot = tuple[float, float]


@dataclass
class Editor:
    """A client that adds, moves and removes matches of one photograph, and records the replies."""

    photo: str
    rng: random.Random
    saved: dict[str, Spot | None] = field(default_factory=dict)
    """Matches whose last edit was reported as saved; None: removed."""
    open: dict[str, list[Spot | None]] = field(default_factory=dict)
    """Possible states of matches whose later edits were not reported as saved."""
    answered: int = 0
    """Edits reported as saved."""
    unsaved: int = 0
    """Edits with a reply that did not report them as saved."""

    def edit(self, page: Page, *, most: int = 30) -> bool:
        """Make a random edit; return whether it was reported as saved."""
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
        # A project is saved as a whole: with this edit all earlier ones are on disk.
        self.saved |= {other: spots[-1] for other, spots in self.open.items()}
        self.open.clear()
        return True

    def lost(self, there: Mapping[str, Spot]) -> list[str]:
        """Return edits reported as saved that are missing; then continue from the actual state.

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
    """Return the matches of a photograph as shown to a page: the position of each."""
    return {pick["id"]: tuple(pick["photo"][0]) for pick in page.slices[f"picks:{photo}"]}


def _below(pid: int) -> list[int]:
    """Return the descendants of a process."""
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
