"""The websocket `/document`: edits up, slices of the state down (docs/workbench.md)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Coroutine
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from ladarreg_core.errors import LadarregError

from ..process_resources import return_memory_soon
from .encoding import Encoded
from .json_text import NotJson, decode_object, encode
from .outbox import Outbox
from .protocol import Client, Workbench
from .told import Told
from .visitors import Visitors

log = logging.getLogger(__name__)
LONGEST_MESSAGE = 1_000_000
"""Characters of a message from a page."""
_TOO_LONG, _FAULT, _FULL = 1009, 1011, 1013
_LONGEST_REASON = 123
"""Bytes of the reason that a websocket is closed with."""
_NO_JSON = "This message is no JSON object: the page is of another version than the program; load the page anew."
_BROKEN = "The program failed here and what it shows is as it was before or after; start it with --debug to see why."


class DocumentSocket:
    """Serves the websocket.

    Args:
        workbench: answers.
        visitors: is told who has the page open.
    """

    def __init__(self, workbench: Workbench, visitors: Visitors) -> None:
        self._workbench, self._visitors = workbench, visitors
        self._encoded = Encoded()

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one page until it goes."""
        browser = websocket.state.browser
        await websocket.accept()
        try:
            client = await run_in_threadpool(self._workbench.join, websocket.state.address)
        except LadarregError as refusal:
            await websocket.close(_FULL, str(refusal).encode()[:_LONGEST_REASON].decode(errors="ignore"))
            return
        self._visitors.enter(browser, client)
        try:
            await self._serve(websocket, client)
        except (WebSocketDisconnect, asyncio.CancelledError):
            log.debug("%s left", client.name)
        except Exception:
            log.exception("the connection of %s failed", client.name)
            if websocket.application_state is WebSocketState.CONNECTED:
                await websocket.close(_FAULT)
        finally:
            self._visitors.leave(browser, client)
            await asyncio.shield(run_in_threadpool(self._workbench.leave, client))
            return_memory_soon()

    async def _serve(self, websocket: WebSocket, client: Client) -> None:
        loop, news, replied = asyncio.get_running_loop(), asyncio.Event(), asyncio.Event()

        def wake() -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended before those who tell the news
                loop.call_soon_threadsafe(news.set)

        outbox = Outbox(wake)
        # First the subscription: what changes while the slices are gathered is told after them.
        unsubscribe = self._workbench.subscribe(outbox.put)
        try:
            slices = await run_in_threadpool(self._workbench.slices, client)
            told = Told(client, self._encoded)
            await websocket.send_text(told.text({"slices": slices}))
            await _until_one_ends(
                _send_news(websocket, told, outbox, news, replied),
                self._receive(websocket, client, outbox, replied),
            )
        finally:
            unsubscribe()

    async def _receive(self, websocket: WebSocket, client: Client, outbox: Outbox, replied: asyncio.Event) -> None:
        while (received := await websocket.receive())["type"] != "websocket.disconnect":
            text = received.get("text")
            if text is not None and len(text) > LONGEST_MESSAGE:
                await websocket.close(_TOO_LONG, "a message of a page has at most 1 MB")
                return
            outbox.reply(await run_in_threadpool(self._answer, client, text))
            await replied.wait()  # a page that asks and does not listen is not heard any further
            replied.clear()

    def _answer(self, client: Client, text: str | None) -> str:
        try:
            message = decode_object(text or "")
        except NotJson:
            return encode({"reply": None, "ok": False, "error": _NO_JSON})
        number = message.get("id")
        number = number if isinstance(number, int | str) else None
        try:
            return encode({"reply": number} | self._workbench.answer(client, message))
        except Exception:
            log.exception("%r failed", message.get("do"))
            return encode({"reply": number, "ok": False, "error": _BROKEN})


async def _send_news(
    websocket: WebSocket, told: Told, outbox: Outbox, news: asyncio.Event, replied: asyncio.Event
) -> None:
    while await news.wait():
        news.clear()
        messages, reply = outbox.take()
        for message in messages:
            await websocket.send_text(told.text(message))
        if reply is not None:
            await websocket.send_text(reply)
            replied.set()


async def _until_one_ends(*works: Coroutine[Any, Any, None]) -> None:
    tasks = [asyncio.create_task(work) for work in works]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    for task in done:
        task.result()
