"""A small workbench behind the real gateway, on a real socket."""

from __future__ import annotations

import asyncio
import http.client
import json
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ladarreg.gateway.options import ConnectionLimits, GatewayOptions
from ladarreg.gateway.protocol import Message, Picture, Visitor
from ladarreg.gateway.routes import build_site
from ladarreg.gateway.server import Gateway
from ladarreg.gateway.viser_backend import ViserAddress
from websockets.asyncio.client import connect as asyncio_connect
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from ladarreg_core.errors import FormatError, OptionError
from testing.workbench.access import Access

TOKEN = "a-token-of-tests-for-all"
LOOK_TOKEN = "a-read-only-token-of-tests"
PATIENT = ConnectionLimits(header_s=60.0)
"""A crowded machine may take more than the usual ten seconds over a TLS handshake."""
PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256))


@dataclass
class Page:
    name: str
    visitor: Visitor

    @property
    def id(self) -> str:
        return self.name.replace(" ", "-")


@dataclass
class Limits:
    upload_bytes: int = 300_000


class CountingWorkbench:
    """Holds a number that clients may set, and the files that they upload."""

    def __init__(self, room: Path) -> None:
        self.room, self.limits = room, Limits()
        self.urgent_commands = frozenset({"acquire_stop"})
        self.lock = threading.Lock()
        self.number, self.version, self.joined, self.most = 0, 0, 0, 100
        self.listeners: list[Callable[[Message], None]] = []
        self.pages: list[Page] = []
        self.done: list[str] = []
        self.slow = threading.Event()
        self.taken: list[tuple[str, str, str | None, bytes, Page | None]] = []

    def slices(self, client: Page) -> dict[str, Any]:
        return {"number": self.number, "people": {"count": len(self.pages), "you": client.id}, "scan": None}

    def subscribe(self, listener: Callable[[Message], None], client: Page) -> Callable[[], None]:
        with self.lock:
            self.listeners.append(listener)

        def end() -> None:
            with self.lock:
                self.listeners.remove(listener)

        return end

    def tell(self, message: Message) -> None:
        with self.lock:
            listeners = list(self.listeners)
        for listener in listeners:
            listener(message)

    def join(self, visitor: Visitor) -> Page:
        with self.lock:
            if len(self.pages) >= self.most:
                raise OptionError(f"{self.most} page is open, the most: close it.")
            self.joined += 1
            page = Page(f"Operator {self.joined}", visitor)
            self.pages.append(page)
        return page

    def leave(self, client: Page) -> None:
        with self.lock:
            self.pages.remove(client)

    def answer(self, client: Page, message: dict[str, Any]) -> dict[str, Any]:
        if message.get("do") == "fail":
            raise RuntimeError("a secret of the program")
        if message.get("do") == "slow":
            self.slow.wait(30)
        self.done.append(str(message.get("do")))
        if message.get("do") == "set":
            with self.lock:
                self.number, self.version = message["number"], self.version + 1
            self.tell({"slices": {"number": self.number}, "version": self.version})
        return {"ok": True, "number": self.number, "nan": float("nan"), "you": client.name}

    def picture(self, path: str, query: Mapping[str, str]) -> Picture:
        if path != "scan":
            raise FormatError(f"there is no picture {path!r}; ask for another")
        if query.get("show") == "nonsense":
            raise OptionError("it can show intensity; choose that")
        return Picture(PNG, "image/png", f'"{query.get("rev", "none")}"\r\n')

    def first_pictures(self) -> dict[str, str]:
        return {"scan": "picture/scan?rev=1&form=quick"}

    def upload_folder(self) -> Path:
        return self.room

    def take_upload(self, path: Path, name: str, what: str, photo: str | None, client: Page | None) -> str:
        data = path.read_bytes()
        if data.startswith(b"bad"):
            path.unlink()
            raise FormatError(f"{path}: this is no scan; choose another than {path.name}")
        path.unlink()
        self.taken.append((name, what, photo, data, client))
        return f"u{len(self.taken)}"

    def export_file(self, name: str, ending: str = "zip") -> tuple[Path, str] | None:
        path = self.room / f"{name}.{ending}"
        return (path, f"wände.{ending}") if name == "p1" and path.is_file() else None


class _SocketConnection(http.client.HTTPConnection):
    """A connection to a Unix socket."""

    def __init__(self, path: Path, port: int) -> None:
        super().__init__("127.0.0.1", port, timeout=60)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(self.timeout)
        self.sock.connect(str(self._path))


