"""The gateway as a running server: a port, a thread, an orderly end."""

from __future__ import annotations

import errno
import os
import signal
import socket
import ssl
import sys
import threading
import time
import webbrowser
from collections.abc import Callable
from urllib.parse import quote

import uvicorn
from starlette.types import ASGIApp

from ladarreg_core.errors import OptionError

from ..process_resources import raised_descriptor_limit
from ..stop_signals import StopSignals, say
from .connections import PROTOCOLS, LimitedServer, WatchedApp
from .options import GatewayOptions
from .protocol import Workbench
from .routes import site
from .viser_backend import ViserAddress

_PORTS_TRIED = 100
_START_S = 20.0
_GRACE_S = 2
# Messages to viser pass here too; those of the document have a limit of their own.
_LONGEST_MESSAGE = 64 << 20
# On a slow line a ping waits behind the scene: megabytes.
_PING_S, _PONG_S = 20.0, 120.0


class Gateway:
    """A site on its port, served by a thread of its own.

    Args:
        build: makes the site once the port is known.
        options: where to listen.

    Raises:
        OptionError: if there is no such address, no free port, or no such certificate.
    """

    def __init__(self, build: Callable[[int], ASGIApp], options: GatewayOptions) -> None:
        check_certificate(options)
        self._options = options
        self._socket = _bound_socket(options)
        self.port: int = self._socket.getsockname()[1]
        config = uvicorn.Config(
            WatchedApp(build(self.port)),
            **PROTOCOLS,
            loop="asyncio",
            ws_max_size=_LONGEST_MESSAGE,
            ws_ping_interval=_PING_S,
            ws_ping_timeout=_PONG_S,
            ws_per_message_deflate=False,
            lifespan="off",
            log_config=None,
            access_log=False,
            proxy_headers=False,
            server_header=False,
            timeout_graceful_shutdown=_GRACE_S,
            ssl_certfile=options.certfile,
            ssl_keyfile=options.keyfile,
        )
        self._server = LimitedServer(config, options.limits.within(raised_descriptor_limit()))
        self._thread = threading.Thread(target=self._run, name="gateway", daemon=True)
        self._ended = threading.Event()
        self._failure: BaseException | None = None

    @property
    def address(self) -> str:
        """What to open in a browser, without the token."""
        host = self._options.host.strip("[]")
        if host in ("", "0.0.0.0", "::"):
            host = socket.gethostname()
        scheme = "https" if self._options.tls else "http"
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{self.port}/"

    def start(self) -> None:
        """Listen, and return when browsers can come."""
        self._thread.start()
        until = time.monotonic() + _START_S
        while not self._server.started and not self._ended.is_set() and time.monotonic() < until:
            time.sleep(0.01)
        if self._failure is not None:
            raise self._failure

    def wait(self, stopped: Callable[[float], bool]) -> None:
        """Return when the server has ended or is to end.

        Args:
            stopped: waits for so many seconds at most and returns whether the server is to end.
        """
        while not self._ended.is_set() and not stopped(1.0):
            pass
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """End: finish what is under way, tell the pages that it is over (1012)."""
        self._server.should_exit = True
        if self._thread.ident is not None:
            self._ended.wait(timeout=_GRACE_S + 5.0)
        self._socket.close()

    def _run(self) -> None:
        try:
            self._server.run(sockets=[self._socket])
        except BaseException as error:
            self._failure = error
        finally:
            self._ended.set()


def check_certificate(options: GatewayOptions) -> None:
    """Refuse a certificate that TLS cannot use.

    Raises:
        OptionError: if it cannot be read, or the key is another's.
    """
    if options.certfile is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(
            options.certfile, options.keyfile, password=_no_password
        )
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        said = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        raise OptionError(
            f"{options.certfile}: the certificate or its key cannot be used ({said}); both are needed as PEM, the key"
            " without a password"
        ) from None


def _no_password() -> str:
    raise ValueError("the key has a password")


def _bound_socket(options: GatewayOptions) -> socket.socket:
    host = options.host.strip("[]")
    last = min(options.port + _PORTS_TRIED, 65536) if options.port else 1
    for port in range(options.port, last):
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
        except OSError:
            raise OptionError(f"{host!r} is no address of this machine; give another with --host") from None
        bound = socket.socket(family, kind, protocol)
        if sys.platform == "win32":  # SO_REUSEADDR would let two servers share a port there
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        else:
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            bound.bind(address)
            bound.listen(1)  # of two servers that may both bind, the second fails here
        except OSError as error:
            bound.close()
            if error.errno != errno.EADDRINUSE:
                said = error.strerror or error
                raise OptionError(f"{host} port {port}: {said}; give another with --host or --port") from None
            continue
        return bound
    raise OptionError(f"no free port from {options.port} on; give another with --port")


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
            say("")  # behind the terminal's ^C
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


def open_browser(address: str) -> bool:
    """Open an address where there is a screen: without one, a text browser would take over the terminal.

    Args:
        address: what to open.

    Returns:
        Whether a browser was found.
    """
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return bool(sys.platform in ("win32", "darwin") or screen) and webbrowser.open(address)
