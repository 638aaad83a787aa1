"""viser under `/viser/`: its page and websocket, forwarded to the loopback port that only the gateway can open."""

from __future__ import annotations

import asyncio
import http.client
import logging
import re
import threading
import time
from collections.abc import Callable, Iterator

import msgspec
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response, StreamingResponse
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.typing import Subprotocol

from ..process_resources import return_memory_soon
from .document_socket import ClientRegistry
from .seats import Seats
from .viser_backend import CLIENT_HEADER, SECRET_HEADER, ViserAddress
from .viser_page import PAGE_NAME, ViserPage

log = logging.getLogger(__name__)
_FORWARDED_HEADERS = ("content-type", "content-length", "content-encoding")
_CLIENT = re.compile(r"([A-Za-z0-9_-]{4,64})/?")
_PATH = re.compile(r"[A-Za-z0-9/._~-]*")
"""Paths of viser's own files; any other does not exist, and some cannot even be requested."""
_BLOCK = 1 << 16
_TIMEOUT_S = 10.0
_VIEW_INTERVAL_S = 0.15
"""Minimum time between the starts of two views: many at once must not delay other requests."""
_CLOSE_S = 0.5
"""viser, while it sends a scene that is no longer read, does not notice the close."""
_INTERNAL_ERROR, _NOT_BINARY, _GOING_AWAY = 1011, 1003, 1001
_UNAVAILABLE = "The 3-D view does not respond; restart the workbench."
_STRANGER = "This 3-D view belongs to another page; reload the workbench."
_IMMUTABLE, _REVALIDATE = "private, max-age=31536000, immutable", "private, no-cache"
_FULL = "{most} pages show the 3-D view, which is the limit; close one of them and reload this page."


_LOOKING = frozenset({"ViewerCameraMessage"})
"""Messages that a browser may send which is only permitted to look."""


class _Message(msgspec.Struct):
    type: str


_MESSAGE_TYPE = msgspec.msgpack.Decoder(_Message)


