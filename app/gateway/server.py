"""The gateway as a running server: its port, certificate and thread, and serving until a stop signal."""

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

from ..process_resources import raise_descriptor_limit
from ..stop_signals import StopSignals, print_error
from .connections import PROTOCOLS, LimitedServer, TrackedApp
from .listening import listening_socket, stop_listening
from .options import GatewayOptions
from .protocol import Workbench
from .routes import build_site
from .tokens import Tokens
from .viser_backend import ViserAddress

_START_TIMEOUT_S = 20.0
_GRACE_S = 2
MAX_MESSAGE_BYTES = 1_000_000
"""Length of the longest message accepted from a page or a 3-D view; counted while it arrives."""
# On a slow line a ping waits behind the scene, which has megabytes.
_PING_S, _PONG_S = 20.0, 120.0
_SWITCH_INTERVAL_S = 0.0005
"""Interpreter switch interval: computing threads must yield quickly, because a request waits for several switches."""


class Gateway:
    """A site on its port, served by a thread of its own.

    Args:
        build: returns the site, given the port.
        options: where to listen.

    Raises:
        OptionError: if it cannot listen there, or the certificate is unusable.
    """

    def __init__(self, build: Callable[[int], ASGIApp], options: GatewayOptions) -> None:
        check_certificate(options)
        self._options = options
        self._socket = listening_socket(options)
        self.port: int = 0 if options.socket else self._socket.getsockname()[1]
        config = uvicorn.Config(
            TrackedApp(build(self.port)),
            **PROTOCOLS,
            loop="asyncio",
            ws_max_size=MAX_MESSAGE_BYTES,
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
        self._server = LimitedServer(config, options.limits.within(raise_descriptor_limit()))
        self._thread = threading.Thread(target=self._run, name="gateway", daemon=True)
        self._ended = threading.Event()
        self._failure: BaseException | None = None

    @property
    def address(self) -> str:
        """URL to open in a browser, without the token; behind a Unix socket, of the proxy, as far as it is known."""
        if self._options.socket is not None:
            return f"https://{next(iter(self._options.allowed_hosts), 'NAME-OF-THE-PROXY')}/"
        host = self._options.host.strip("[]")
        if host in ("", "0.0.0.0", "::"):
            host = socket.gethostname()
        scheme = "https" if self._options.tls else "http"
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{self.port}/"

    def start(self) -> None:
        """Start listening, and return when browsers can connect."""
        self._thread.start()
        until = time.monotonic() + _START_TIMEOUT_S
        while not self._server.started and not self._ended.is_set() and time.monotonic() < until:
            time.sleep(0.01)
        if self._failure is not None:
            raise self._failure

    def wait(self, stop_requested: Callable[[float], bool]) -> None:
        """Block until the server has ended or is asked to stop.

        Args:
            stop_requested: waits for at most the given seconds and returns whether the server is to stop.
        """
        while not self._ended.is_set() and not stop_requested(1.0):
            pass
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Stop: finish requests under way, and close the websockets with 1012."""
        self._server.should_exit = True
        if self._thread.ident is not None:
            self._ended.wait(timeout=_GRACE_S + 5.0)
        stop_listening(self._socket, self._options)

    def _run(self) -> None:
        try:
            self._server.run(sockets=[self._socket])
        except BaseException as error:
            self._failure = error
        finally:
            self._ended.set()


def serve_until_interrupted(
    workbench: Workbench,
    viser: Callable[[], ViserAddress],
    *,
    tokens: Callable[[int], Tokens],
    options: GatewayOptions,
    browser: bool,
    stop: StopSignals,
    then: Callable[[], None] = lambda: None,
) -> None:
    """Serve a workbench, print its address, and return at a stop signal.

    Args:
        workbench: the application's state.
        viser: returns the address of the locked viser server; may block until it is open.
        tokens: returns the tokens that grant access, given the port.
        options: where to listen.
        browser: whether to open a browser.
        stop: receives the signals.
        then: called once pages can connect.

    Raises:
        OptionError: if the address is not one of this machine, no port is free, or the certificate is unusable.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL_S)

    found: list[Tokens] = []

    def build(port: int) -> ASGIApp:
        found.append(tokens(port))
        edit, look = found[-1].edit, found[-1].look
        return build_site(workbench, token=edit, read_only_token=look, viser=viser, options=options)

    gateway = Gateway(build, options)
    try:
        gateway.start()
        if options.socket is None and options.port not in (0, gateway.port):
            print(f"ladarreg: port {options.port} is busy, using {gateway.port}", file=sys.stderr)
        if not options.on_loopback:
            print(f"ladarreg: {exposure_warning(options)}", file=sys.stderr)
        address, look = (f"{gateway.address}?token={quote(each, safe='')}" for each in (found[-1].edit, found[-1].look))
        if options.socket is not None:
            _print(f"Listening on {options.socket}, for the proxy that is opened as follows.")
        _print(f"Open {address}  (Ctrl-C ends)")
        if found[-1].look:
            _print(f"Read-only: {look}")
        if browser and options.socket is None:
            _open_browser(address)
        then()
        gateway.wait(stop.wait)
        if stop.first == signal.SIGINT:
            print_error("")  # ends the terminal's line with ^C
    finally:
        gateway.close()


def _print(line: str) -> None:
    try:
        print(line, flush=True)
    except OSError as error:
        if error.errno != errno.EIO:  # the terminal has just been closed; the SIGHUP that follows ends the program
            raise


def exposure_warning(options: GatewayOptions) -> str:
    """Return the warning shown when other machines can connect."""
    if options.tls:
        return f"other machines can reach {options.host}: anyone with the token can view, change and upload everything"
    return (
        f"other machines can reach {options.host}, and without TLS the token and all data can be read on the network:"
        " use --certfile and --keyfile, a proxy, or an SSH tunnel (docs/remote.md)"
    )


def check_certificate(options: GatewayOptions) -> None:
    """Refuse a certificate that TLS cannot use.

    Raises:
        OptionError: if it cannot be read, or the key does not belong to it.
    """
    if options.certfile is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(
            options.certfile, options.keyfile, password=_no_password
        )
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        reason = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        raise OptionError(
            f"{options.certfile}: the certificate or its key cannot be used ({reason}); give both as PEM, the key"
            " without a password"
        ) from None


def _no_password() -> str:
    raise ValueError("the key has a password")


def _open_browser(address: str) -> None:
    """Open an address if there is a display: without one, a text browser would take over the terminal."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform in ("win32", "darwin") or display:
        webbrowser.open(address)
