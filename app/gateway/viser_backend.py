"""The viser server behind the gateway: on loopback, silent, not shared, and locked with the gateway's secret.

viser has no authentication and no check of Origin, and any local user or any page in a local browser can reach a
loopback port. It builds its websocket server itself and offers no hook for a check, hence the wrapping here.
"""

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
SECRET_HEADER = "X-Ladarreg-Gateway"
"""The header that carries the secret."""
CLIENT_HEADER = "X-Ladarreg-Client"
"""The header that carries the id of the workbench's client that a view belongs to."""
_patching = threading.Lock()
_silent_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ViserAddress:
    """Address of a locked viser server, with the secret that opens it."""

    host: str
    """Its loopback address."""
    port: int
    """Its port."""
    secret: str = field(repr=False)
    """Value of the header `SECRET_HEADER`."""


def open_locked_server(*, label: str) -> tuple[viser.ViserServer, ViserAddress]:
    """Start a server on a free loopback port that answers only the gateway.

    Args:
        label: the page's title.

    Returns:
        The server, and the address that the gateway reaches it by.

    Raises:
        DependencyError: if this version of viser cannot be locked.
    """
    secret = secrets.token_urlsafe(32)
    with contextlib.redirect_stdout(io.StringIO()), locked(secret):
        import viser

        server = viser.ViserServer(host=HOST, port=0, label=label, verbose=False)
    server.request_share_url = _refuse_to_share  # type: ignore[method-assign]
    return server, ViserAddress(HOST, server.get_port(), secret)


def client_id_of(server: viser.ViserServer, viewer: viser.ClientHandle) -> str:
    """Return the id of the workbench's client behind a client of viser, as the gateway has stated it; or empty."""
    connection = server._websock_server._live_connections.get(viewer.client_id)
    request = None if connection is None else connection.request
    return "" if request is None else str(request.headers.get(CLIENT_HEADER, ""))


def close_server(server: viser.ViserServer) -> None:
    """Stop a server without viser's message on stdout."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@contextmanager
def locked(secret: str) -> Iterator[None]:
    """Lock every websockets server that is built inside: its pages and websockets require the secret.

    The server leaves pings to the gateway, which talks to the browser: a slow browser makes the gateway wait, and viser
    would mistake the wait for a lost connection.

    Args:
        secret: value of the header `SECRET_HEADER` that opens the server.

    Raises:
        DependencyError: if no server was built inside.
    """
    import websockets.asyncio.server as server

    with _patching:
        original = server.serve
        built = 0

        def serve(handler: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
            nonlocal built
            built += 1
            options.update(ping_interval=None, logger=_silent_log)
            return original(handler, *args, process_request=_require_secret(process_request, secret), **options)

        server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            server.serve = original  # type: ignore[misc]
        if not built:  # another version of viser, which would remain unprotected
            raise DependencyError("this version of viser cannot be locked; install the version that ladarreg requires")


def _require_secret(inner: Callable[[Any, Any], Any] | None, secret: str) -> Callable[[Any, Any], Any]:
    async def process_request(connection: Any, request: Any) -> Any:
        values = request.headers.get_all(SECRET_HEADER)
        if len(values) != 1 or not hmac.compare_digest(values[0].encode(), secret.encode()):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "Only the workbench's gateway may connect here.\n")
        response = inner(connection, request) if inner is not None else None
        return await response if inspect.isawaitable(response) else response

    return process_request


def _refuse_to_share(verbose: bool = True) -> str | None:
    return None
