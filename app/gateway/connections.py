"""Open connections: how many there may be, how long each may keep the gateway waiting, and which one is evicted.

A connection is anonymous until a request on it shows a valid cookie, and authenticated from then on. Anonymous
connections are never turned away: if there are too many, the peer that has the most loses its oldest one, so that a new
connection that sends its request at once gets through any number of idle ones. Authenticated connections are trusted
with the document; they are limited by what the process can hold, and those of readers by their share of it.

The accept loop is our own because asyncio's server hands a TLS connection over only after its handshake, which an idle
peer never begins.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from collections.abc import Callable
from functools import partial
from itertools import chain
from typing import Any

import uvicorn
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from .options import ConnectionLimits
from .request_source import network_of
from .seats import Seats

log = logging.getLogger(__name__)
CONNECTION_KEY = "connection"
"""Key of the `Connection` in `scope["state"]`."""
_BACKLOG = 1024
_ACCEPT_RETRY_S = 0.05
_BURST, _PAUSE_S = 4, 0.001
_MAX_SWEEP_INTERVAL_S = 1.0


class Connection:
    """One accepted connection; used by the event loop only.

    Args:
        peer: address, or IPv6 network, that it comes from.
        connections: the set that it belongs to.
    """

    def __init__(self, peer: str, connections: Connections) -> None:
        self.peer, self._connections = peer, connections
        self.handshake: asyncio.Task[None] | None = None
        self.is_authenticated = self.read_only = self.is_busy = self.is_websocket = self.awaits_body = False
        self._messages: WebSocketsSansIOProtocol | None = None
        self._transport: asyncio.Transport | None = None
        self._carrier: asyncio.Transport | None = None
        self._unsent = 0
        self._closing_since: float | None = None
        self.touch()

    @property
    def is_established(self) -> bool:
        """True if a protocol reads it; with TLS, once the handshake is complete."""
        return self._transport is not None

    @property
    def is_served(self) -> bool:
        """True if a complete request is being answered."""
        return self.is_busy and not self.awaits_body

    def establish(self, transport: asyncio.Transport) -> None:
        """Set the transport that it is read from and written to."""
        self._transport = transport
        # Below TLS lies the plain transport: it holds the unsent bytes and closes without the peer's cooperation.
        self._carrier = getattr(getattr(transport, "_ssl_protocol", None), "_transport", None) or transport

    def authenticate(self, *, read_only: bool) -> bool:
        """Record that a request belongs to a session; return whether the limit allows the connection."""
        return self._connections.authenticate(self, read_only=read_only)

    def carry(self, websocket: WebSocketsSansIOProtocol) -> None:
        """Set the websocket that the connection has become."""
        self._messages = websocket

    def limit_messages(self, most_bytes: int) -> None:
        """Limit the messages of the websocket; a longer one closes it as soon as its length is known."""
        if self._messages is not None:
            self._messages.conn.max_message_size = most_bytes

    def lost(self) -> None:
        """Record that it has ended."""
        self._connections.remove(self)

    def drop(self) -> None:
        """Close it at once, discarding unsent data."""
        self.lost()
        if self._carrier is not None:
            self._carrier.abort()
        elif self.handshake is not None:
            self.handshake.cancel()

    def touch(self) -> None:
        """Restart its wait: for a header, for a response, or for the next bytes in either direction."""
        self._since = self._connections.clock()

    def is_overdue(self, now: float, limits: ConnectionLimits) -> bool:
        """Return whether it has kept the gateway waiting for too long."""
        if self._transport is None or self._carrier is None or not self.is_authenticated:
            return now - self._since > (limits.stall_s if self.is_served else limits.header_s)
        unsent = self._carrier.get_write_buffer_size()
        if unsent != self._unsent:
            self._unsent, self._since = unsent, now
        if self._transport.is_closing():  # unread data would otherwise keep a closed connection forever
            self._closing_since = now if self._closing_since is None else self._closing_since
            return now - self._closing_since > limits.stall_s
        if self.is_websocket:
            return False  # uvicorn's pings detect a dead one
        if unsent or self.awaits_body:
            return now - self._since > limits.stall_s
        return not self.is_busy and now - self._since > limits.header_s


class Connections:
    """All open connections.

    Args:
        limits: on their number and waiting times.
        clock: monotonic time, s.
    """

    def __init__(self, limits: ConnectionLimits, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.limits, self.clock = limits, clock
        self._anonymous: dict[str, dict[Connection, None]] = {}  # by peer, the oldest first
        self._authenticated: dict[Connection, None] = {}
        self._seats = Seats(limits.authenticated)

    @property
    def is_crowded(self) -> bool:
        """True if the limit of anonymous connections is reached."""
        return sum(map(len, self._anonymous.values())) >= self.limits.anonymous

    def add(self, address: str) -> Connection:
        """Add and return a new connection; at the limit, another anonymous one is evicted."""
        while self._anonymous and self.is_crowded:
            self.evict_anonymous()
        connection = Connection(network_of(address), self)
        self._anonymous.setdefault(connection.peer, {})[connection] = None
        return connection

    def evict_anonymous(self) -> None:
        """Drop the oldest anonymous connection of the peer that has the most, preferring one that is not served."""
        if self._anonymous:
            largest = max(self._anonymous, key=lambda peer: len(self._anonymous[peer]))
            own = self._anonymous[largest]
            next((connection for connection in own if not connection.is_served), next(iter(own))).drop()

    def authenticate(self, connection: Connection, *, read_only: bool) -> bool:
        """Move a connection to the authenticated ones; at the limit an idle one is dropped, or False returned.

        An idle connection of a reader makes room for anyone, one of an editor for editors only.
        """
        if connection.is_authenticated:  # of a proxy that carries several browsers, an editor's counts
            connection.read_only = connection.read_only and read_only
            return True
        readers = [other for other in self._authenticated if other.read_only]
        taken = len(self._authenticated)
        if not self._seats.is_free(taken=taken, by_readers=len(readers), read_only=read_only):
            yielding = readers if read_only else sorted(self._authenticated, key=lambda other: not other.read_only)
            idle = next((other for other in yielding if not other.is_busy), None)
            if idle is None:
                return False
            idle.drop()
        self.remove(connection)
        self._authenticated[connection] = None
        connection.is_authenticated, connection.read_only = True, read_only
        return True

    def remove(self, connection: Connection) -> None:
        """Remove a connection that has ended."""
        self._authenticated.pop(connection, None)
        own = self._anonymous.get(connection.peer, {})
        own.pop(connection, None)
        if not own:
            self._anonymous.pop(connection.peer, None)

    def sweep(self) -> None:
        """Drop the connections that have kept the gateway waiting for too long."""
        now = self.clock()
        for connection in [*chain.from_iterable(self._anonymous.values()), *self._authenticated]:
            if connection.is_overdue(now, self.limits):
                connection.drop()


class TrackedApp:
    """An application wrapped so that each connection records what it is waiting for.

    Args:
        inner: the application.
    """

    def __init__(self, inner: ASGIApp) -> None:
        self._inner = inner

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request or a websocket."""
        connection: Connection = scope["state"][CONNECTION_KEY]
        body_complete = False

        async def tracked_receive() -> Message:
            nonlocal body_complete
            if connection.is_authenticated:  # the time of an anonymous request runs from its header on
                connection.touch()
            connection.awaits_body = not body_complete
            message = await receive()
            connection.awaits_body = False
            body_complete = body_complete or not message.get("more_body", False)
            return message

        connection.is_busy, connection.is_websocket = True, scope["type"] == "websocket"
        connection.touch()
        try:
            await self._inner(scope, receive if connection.is_websocket else tracked_receive, send)
        finally:
            connection.is_busy = connection.awaits_body = False
            connection.touch()