@dataclass
class Running:
    """A running gateway, with helpers to send it requests."""

    bench: CountingWorkbench
    gateway: Gateway
    tls: ssl.SSLContext | None = None
    path: Path | None = None
    """The Unix socket, if it listens on one."""
    access: Access = field(init=False, default_factory=Access)

    @property
    def port(self) -> int:
        return self.gateway.port

    @property
    def origin(self) -> str:
        return f"http{'s' if self.tls else ''}://127.0.0.1:{self.port}"

    def ask(
        self, method: str, path: str, headers: Mapping[str, str] | None = None, body: Any = None, *, known: bool = True
    ) -> tuple[int, dict[str, str], bytes]:
        """Send a request as our own page would; headers with an empty value are omitted.

        With `known`, the path is that within the session.
        """
        connection = (
            http.client.HTTPSConnection("127.0.0.1", self.port, timeout=60, context=self.tls)
            if self.tls
            else _SocketConnection(self.path, self.port)
            if self.path
            else http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        )
        sent = {"Origin": self.origin, "Cookie": self.access.cookie if known else ""} | dict(headers or {})
        try:
            connection.request(
                method,
                self.access.within(path) if known else path,
                body,
                {name: value for name, value in sent.items() if value},
            )
            answer = connection.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        finally:
            connection.close()

    def enter(self, token: str = "") -> None:
        """Submit a token and keep the session."""
        status, headers, _ = self.ask("GET", f"/?token={token or TOKEN}", known=False)
        assert status == 200
        self.access = Access.granted(headers)

    def socket(
        self, path: str = "/document", headers: Mapping[str, str] | None = None, **more: Any
    ) -> ClientConnection:
        """Open a websocket as our own page would."""
        assert self.tls is None, (
            "this client reads and writes in two threads, which Python's TLS sockets do not survive"
        )
        sent = {"Origin": self.origin, "Cookie": self.access.cookie} | dict(headers or {})
        return connect(
            f"ws://127.0.0.1:{self.port}{self.access.within(path)}",
            additional_headers={name: value for name, value in sent.items() if value},
            proxy=None,
            open_timeout=60,  # a crowded machine may take its time; whatever hangs is still found
            **({"unix": True, "path": str(self.path)} if self.path else {}),
            **({"max_size": None, "compression": None} | more),
        )

    def first_message(self, path: str, **more: Any) -> str | bytes:
        """Open a websocket, over TLS if the gateway has it, and return the first message."""

        async def receive() -> str | bytes:
            async with (
                asyncio.timeout(60),
                asyncio_connect(
                    f"{self.origin.replace('http', 'ws', 1)}{self.access.within(path)}",
                    additional_headers={"Origin": self.origin, "Cookie": self.access.cookie},
                    ssl=self.tls,
                    proxy=None,
                    open_timeout=60,
                    **({"max_size": None, "compression": None} | more),
                ) as page,
            ):
                return await page.recv()

        with ThreadPoolExecutor(1) as thread:  # a browser's test may have left an event loop in this one
            return thread.submit(asyncio.run, receive()).result()


@contextmanager
def running(
    room: Path, viser: ViserAddress | Callable[[], ViserAddress] | None = None, **options: Any
) -> Iterator[Running]:
    """Run a gateway, and log in to it."""
    tls = options.pop("context", None)
    settings = GatewayOptions(**({"port": 0, "limits": PATIENT} | options))
    bench = CountingWorkbench(room)
    where = viser or ViserAddress("127.0.0.1", 9, "no server")
    gateway = Gateway(
        lambda _: build_site(
            bench,
            token=TOKEN,
            read_only_token=LOOK_TOKEN,
            viser=where if callable(where) else lambda: where,
            options=settings,
        ),
        settings,
    )
    gateway.start()
    run = Running(bench, gateway, tls, settings.socket)
    try:
        run.enter()
        yield run
    finally:
        gateway.close()


def hear(socket: ClientConnection) -> dict[str, Any]:
    """Return the next message."""
    message = json.loads(socket.recv(timeout=60))
    assert isinstance(message, dict)
    return message


def closing_code(socket: ClientConnection) -> int:
    """Receive until the other side closes, and return its code; 1006 if there is none."""
    try:
        while True:
            socket.recv(timeout=60)
    except ConnectionClosed as closed:
        return closed.rcvd.code if closed.rcvd else 1006


def soon(what: Callable[[], bool], *, seconds: float = 60.0) -> bool:
    """Return whether a condition becomes true in time."""
    until = time.monotonic() + seconds
    while not what():
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True
