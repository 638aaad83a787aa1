"""A viser server without a gateway, for tests of what is drawn."""

from __future__ import annotations

import contextlib
import io

import viser
from ladarreg.gateway.viser_backend import HOST


def open_server(*, label: str) -> viser.ViserServer:
    """Start a server on a free loopback port."""
    with contextlib.redirect_stdout(io.StringIO()):  # its banner
        return viser.ViserServer(host=HOST, port=0, label=label, verbose=False)


def address(server: viser.ViserServer) -> str:
    """Return what to open in a browser."""
    return f"http://{HOST}:{server.get_port()}"