class _Tracked(asyncio.Protocol):
    app_state: dict[str, Any]

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.app_state[CONNECTION_KEY].lost()


class _Http(_Tracked, H11Protocol):
    """Protocol of a connection before it becomes a websocket."""


class _Websocket(_Tracked, WebSocketsSansIOProtocol):
    """Protocol of a websocket connection."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self.app_state[CONNECTION_KEY].carry(self)


PROTOCOLS: dict[str, Any] = {"http": _Http, "ws": _Websocket}
"""uvicorn options that a `LimitedServer` requires."""


class LimitedServer(uvicorn.Server):
    """A server that accepts no more connections than it can serve.

    Args:
        config: with `PROTOCOLS`, and an application wrapped in a `TrackedApp`.
        limits: on the number and waiting times of connections.
    """

    def __init__(self, config: uvicorn.Config, limits: ConnectionLimits) -> None:
        super().__init__(config)
        self.connections = Connections(limits)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept connections from bound sockets."""
        self.servers = [_Listener(bound, self) for bound in sockets or ()]  # type: ignore[misc]
        self.started = True

    def protocol(self, connection: Connection) -> asyncio.Protocol:
        """Return the protocol that reads a connection."""
        return _Http(self.config, self.server_state, {**self.lifespan.state, CONNECTION_KEY: connection})


