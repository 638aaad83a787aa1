"""The websocket `/document`: commands of the page up, slices of the state down (docs/workbench.md)."""

from __future__ import annotations

import asyncio
import gzip
import logging
import re
import threading
from collections import defaultdict, deque
from collections.abc import Awaitable, Callable, Collection, Coroutine
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from anyio import CapacityLimiter, to_thread
from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from ladarreg_core.errors import LadarregError

from ..process_resources import return_memory_soon
from .encoding import InvalidMessageError, SharedEncoder, decode_object, encode, joined
from .protocol import Client, Message, Visitor, Workbench

log = logging.getLogger(__name__)
_FAULT, _FULL = 1011, 1013
_RESTART = 1012
_PROJECT_CHANGED = "project"
"""Event after which a page connects again."""
_MAX_REASON_BYTES = 123
"""Longest reason that a websocket can be closed with."""
_MAX_EVENTS = 200
_MAX_WAITING = 32
"""Commands of a page that wait for their turn; it is not read any further then."""
_MAX_URGENT_CHARACTERS = 1000
_TOGETHER_S = 0.02
"""How long the changes by a page's command wait for its reply, to be sent with it."""
_URGENT_THREADS = 4
_READERS_THREADS = 4
"""Commands of pages that may only look, at a time: however many there are, those of editors find a thread."""
_SECRET = re.compile(r"[A-Za-z0-9_-]{16,64}")
_MAX_FIELD = 100
_PACKED_ABOVE, _PACKED_LEVEL = 16_000, 5
"""Message 1 of more characters is compressed, and how well: of a survey of 80 photographs it has half a megabyte, which
takes 3 s over 1.5 Mbit/s, and a fifth of that compressed."""
_LATEST_ONLY = frozenset({"simplex", "hover", "cursor", "view"})
"""Events of which only the latest needs to be sent, of each client that they name."""
_NOT_JSON = "The message is not a JSON object: page and program are of different versions; reload the page."
_INTERNAL_ERROR = "Internal error: the command may or may not have taken effect; restart with --debug for details."


