"""The websocket `/document`: edits up, slices of the state down (docs/workbench.md)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Coroutine
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from ladarreg_core.errors import LadarregError

from ..process_resources import return_memory_soon
from .encoding import Encoded, NotJson, decode_object, encode
from .protocol import Client, Message, Workbench

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


class Told:
    """The slices as a page has them; its messages are numbered, so that it would notice if it missed one.

    Args:
        client: the page.
        encoded: shared by all pages.
    """

    def __init__(self, client: Client, encoded: Encoded) -> None:
        self._client, self._encoded = client, encoded
        self._slices: dict[str, Any] = {}
        self._version = 0

    def text(self, message: Message) -> str:
        """Return a message as this page is to be sent it, and take it for sent."""
        return self._news(message["slices"]) if "slices" in message else encode(message)

    def _news(self, slices: dict[str, Any]) -> str:
        self._version += 1
        whole: dict[str, Any] = {}
        changes: dict[str, Any] = {}
        for name, value in slices.items():
            if name == "people" and value:  # everybody is somebody else in it
                whole[name] = value | {"you": self._client.name}
                continue
            before = self._slices.get(name)
            change = None if before is None or value is None else self._encoded.change(before, value)
            if change is None:
                whole[name] = self._encoded.slice(value)
            else:
                changes[name] = change
        self._slices = {name: value for name, value in (self._slices | slices).items() if value is not None}
        parts = {"slices": whole, "changes": changes} if changes else {"slices": whole}
        return encode({**parts, "version": self._version})


_MOST_EVENTS = 200
_NEWEST_WINS = frozenset({"simplex", "hover"})
"""Events of which only the last one says anything."""


class Outbox:
    """Messages to one page; filled from any thread, emptied by one task.

    Args:
        wake: called, from the thread that fills, when there is something after there was nothing.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._lock = threading.Lock()
        self._slices: dict[str, Any] = {}
        self._rest_of_slices: dict[str, Any] = {}
        self._newest: dict[str, Message] = {}
        self._events: deque[Message] = deque(maxlen=_MOST_EVENTS)
        self._reply: str | None = None

    def put(self, message: Message) -> None:
        """Add slices, which replace those of the same name, or an event."""
        with self._lock:
            idle = self._is_empty()
            if "slices" in message:
                self._slices.update(message["slices"])
                self._rest_of_slices = {name: value for name, value in message.items() if name != "slices"}
            elif message.get("event") in _NEWEST_WINS:
                self._newest[message["event"]] = message
            else:
                self._events.append(message)
        if idle:
            self._wake()

    def reply(self, text: str) -> None:
        """Add the answer to the page's question; it goes out after what changed before it."""
        with self._lock:
            idle = self._is_empty()
            self._reply = text
        if idle:
            self._wake()

    def take(self) -> tuple[list[Message], str | None]:
        """Return all that waits, messages and the answer, and forget it."""
        with self._lock:
            messages = [{"slices": self._slices} | self._rest_of_slices] if self._slices else []
            messages += [*self._newest.values(), *self._events]
            reply, self._reply = self._reply, None
            self._slices, self._newest = {}, {}
            self._events.clear()
        return messages, reply

    def _is_empty(self) -> bool:
        return not (self._slices or self._newest or self._events or self._reply)


class Visitors:
    """The pages that are open now; used by the event loop only."""

    def __init__(self) -> None:
        self._pages: defaultdict[str, list[Client]] = defaultdict(list)

    def enter(self, browser: str, client: Client) -> None:
        """Note that a browser opened a page."""
        self._pages[browser].append(client)

    def leave(self, browser: str, client: Client) -> None:
        """Note that a browser closed a page."""
        self._pages[browser] = [other for other in self._pages[browser] if other is not client]
        if not self._pages[browser]:
            del self._pages[browser]

    def newest(self, browser: str) -> Client | None:
        """Return the page that a browser opened last and has open still."""
        pages = self._pages.get(browser)
        return pages[-1] if pages else None