class _Listener:
    """Accept loop of one socket; implements the part of `asyncio.Server` that uvicorn uses."""

    def __init__(self, bound: socket.socket, server: LimitedServer) -> None:
        self._socket, self._server = bound, server
        self._loop = asyncio.get_running_loop()
        self._handshakes: dict[asyncio.Task[None], None] = {}
        bound.setblocking(False)
        bound.listen(_BACKLOG)
        self._tasks = [self._loop.create_task(self._accept()), self._loop.create_task(self._sweep())]

    def close(self) -> None:
        for task in (*self._tasks, *self._handshakes):
            task.cancel()

    async def wait_closed(self) -> None:
        await asyncio.gather(*self._tasks, *self._handshakes, return_exceptions=True)

    async def _accept(self) -> None:
        accepted_in_burst = 0
        while True:
            try:
                accepted, address = await self._loop.sock_accept(self._socket)
            except OSError as error:  # the peer has disconnected, or no file descriptor is left
                log.info("cannot accept a connection: %s", error)
                self._server.connections.evict_anonymous()
                await asyncio.sleep(_ACCEPT_RETRY_S)
                continue
            peer = str(address[0]) if address else ""  # that of a Unix socket has none
            connection = self._server.connections.add(peer)
            connection.handshake = self._loop.create_task(self._establish(accepted, connection))
            self._handshakes[connection.handshake] = None
            connection.handshake.add_done_callback(partial(self._established, accepted, connection))
            # Many new connections at once must not delay open ones, whose requests other threads answer.
            accepted_in_burst = (accepted_in_burst + 1) % _BURST
            await asyncio.sleep(0 if accepted_in_burst or not self._server.connections.is_crowded else _PAUSE_S)

    async def _establish(self, accepted: socket.socket, connection: Connection) -> None:
        tls = self._server.config.ssl
        try:
            transport, _ = await self._loop.connect_accepted_socket(
                partial(self._server.protocol, connection),
                accepted,
                ssl=tls,
                ssl_handshake_timeout=None if tls is None else self._server.connections.limits.header_s,
            )
        except OSError as error:  # ssl.SSLError is one
            log.info("a connection failed before its first request: %s", error)
        else:
            connection.establish(transport)

    def _established(self, accepted: socket.socket, connection: Connection, handshake: asyncio.Task[None]) -> None:
        del self._handshakes[handshake]
        if not connection.is_established:
            connection.lost()
            accepted.close()

    async def _sweep(self) -> None:
        connections = self._server.connections
        while True:
            await asyncio.sleep(min(_MAX_SWEEP_INTERVAL_S, connections.limits.header_s / 4))
            connections.sweep()