class ViserProxy:
    """Forwards pages and websockets.

    Args:
        viser: returns the address of its server; may block until it is open, and raises `OSError` if it never is.
        clients: the open pages of each browser.
        most: websockets at a time, those of readers included.
    """

    def __init__(self, viser: Callable[[], ViserAddress], clients: ClientRegistry, *, most: int) -> None:
        self._viser, self._clients, self._seats = viser, clients, Seats(most)
        self._own_page: ViserPage | None = None
        self._views = {True: 0, False: 0}  # of those who may only look, and of the others
        self._next_start_s = 0.0

    @property
    def known_address(self) -> str | None:
        """URL, relative to the workbench's page, of the page that all clients share; None until viser delivered it."""
        return None if self._own_page is None else f"viser/{PAGE_NAME}?{self._own_page.digest}"

    def prepare(self) -> None:
        """Load the page that all clients share as soon as viser is open, in a thread."""

        def load() -> None:
            try:
                self._page()
            except (OSError, http.client.HTTPException) as error:  # who requests the page gets the error
                log.debug("viser does not respond: %s", error)

        threading.Thread(target=load, name="viser page", daemon=True).start()

    async def page(self, request: Request) -> Response:
        """Return the page of a client, the page that all share, or another file of viser."""
        path = "/" + request.path_params.get("path", "")
        if any(part in (".", "..") for part in path.split("/")) or not _PATH.fullmatch(path):
            return PlainTextResponse("Not Found", status_code=404)
        client = _CLIENT.fullmatch(path[1:]) if path.endswith("/") else None
        if (client or path == "/") and not self._has_seat(read_only=request.state.read_only):
            return self._full(read_only=request.state.read_only)
        try:
            if client:
                if not self._clients.has(request.state.browser, client[1]):
                    return PlainTextResponse(f"{_STRANGER}\n", status_code=403)
                page = await run_in_threadpool(self._page)
                return HTMLResponse(page.shell, headers={"cache-control": _REVALIDATE})
            if path in ("/", "/index.html", f"/{PAGE_NAME}"):
                return _page_response(await run_in_threadpool(self._page), request)
            answer = await run_in_threadpool(self._get, path, request.headers.get("accept-encoding", "identity"))
        except (OSError, http.client.HTTPException) as error:
            log.warning("viser does not respond: %s", error)
            return PlainTextResponse(f"{_UNAVAILABLE}\n", status_code=502)
        headers = {name: value for name, value in answer.getheaders() if name.lower() in _FORWARDED_HEADERS}
        return StreamingResponse(_blocks(answer), status_code=answer.status, headers=headers)

    async def websocket(self, websocket: WebSocket) -> None:
        """Forward a websocket in both directions until either side closes; with an id, that of a client."""
        name = websocket.path_params.get("client", "")
        client = _CLIENT.fullmatch(name)
        if name and not (client and self._clients.has(websocket.state.browser, client[1])):
            await websocket.send_denial_response(PlainTextResponse(f"{_STRANGER}\n", status_code=403))
            return
        read_only = websocket.state.read_only
        if not self._has_seat(read_only=read_only):
            await websocket.send_denial_response(self._full(read_only=read_only))
            return
        self._views[read_only] += 1
        try:
            await self._serve(websocket, client[1] if client else "")
        finally:
            self._views[read_only] -= 1
            return_memory_soon(force=True)

    def _has_seat(self, *, read_only: bool) -> bool:
        return self._seats.is_free(taken=sum(self._views.values()), by_readers=self._views[True], read_only=read_only)

    def _full(self, *, read_only: bool) -> Response:
        most = self._seats.limit(read_only=read_only)
        return PlainTextResponse(_FULL.format(most=most) + "\n", status_code=503)

    async def _wait_for_start(self) -> None:
        now = time.monotonic()
        start = max(now, self._next_start_s)
        self._next_start_s = start + _VIEW_INTERVAL_S
        await asyncio.sleep(start - now)

    async def _serve(self, websocket: WebSocket, client: str) -> None:
        offered = [Subprotocol(name) for name in websocket.scope["subprotocols"]]
        try:
            address = await run_in_threadpool(self._viser)
            await self._wait_for_start()
            viser = await connect(
                f"ws://{address.host}:{address.port}/",
                subprotocols=offered or None,
                additional_headers={SECRET_HEADER: address.secret, CLIENT_HEADER: client},
                compression=None,
                max_size=None,
                max_queue=1,
                ping_interval=None,
                open_timeout=_TIMEOUT_S,
                close_timeout=_CLOSE_S,
                proxy=None,
            )
        except (OSError, WebSocketException) as error:  # a TimeoutError is an OSError
            log.warning("viser does not respond: %s", error)
            self._own_page = None  # whoever opens the page again is told, too
            await websocket.send_denial_response(PlainTextResponse(f"{_UNAVAILABLE}\n", status_code=502))
            return
        try:
            await websocket.accept(subprotocol=viser.subprotocol)
            await self._forward(websocket, viser)
        finally:
            await viser.close()

    async def _forward(self, websocket: WebSocket, viser: ClientConnection) -> None:
        up = asyncio.create_task(_to_viser(websocket, viser))
        down = asyncio.create_task(_to_browser(viser, websocket))
        try:
            await asyncio.wait((up, down), return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (up, down):
                task.cancel()
            await asyncio.gather(up, down, return_exceptions=True)

    def _page(self) -> ViserPage:
        if self._own_page is None:
            with self._get("/", "identity") as answer:
                self._own_page = ViserPage.of(answer.read())
        return self._own_page

    def _get(self, path: str, encoding: str) -> http.client.HTTPResponse:
        address = self._viser()
        connection = http.client.HTTPConnection(address.host, address.port, timeout=_TIMEOUT_S)
        headers = {SECRET_HEADER: address.secret, "Accept-Encoding": encoding, "Connection": "close"}
        connection.request("GET", path, headers=headers)
        return connection.getresponse()


async def _to_viser(websocket: WebSocket, viser: ClientConnection) -> None:
    try:
        while (message := await websocket.receive())["type"] == "websocket.receive":
            data = message.get("bytes")
            if data is None:
                await websocket.close(_NOT_BINARY)
                return
            if not websocket.state.read_only or _only_looks(data):
                await viser.send(data)
    except ConnectionClosed:
        await _close(websocket, viser)
    except WebSocketDisconnect:
        return


def _only_looks(data: bytes) -> bool:
    """Return whether a message of the browser only moves its own camera."""
    try:
        return _MESSAGE_TYPE.decode(data).type in _LOOKING
    except msgspec.DecodeError:
        return False


async def _to_browser(viser: ClientConnection, websocket: WebSocket) -> None:
    try:
        # Each send waits until the browser has read the previous data; viser is not read meanwhile.
        async for data in viser:
            await websocket.send_bytes(data if isinstance(data, bytes) else data.encode())
    except WebSocketDisconnect:
        return
    except ConnectionClosed:
        log.debug("viser closed with an error")
    await _close(websocket, viser)


async def _close(websocket: WebSocket, viser: ClientConnection) -> None:
    code = viser.close_code or _INTERNAL_ERROR
    try:
        await websocket.close(
            code if code in (1000, _GOING_AWAY) or 3000 <= code < 5000 else _INTERNAL_ERROR, viser.close_reason
        )
    except (RuntimeError, WebSocketDisconnect):  # the browser closed at the same time
        return


def _page_response(page: ViserPage, request: Request) -> Response:
    named = request.url.query == page.digest
    headers = {"cache-control": _IMMUTABLE if named else _REVALIDATE, "vary": "accept-encoding"}
    packed = "gzip" in request.headers.get("accept-encoding", "")
    if packed:
        headers["content-encoding"] = "gzip"
    return Response(page.packed if packed else page.plain, media_type="text/html", headers=headers)


def _blocks(answer: http.client.HTTPResponse) -> Iterator[bytes]:
    with answer:
        while block := answer.read(_BLOCK):
            yield block
