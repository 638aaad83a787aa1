"""viser under `/viser/`: its page and its websocket, forwarded to the loopback port that only we can open."""

from __future__ import annotations

import asyncio
import http.client
import logging
import re
import time
from collections.abc import Callable, Iterator

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.typing import Subprotocol

from ..process_resources import return_memory_soon
from .viser_lock import HEADER, ViserAddress

log = logging.getLogger(__name__)
_PASSED_ON = ("content-type", "content-length", "content-encoding")
_PLAIN = re.compile(r"[A-Za-z0-9/._~-]*")
"""Paths of viser's own files; anything else is not there, and some of it cannot be asked for."""
_BLOCK = 1 << 16
_TIMEOUT_S = 10.0
_APART_S = 0.15
"""Between the beginnings of two views: many that come at once must not keep the others waiting."""
_CLOSE_S = 0.5
"""viser in the middle of a scene that nobody takes any more does not hear of the end."""
_LOST, _NOT_BINARY, _GOING = 1011, 1003, 1001
_AWAY = "The 3-D view does not answer; start the workbench again."
_FULL = "{most} pages show the 3-D view, which is the most; close one of them and load this page again."


class ViserProxy:
    """Forwards pages and websockets.

    Args:
        viser: tells where its server listens; may wait for it, and raises `OSError` where it does not come.
        most: websockets at a time.
    """

    def __init__(self, viser: Callable[[], ViserAddress], *, most: int) -> None:
        self._viser, self._most = viser, most
        self._views = 0
        self._next_turn_s = 0.0

    async def page(self, request: Request) -> Response:
        """Forward a page; its query stays here."""
        path = "/" + request.path_params.get("path", "")
        if any(part in (".", "..") for part in path.split("/")) or not _PLAIN.fullmatch(path):
            return PlainTextResponse("Not Found", status_code=404)
        if path == "/" and self._views >= self._most:
            return self._full()
        try:
            answer = await run_in_threadpool(self._get, path, request.headers.get("accept-encoding", "identity"))
        except (OSError, http.client.HTTPException) as error:
            log.warning("viser does not answer: %s", error)
            return PlainTextResponse(f"{_AWAY}\n", status_code=502)
        headers = {name: value for name, value in answer.getheaders() if name.lower() in _PASSED_ON}
        return StreamingResponse(_blocks(answer), status_code=answer.status, headers=headers)

    async def websocket(self, websocket: WebSocket) -> None:
        """Forward a websocket, both ways, until either side closes."""
        if self._views >= self._most:
            await websocket.send_denial_response(self._full())
            return
        self._views += 1
        try:
            await self._serve(websocket)
        finally:
            self._views -= 1
            return_memory_soon(even_if_small=True)

    def _full(self) -> Response:
        return PlainTextResponse(_FULL.format(most=self._most) + "\n", status_code=503)

    async def _turn(self) -> None:
        now = time.monotonic()
        turn = max(now, self._next_turn_s)
        self._next_turn_s = turn + _APART_S
        await asyncio.sleep(turn - now)

    async def _serve(self, websocket: WebSocket) -> None:
        offered = [Subprotocol(name) for name in websocket.scope["subprotocols"]]
        try:
            address = await run_in_threadpool(self._viser)
            await self._turn()
            viser = await connect(
                f"ws://{address.host}:{address.port}/",
                subprotocols=offered or None,
                additional_headers={HEADER: address.secret},
                compression=None,
                max_size=None,
                max_queue=1,
                ping_interval=None,
                open_timeout=_TIMEOUT_S,
                close_timeout=_CLOSE_S,
                proxy=None,
            )
        except (OSError, WebSocketException) as error:  # a TimeoutError is an OSError
            log.warning("viser does not answer: %s", error)
            await websocket.send_denial_response(PlainTextResponse(f"{_AWAY}\n", status_code=502))
            return
        try:
            await websocket.accept(subprotocol=viser.subprotocol)
            await self._forward(websocket, viser)
        finally:
            await viser.close()

    async def _forward(self, websocket: WebSocket, viser: ClientConnection) -> None:
        up = asyncio.create_task(_up(websocket, viser))
        down = asyncio.create_task(_down(viser, websocket))
        try:
            await asyncio.wait((up, down), return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (up, down):
                task.cancel()
            await asyncio.gather(up, down, return_exceptions=True)

    def _get(self, path: str, encoding: str) -> http.client.HTTPResponse:
        address = self._viser()
        connection = http.client.HTTPConnection(address.host, address.port, timeout=_TIMEOUT_S)
        headers = {HEADER: address.secret, "Accept-Encoding": encoding, "Connection": "close"}
        connection.request("GET", path, headers=headers)
        return connection.getresponse()


async def _up(websocket: WebSocket, viser: ClientConnection) -> None:
    try:
        while (message := await websocket.receive())["type"] == "websocket.receive":
            data = message.get("bytes")
            if data is None:
                await websocket.close(_NOT_BINARY)
                return
            await viser.send(data)
    except ConnectionClosed:
        await _close(websocket, viser)
    except WebSocketDisconnect:
        return


async def _down(viser: ClientConnection, websocket: WebSocket) -> None:
    try:
        # Each send waits until the browser has taken what went before, and viser is not read meanwhile.
        async for data in viser:
            await websocket.send_bytes(data if isinstance(data, bytes) else data.encode())
    except WebSocketDisconnect:
        return
    except ConnectionClosed:
        log.debug("viser closed with an error")
    await _close(websocket, viser)


async def _close(websocket: WebSocket, viser: ClientConnection) -> None:
    code = viser.close_code or _LOST
    try:
        await websocket.close(code if code in (1000, _GOING) or 3000 <= code < 5000 else _LOST, viser.close_reason)
    except (RuntimeError, WebSocketDisconnect):  # it closed at the same time
        return


def _blocks(answer: http.client.HTTPResponse) -> Iterator[bytes]:
    with answer:
        while block := answer.read(_BLOCK):
            yield block
