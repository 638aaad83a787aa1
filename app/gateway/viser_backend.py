"""viser, opened the only way we open it: on loopback, silent, and with no way to share it."""

from __future__ import annotations

import contextlib
import io
from typing import TYPE_CHECKING

from .viser_lock import ViserAddress, locked, new_secret

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
