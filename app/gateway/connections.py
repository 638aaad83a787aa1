"""Open connections: how many there may be, how long each may keep the gateway waiting, and which one makes room.

Whoever connects is a stranger until a request shows a valid cookie, and a member from then on. Strangers are never
turned away: where there are too many, the peer that has the most loses its oldest connection, so that a newcomer, whose
request follows at once, gets through any crowd of idle connections. Members are trusted with the document; what bounds
them is what the process can hold.

The accept loop is our own because asyncio's server hands a TLS connection over only after its handshake, which an idle
peer never begins.
"""

from __future__ import annotations

import asyncio
import ipaddress
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

log = logging.getLogger(__name__)
KEY = "connection"
"""Where `scope["state"]` has the `Connection`."""
_BACKLOG = 1024
_ACCEPT_AGAIN_S = 0.05
_IN_A_ROW, _REST_S = 4, 0.001
_LONGEST_SWEEP_S = 1.0


class Connection:
    """One accepted connection; used by the event loop only.

    Args:
        peer: whose it is.
        connections: all of them.
    """

    def __init__(self, peer: str, connections: Connections) -> None:
        self.peer, self._connections = peer, connections
        self.admission: asyncio.Task[None] | None = None
        self.is_member = self.is_busy = self.is_websocket = self.awaits_body = False
        self._transport: asyncio.Transport | None = None
        self._carrier: asyncio.Transport | None = None
        self._unsent = 0
        self._closing_since: float | None = None
        self.touch()

    @property
    def is_established(self) -> bool:
        """Whether a protocol reads it, after the TLS handshake if there is one."""
        return self._transport is not None

    @property
    def is_served(self) -> bool:
        """Whether a whole request is being answered."""
        return self.is_busy and not self.awaits_body

    def establish(self, transport: asyncio.Transport) -> None:
        """Note what it is read from and written to."""
        self._transport = transport
        # Below TLS lies the plain transport, which has what is unsent, and which alone ends without the peer's help.
        self._carrier = getattr(getattr(transport, "_ssl_protocol", None), "_transport", None) or transport

    def identify(self) -> bool:
        """Note that a request showed a valid cookie; return whether there is room for it."""
        return self._connections.admit(self)

    def lost(self) -> None:
        """Note that it is over."""
        self._connections.remove(self)

    def drop(self) -> None:
        """End it at once, whatever was still to be sent."""
        self.lost()
        if self._carrier is not None:
            self._carrier.abort()
        elif self.admission is not None:
            self.admission.cancel()

    def touch(self) -> None:
        """Begin a wait: for a header, for an answer, or for the next bytes to come or go."""
        self._since = self._connections.clock()

    def is_overdue(self, now: float, limits: ConnectionLimits) -> bool:
        """Tell whether it has kept the gateway waiting for too long."""
        if self._transport is None or self._carrier is None or not self.is_member:
            return now - self._since > (limits.stall_s if self.is_served else limits.header_s)
        unsent = self._carrier.get_write_buffer_size()
        if unsent != self._unsent:
            self._unsent, self._since = unsent, now
        if self._transport.is_closing():  # what a peer does not take would keep a closed connection for ever
            self._closing_since = now if self._closing_since is None else self._closing_since
            return now - self._closing_since > limits.stall_s
        if self.is_websocket:
            return False  # its pings tell
        if unsent or self.awaits_body:
            return now - self._since > limits.stall_s
        return not self.is_busy and now - self._since > limits.header_s


