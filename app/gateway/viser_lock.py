"""viser behind a lock: its port answers nobody who does not know the gateway's secret.

viser has no authentication and no check of Origin, and any local user or any page in a local browser can reach a
loopback port. It builds its websocket server itself and leaves no hook free, hence the wrapping here.
"""

from __future__ import annotations

import hmac
import http
import inspect
import logging
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from ladarreg_core.errors import DependencyError

HEADER = "X-Ladarreg-Gateway"
"""The header that carries the secret."""
_one_at_a_time = threading.Lock()
_quiet = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ViserAddress:
    """Where a locked viser server listens, and what opens it."""

    host: str
    """Its loopback address."""
    port: int
    """Its port."""
    secret: str = field(repr=False)
    """The value of `HEADER`."""


def new_secret() -> str:
    """Return a secret that nobody can guess."""
    return secrets.token_urlsafe(32)


@contextmanager
def locked(secret: str) -> Iterator[None]:
    """Lock every websockets server that is built inside: pages and websockets want the secret in `HEADER`.

    The server leaves pings to the gateway, which talks to the browser: a slow browser makes the gateway wait, and viser
    would take the wait for a lost connection.

    Args:
        secret: the value of `HEADER` that opens the server.

    Raises:
        DependencyError: if no server was built inside.
    """
    import websockets.asyncio.server as server

    with _one_at_a_time:
        plain = server.serve
        built = 0

        def serve(handler: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
            nonlocal built
            built += 1
            options.update(ping_interval=None, logger=_quiet)
            return plain(handler, *args, process_request=_behind_lock(process_request, secret), **options)

        server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            server.serve = plain  # type: ignore[misc]
        if not built:  # another version of viser, whose door would stand open
            raise DependencyError("this version of viser cannot be locked; install the one that ladarreg asks for")


def _behind_lock(inner: Callable[[Any, Any], Any] | None, secret: str) -> Callable[[Any, Any], Any]:
    async def process_request(connection: Any, request: Any) -> Any:
        shown = request.headers.get_all(HEADER)
        if len(shown) != 1 or not hmac.compare_digest(shown[0].encode(), secret.encode()):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "Only the workbench's gateway may connect here.\n")
        answer = inner(connection, request) if inner is not None else None
        return await answer if inspect.isawaitable(answer) else answer

    return process_request