class DocumentSocket:
    """Serves the websocket.

    Args:
        workbench: answers the commands.
        clients: registry of the open pages.
    """

    def __init__(self, workbench: Workbench, clients: ClientRegistry) -> None:
        self._workbench, self._clients = workbench, clients
        self._encoder = SharedEncoder()
        self._waker = _Waker()
        # Other requests, which may be slow, share a limited number of threads.
        self._urgent = ThreadPoolExecutor(_URGENT_THREADS, thread_name_prefix="urgent command")
        self._for_readers = CapacityLimiter(_READERS_THREADS)

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one page until it disconnects."""
        browser = websocket.state.browser
        await websocket.accept()
        try:
            client = await run_in_threadpool(self._workbench.join, _visitor(websocket))
        except LadarregError as refusal:
            await websocket.close(_FULL, str(refusal).encode()[:_MAX_REASON_BYTES].decode(errors="ignore"))
            return
        self._clients.add(browser, client)
        try:
            await self._serve(websocket, client)
        except (WebSocketDisconnect, asyncio.CancelledError):
            log.debug("%s disconnected", client.name)
        except Exception:
            log.exception("the connection of %s failed", client.name)
            if websocket.application_state is WebSocketState.CONNECTED:
                await websocket.close(_FAULT)
        finally:
            self._clients.remove(browser, client)
            await asyncio.shield(run_in_threadpool(self._workbench.leave, client))
            return_memory_soon()

    async def _serve(self, websocket: WebSocket, client: Client) -> None:
        pending, replied = asyncio.Event(), asyncio.Event()
        outbox = Outbox(partial(self._waker.wake, asyncio.get_running_loop(), pending))
        # Subscribe first: changes made while the slices are gathered are then sent after them.
        unsubscribe = self._workbench.subscribe(outbox.put, client)
        try:
            slices = await run_in_threadpool(self._workbench.slices, client)
            state = ClientState(self._encoder)
            await _send_first(websocket, state.encode({"slices": slices}))
            await _until_one_ends(
                _send_pending(websocket, state, outbox, pending, replied),
                self._receive(websocket, client, outbox, pending, replied),
            )
        finally:
            unsubscribe()

    async def _receive(
        self, websocket: WebSocket, client: Client, outbox: Outbox, pending: asyncio.Event, replied: asyncio.Event
    ) -> None:
        waiting: asyncio.Queue[str | Awaitable[str] | None] = asyncio.Queue(_MAX_WAITING)
        limiter = self._for_readers if websocket.state.read_only else None
        await _until_one_ends(
            self._read(websocket, client, waiting),
            self._reply_in_order(client, waiting, outbox, pending, replied, limiter),
        )

    async def _read(
        self, websocket: WebSocket, client: Client, waiting: asyncio.Queue[str | Awaitable[str] | None]
    ) -> None:
        """Read commands; urgent ones are executed at once, and only their replies wait for their turn."""
        while (received := await websocket.receive())["type"] != "websocket.disconnect":
            text = received.get("text")
            if text is not None and _is_urgent(text, self._workbench.urgent_commands):
                loop = asyncio.get_running_loop()
                await waiting.put(loop.run_in_executor(self._urgent, self._answer, client, text))
            else:
                await waiting.put(text)
        await waiting.join()  # what a page sent before it was closed counts

    async def _reply_in_order(
        self, client: Client, waiting: asyncio.Queue[str | Awaitable[str] | None], outbox: Outbox,
        pending: asyncio.Event, replied: asyncio.Event, limiter: CapacityLimiter | None,
    ) -> None:  # fmt: skip
        while True:
            command = await waiting.get()
            if command is None or isinstance(command, str):
                outbox.hold()
                self._waker.hold()

                def release() -> None:
                    outbox.release()
                    self._waker.release()

                late = asyncio.get_running_loop().call_later(_TOGETHER_S, release)
                outbox.reply(await to_thread.run_sync(self._answer, client, command, limiter=limiter))
                pending.set()  # before everybody else, who did not ask
                late.cancel()
                self._waker.release()
            else:
                outbox.reply(await asyncio.shield(command))
            await replied.wait()  # of a page that sends commands without reading the replies, few wait
            replied.clear()
            waiting.task_done()

    def _answer(self, client: Client, text: str | None) -> str:
        try:
            message = decode_object(text or "")
        except InvalidMessageError:
            return encode({"reply": None, "ok": False, "error": _NOT_JSON})
        number = message.get("id")
        number = number if isinstance(number, int | str) else None
        try:
            return encode({"reply": number} | self._workbench.answer(client, message))
        except Exception:
            log.exception("%r failed", message.get("do"))
            return encode({"reply": number, "ok": False, "error": _INTERNAL_ERROR})


class ClientState:
    """The slices as one client has them; encodes messages relative to these and numbers them.

    Args:
        encoder: shared by all clients.
    """

    def __init__(self, encoder: SharedEncoder) -> None:
        self._encoder = encoder
        self._slices: dict[str, Any] = {}
        self._version = 0

    def encode(self, message: Message) -> str:
        """Return the JSON text of a message for this client, and assume that it is sent."""
        return self._encode_slices(message["slices"]) if "slices" in message else encode(message)

    def encode_all(self, messages: list[Message], reply: str | None) -> list[str]:
        """Return what is to be sent for messages and the encoded reply that follows them, and assume that it is sent.

        The reply and the changes that it follows, if nothing else waits, are one message: a page that gets both at once
        handles the reply before it paints the changes.
        """
        texts = [self.encode(message) for message in messages]
        if reply is None:
            return texts
        if len(messages) == 1 and "slices" in messages[0]:
            return [joined(reply, texts[0])]
        return [*texts, reply]

    def _encode_slices(self, slices: dict[str, Any]) -> str:
        self._version += 1
        whole: dict[str, Any] = {}
        changes: dict[str, Any] = {}
        for name, value in slices.items():
            before = self._slices.get(name)
            change = None if before is None or value is None else self._encoder.change(before, value)
            if change is None:
                whole[name] = self._encoder.slice(value)
            else:
                changes[name] = change
            if value is None:
                self._slices.pop(name, None)
            else:
                self._slices[name] = value
        parts = {"slices": whole, "changes": changes} if changes else {"slices": whole}
        return encode({**parts, "version": self._version})


class _Waker:
    """Sets events of an event loop from other threads, those of many clients in one call, since each wakes the loop."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._due: defaultdict[asyncio.AbstractEventLoop, list[asyncio.Event]] = defaultdict(list)
        self._called: set[asyncio.AbstractEventLoop] = set()
        self._held = False

    def hold(self) -> None:
        """Let what is to be set wait until `release`: the loop then leaves the processor to the command under way."""
        with self._lock:
            self._held = True

    def release(self) -> None:
        """Set what waits, even where another command is under way."""
        with self._lock:
            self._held = False
            loops = [loop for loop in self._due if loop not in self._called]
            self._called.update(loops)
        for loop in loops:
            self._call(loop)

    def wake(self, loop: asyncio.AbstractEventLoop, event: asyncio.Event) -> None:
        """Set an event of a loop."""
        with self._lock:
            self._due[loop].append(event)
            calls = not self._held and loop not in self._called
            if calls:
                self._called.add(loop)
        if calls:
            self._call(loop)

    def _call(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            loop.call_soon_threadsafe(self._set, loop)
        except RuntimeError:  # the loop has ended before the threads that publish
            self._taken(loop)

    def _set(self, loop: asyncio.AbstractEventLoop) -> None:
        for event in self._taken(loop):
            event.set()

    def _taken(self, loop: asyncio.AbstractEventLoop) -> list[asyncio.Event]:
        with self._lock:
            self._called.discard(loop)
            return self._due.pop(loop, [])


class Outbox:
    """Messages waiting to be sent to one client: a slow one gets the latest state, not a longer queue.

    Filled from any thread, emptied by one task.

    Args:
        wake: called, from the thread that fills it, when it is no longer empty.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._lock = threading.Lock()
        self._slices: dict[str, Any] = {}
        self._other_fields: dict[str, Any] = {}
        self._latest: dict[str, Message] = {}
        self._events: deque[Message] = deque(maxlen=_MAX_EVENTS)
        self._reply: str | None = None
        self._held = False

    def hold(self) -> None:
        """Let what is added wait until there is a reply, or until `release`."""
        with self._lock:
            self._held = True

    def release(self) -> None:
        """Let what has been added be sent."""
        with self._lock:
            waits = self._held and not self._is_empty()
            self._held = False
        if waits:
            self._wake()

    def put(self, message: Message) -> None:
        """Add slices, which replace waiting ones of the same name, or an event."""
        with self._lock:
            idle = self._is_empty()
            if "slices" in message:
                self._slices.update(message["slices"])
                self._other_fields = {name: value for name, value in message.items() if name != "slices"}
            elif message.get("event") in _LATEST_ONLY:
                self._latest[f"{message['event']} {message.get('client')} {message.get('side')}"] = message
            else:
                self._events.append(message)
            wakes = idle and not self._held
        if wakes:
            self._wake()

    def reply(self, text: str) -> None:
        """Add the reply to a command; it is sent after all changes that precede it."""
        with self._lock:
            wakes = self._held or self._is_empty()
            self._reply, self._held = text, False
        if wakes:
            self._wake()

    def take(self) -> tuple[list[Message], str | None]:
        """Remove and return everything that waits: the messages and the reply."""
        with self._lock:
            messages: list[Message] = [{"slices": self._slices} | self._other_fields] if self._slices else []
            messages += [*self._latest.values(), *self._events]
            reply, self._reply = self._reply, None
            self._slices, self._latest = {}, {}
            self._events.clear()
        return messages, reply

    def _is_empty(self) -> bool:
        return not (self._slices or self._latest or self._events or self._reply)


class ClientRegistry:
    """The open pages of each browser; used by the event loop only."""

    def __init__(self) -> None:
        self._clients: defaultdict[str, list[Client]] = defaultdict(list)

    def add(self, browser: str, client: Client) -> None:
        """Add a page that a browser has opened."""
        self._clients[browser].append(client)

    def remove(self, browser: str, client: Client) -> None:
        """Remove a page that a browser has closed."""
        self._clients[browser].remove(client)  # once: a page that reconnects is there twice for a moment
        if not self._clients[browser]:
            del self._clients[browser]

    def has(self, browser: str, client_id: str) -> bool:
        """Return whether a client is an open page of this browser."""
        return any(client.id == client_id for client in self._clients.get(browser, []))

    def find(self, browser: str, client_id: str) -> Client | None:
        """Return the open page of a browser by its id; without one, the page that it opened last."""
        clients = self._clients.get(browser, [])
        named = (client for client in reversed(clients) if client.id == client_id)
        return next(named, clients[-1] if clients else None)


def _is_urgent(text: str, urgent: Collection[str]) -> bool:
    if len(text) > _MAX_URGENT_CHARACTERS or not any(command in text for command in urgent):
        return False
    try:
        return decode_object(text).get("do") in urgent
    except InvalidMessageError:
        return False


def _visitor(websocket: WebSocket) -> Visitor:
    """Return what a page says of itself in its address; the tab's secret counts for its browser only."""
    query = websocket.query_params
    secret = query.get("tab", "")
    return Visitor(
        websocket.state.address,
        tab=f"{websocket.state.browser} {secret}" if _SECRET.fullmatch(secret) else "",
        page=query.get("page", "")[:_MAX_FIELD],
        name=query.get("name", "")[:_MAX_FIELD],
        photo=query.get("photo", "")[:_MAX_FIELD],
        read_only=websocket.state.read_only,
    )


async def _send_first(websocket: WebSocket, text: str) -> None:
    """Send message 1, by far the longest, compressed to a page that asked for it."""
    if websocket.query_params.get("packed") == "gzip" and len(text) > _PACKED_ABOVE:
        await websocket.send_bytes(await run_in_threadpool(gzip.compress, text.encode(), _PACKED_LEVEL))
    else:
        await websocket.send_text(text)


async def _send_pending(
    websocket: WebSocket, state: ClientState, outbox: Outbox, pending: asyncio.Event, replied: asyncio.Event
) -> None:
    while await pending.wait():
        pending.clear()
        messages, reply = outbox.take()
        for text in state.encode_all(messages, reply):
            await websocket.send_text(text)
        if reply is not None:
            replied.set()
        if any(message.get("event") == _PROJECT_CHANGED for message in messages):
            await websocket.close(_RESTART)  # everything that this page knows belongs to the former project
            return


async def _until_one_ends(*coroutines: Coroutine[Any, Any, None]) -> None:
    tasks = [asyncio.create_task(coroutine) for coroutine in coroutines]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    for task in done:
        task.result()