class Connections:
    """All open connections.

    Args:
        limits: how many and how long.
        clock: monotonic time, s.
    """

    def __init__(self, limits: ConnectionLimits, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.limits, self.clock = limits, clock
        self._strangers: dict[str, dict[Connection, None]] = {}  # by household, the oldest first
        self._members: dict[Connection, None] = {}

    @property
    def is_crowded(self) -> bool:
        """Whether there are as many strangers as there may be."""
        return sum(map(len, self._strangers.values())) >= self.limits.strangers

    def add(self, address: str) -> Connection:
        """Return a new connection; where that is one too many, another stranger makes room."""
        while self._strangers and self.is_crowded:
            self.make_room()
        connection = Connection(_peer(address), self)
        self._strangers.setdefault(connection.peer, {})[connection] = None
        return connection

    def make_room(self) -> None:
        """Drop the oldest stranger of the peer that has the most, if possible one that is not being served."""
        if self._strangers:
            greediest = max(self._strangers, key=lambda peer: len(self._strangers[peer]))
            own = self._strangers[greediest]
            next((one for one in own if not one.is_served), next(iter(own))).drop()

    def admit(self, connection: Connection) -> bool:
        """Make a member of a stranger; return whether there was room, which an idle member may have to make."""
        if connection.is_member:
            return True
        if len(self._members) >= self.limits.members:
            idle = next((other for other in self._members if not other.is_busy), None)
            if idle is None:
                return False
            idle.drop()
        self.remove(connection)
        self._members[connection] = None
        connection.is_member = True
        return True

    def remove(self, connection: Connection) -> None:
        """Forget a connection."""
        self._members.pop(connection, None)
        own = self._strangers.get(connection.peer, {})
        own.pop(connection, None)
        if not own:
            self._strangers.pop(connection.peer, None)

    def sweep(self) -> None:
        """Drop those that have kept the gateway waiting for too long."""
        now = self.clock()
        for connection in [*chain.from_iterable(self._strangers.values()), *self._members]:
            if connection.is_overdue(now, self.limits):
                connection.drop()


class WatchedApp:
    """An application, and what its connections are waiting for meanwhile.

    Args:
        inner: the application.
    """

    def __init__(self, inner: ASGIApp) -> None:
        self._inner = inner

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request or a websocket."""
        connection: Connection = scope["state"][KEY]
        body_is_whole = False

        async def watched_receive() -> Message:
            nonlocal body_is_whole
            if connection.is_member:  # a stranger's time runs from the header on
                connection.touch()
            connection.awaits_body = not body_is_whole
            message = await receive()
            connection.awaits_body = False
            body_is_whole = body_is_whole or not message.get("more_body", False)
            return message

        connection.is_busy, connection.is_websocket = True, scope["type"] == "websocket"
        connection.touch()
        try:
            await self._inner(scope, receive if connection.is_websocket else watched_receive, send)
        finally:
            connection.is_busy = connection.awaits_body = False
            connection.touch()


class _Counted(asyncio.Protocol):
    app_state: dict[str, Any]

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.app_state[KEY].lost()


class _Http(_Counted, H11Protocol):
    """A connection while it speaks HTTP."""


class _Websocket(_Counted, WebSocketsSansIOProtocol):
    """A connection once it is a websocket."""


PROTOCOLS: dict[str, Any] = {"http": _Http, "ws": _Websocket}
"""Options of uvicorn that a `LimitedServer` needs."""


class LimitedServer(uvicorn.Server):
    """A server that accepts no more than it can serve.

    Args:
        config: with `PROTOCOLS`, and an application in a `WatchedApp`.
        limits: how many connections and how long.
    """

    def __init__(self, config: uvicorn.Config, limits: ConnectionLimits) -> None:
        super().__init__(config)
        self.open = Connections(limits)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept from sockets that are bound."""
        self.servers = [_Listener(bound, self) for bound in sockets or ()]  # type: ignore[misc]
        self.started = True

    def protocol(self, connection: Connection) -> asyncio.Protocol:
        """Return what reads a connection."""
        return _Http(self.config, self.server_state, {**self.lifespan.state, KEY: connection})


class _Listener:
    """Accepts from one socket; what uvicorn needs of an `asyncio.Server`."""

    def __init__(self, bound: socket.socket, server: LimitedServer) -> None:
        self._socket, self._server = bound, server
        self._loop = asyncio.get_running_loop()
        self._admissions: dict[asyncio.Task[None], None] = {}
        bound.setblocking(False)
        bound.listen(_BACKLOG)
        self._tasks = [self._loop.create_task(self._accept()), self._loop.create_task(self._sweep())]

    def close(self) -> None:
        for task in (*self._tasks, *self._admissions):
            task.cancel()

    async def wait_closed(self) -> None:
        await asyncio.gather(*self._tasks, *self._admissions, return_exceptions=True)

    async def _accept(self) -> None:
        in_a_row = 0
        while True:
            try:
                accepted, address = await self._loop.sock_accept(self._socket)
            except OSError as error:  # the peer has gone again, or there is no descriptor left
                log.info("a connection could not be accepted: %s", error)
                self._server.open.make_room()
                await asyncio.sleep(_ACCEPT_AGAIN_S)
                continue
            connection = self._server.open.add(str(address[0]))
            connection.admission = self._loop.create_task(self._admit(accepted, connection))
            self._admissions[connection.admission] = None
            connection.admission.add_done_callback(partial(self._admitted, accepted, connection))
            # Many that come at once must not keep those waiting who are in already: other threads answer them.
            in_a_row = (in_a_row + 1) % _IN_A_ROW
            await asyncio.sleep(0 if in_a_row or not self._server.open.is_crowded else _REST_S)

    async def _admit(self, accepted: socket.socket, connection: Connection) -> None:
        tls = self._server.config.ssl
        try:
            transport, _ = await self._loop.connect_accepted_socket(
                partial(self._server.protocol, connection),
                accepted,
                ssl=tls,
                ssl_handshake_timeout=None if tls is None else self._server.open.limits.header_s,
            )
        except OSError as error:  # ssl.SSLError is one
            log.info("a connection failed before its first request: %s", error)
        else:
            connection.establish(transport)

    def _admitted(self, accepted: socket.socket, connection: Connection, admission: asyncio.Task[None]) -> None:
        del self._admissions[admission]
        if not connection.is_established:
            connection.lost()
            accepted.close()

    async def _sweep(self) -> None:
        connections = self._server.open
        while True:
            await asyncio.sleep(min(_LONGEST_SWEEP_S, connections.limits.header_s / 4))
            connections.sweep()


def _peer(address: str) -> str:
    """Return what one person may have many addresses of: the network of an IPv6 address."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if parsed.version == 6 and parsed.ipv4_mapped is None:
        return str(ipaddress.ip_network((parsed, 64), strict=False))
    return address
