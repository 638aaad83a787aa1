"""viser, opened the only way we open it: on loopback, silent, and with no way to share it."""

from __future__ import annotations

import contextlib
import io
import sys
from typing import TYPE_CHECKING

from app.viser_lock import ViserAddress, locked, new_secret
from ladarreg_core.errors import OptionError

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"
_TRIES = 100


def open_server(*, port: int, label: str) -> viser.ViserServer:
    """Start a server on loopback.

    Any client may ask viser for a public tunnel and it has no authentication: the request is refused here.

    Args:
        port: wanted; the next free one is taken where it is busy.
        label: the page's title.

    Raises:
        OptionError: if no port can be had.
    """
    if not 1 <= port <= 65535:
        raise OptionError(f"the port is {port}; it must be between 1 and 65535")
    free = _free_port(port)
    with contextlib.redirect_stdout(io.StringIO()):  # its banner names the websocket too; one address is enough
        import viser

        server = viser.ViserServer(host=HOST, port=free, label=label, verbose=False)
    if server.get_port() != port:
        print(f"ladarreg: port {port} is busy, using {server.get_port()}", file=sys.stderr)
    server.request_share_url = _refuse_to_share  # type: ignore[method-assign]
    return server


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


def address(server: viser.ViserServer) -> str:
    """Return what to open in a browser."""
    return f"http://{HOST}:{server.get_port()}"


def close_server(server: viser.ViserServer) -> None:
    """Stop without viser's farewell."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _refuse_to_share(verbose: bool = True) -> str | None:
    return None


def _free_port(port: int) -> int:
    import socket

    for candidate in range(port, min(port + _TRIES, 65536)):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            if sys.platform != "win32":  # there it would let two servers share a port
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, candidate))
            except OSError:
                continue
            return candidate
    raise OptionError(f"no free port from {port} on; give another with --port")
