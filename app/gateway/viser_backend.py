"""viser, opened the only way we open it: on loopback, silent, and with no way to share it."""

from __future__ import annotations

import contextlib
import hmac
import http
import inspect
import io
import logging
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import DependencyError

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"


def open_locked_server(*, label: str) -> tuple[viser.ViserServer, ViserAddress]:
    """Start a server on a free loopback port that answers nobody but the gateway.

    Args:
        label: the page's title.

    Returns:
        The server, and what the gateway needs to reach it.

    Raises:
        DependencyError: if this version of viser cannot be locked.
    """
    secret = new_secret()
    with contextlib.redirect_stdout(io.StringIO()), locked(secret):
        import viser

        server = viser.ViserServer(host=HOST, port=0, label=label, verbose=False)
    server.request_share_url = _refuse_to_share  # type: ignore[method-assign]
    return server, ViserAddress(HOST, server.get_port(), secret)


def close_server(server: viser.ViserServer) -> None:
    """Stop without viser's farewell."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _refuse_to_share(verbose: bool = True) -> str | None:
    return None


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
