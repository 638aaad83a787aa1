"""Serve a workbench until a stop signal."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from urllib.parse import quote

from ..stop_signals import StopSignals, print_error
from .browser import open_browser
from .options import GatewayOptions
from .protocol import Workbench
from .routes import site
from .server import Gateway
from .viser_lock import ViserAddress

_GIVE_WAY_S = 0.0005
"""A thread that computes gives way after so long to those that answer pages, who wait for that several times each."""


def serve_until_interrupted(
    workbench: Workbench,
    viser: Callable[[], ViserAddress],
    *,
    token: str,
    options: GatewayOptions,
    browser: bool,
    stop: StopSignals,
    then: Callable[[], None] = lambda: None,
) -> None:
    """Serve, say where, and return when a signal asks to stop.

    Args:
        workbench: what is behind the page.
        viser: tells where the locked viser server listens; may wait for it.
        token: what opens the page.
        options: where to listen.
        browser: whether to open a browser, too.
        stop: receives the signals.
        then: called once pages can come.

    Raises:
        OptionError: if there is no such address, no free port, or no such certificate.
    """
    sys.setswitchinterval(_GIVE_WAY_S)
    gateway = Gateway(lambda port: site(workbench, token=token, viser=viser, options=options, port=port), options)
    try:
        gateway.start()
        if options.port not in (0, gateway.port):
            print(f"ladarreg: port {options.port} is busy, using {gateway.port}", file=sys.stderr)
        if not options.on_loopback:
            print(f"ladarreg: {warning(options)}", file=sys.stderr)
        address = f"{gateway.address}?token={quote(token, safe='')}"
        print(f"Open {address}  (Ctrl-C ends)", flush=True)
        if browser:
            open_browser(address)
        then()
        gateway.wait(stop.wait)
        if stop.first == signal.SIGINT:
            print_error("")  # behind the terminal's ^C
    finally:
        gateway.close()


def warning(options: GatewayOptions) -> str:
    """Return what to know before others can connect."""
    if options.tls:
        return f"others can reach {options.host}: whoever has the token may see, change and upload everything here"
    return (
        f"others can reach {options.host}, and without TLS the token and all data can be read on the way: use"
        " --certfile and --keyfile, a proxy, or an SSH tunnel (docs/remote.md)"
    )
