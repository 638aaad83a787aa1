"""Options of the gateway: where it listens, what stands in front of it, and its connection limits."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

from ladarreg_core.errors import OptionError

from .request_source import is_loopback

_NAME = re.compile(r"[A-Za-z0-9._-]+|[0-9A-Fa-f:]+")
_RESERVED = 128
"""File descriptors reserved for everything but connections."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionLimits:
    """Limits on the number of open connections, and on the time that the gateway waits for them."""

    header_s: float = 10.0
    """For a complete request header, TLS handshake included, from the connection or the previous response on; and for
    the login form of an anonymous connection."""
    stall_s: float = 120.0
    """For progress of an upload, or of a response being read; and for a whole response to an anonymous connection."""
    anonymous: int = 128
    """Connections that have not shown a valid cookie."""
    authenticated: int = 512
    """Connections that have shown a valid cookie."""
    views: int = 64
    """Open 3-D views: each buffers megabytes while its browser does not read what it is sent."""

    def within(self, descriptors: int | None) -> ConnectionLimits:
        """Return limits that leave enough file descriptors for files and jobs.

        Args:
            descriptors: that the process may open; None: unlimited.
        """
        if descriptors is None:
            return self
        anonymous, views = min(self.anonymous, descriptors // 8), min(self.views, descriptors // 8)
        # A forwarded view takes two more descriptors, and an authenticated connection may be uploading a file.
        rest = descriptors - min(_RESERVED, descriptors // 4) - anonymous - 2 * views
        return replace(self, anonymous=anonymous, views=views, authenticated=min(self.authenticated, rest // 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewayOptions:
    """Address, TLS and proxy settings of the gateway."""

    host: str = "127.0.0.1"
    """Address or name to listen on."""
    port: int = 8700
    """Preferred port; the next free one is used if it is busy; 0: any free port."""
    certfile: str | None = None
    """Certificate chain, PEM; enables TLS."""
    keyfile: str | None = None
    """Private key of the certificate, PEM; None: contained in `certfile`."""
    socket: Path | None = None
    """Unix socket to listen on in place of a port; only a reverse proxy connects there."""
    behind_proxy: bool = False
    """True if a reverse proxy stands in front, whose X-Forwarded headers are trusted; always with `socket`."""
    allowed_hosts: tuple[str, ...] = ()
    """Host names, besides those of loopback, under which browsers may request the page."""
    limits: ConnectionLimits = field(default_factory=ConnectionLimits)
    """Connection limits; reduced where the system allows fewer file descriptors."""

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise OptionError(f"the port is {self.port}; it must be between 0 and 65535")
        if self.socket is not None:
            if self.certfile:
                raise OptionError("a proxy speaks TLS in front of a socket: give --certfile to it, or omit --socket")
            object.__setattr__(self, "behind_proxy", True)
        if self.keyfile and not self.certfile:
            raise OptionError("a key was given without its certificate; add --certfile")
        for name in self.allowed_hosts:
            if not _NAME.fullmatch(name):
                raise OptionError(f"{name!r} is not a host name; give the name alone, without scheme and port")

    @property
    def tls(self) -> bool:
        """True if the gateway itself speaks TLS."""
        return self.certfile is not None

    @property
    def on_loopback(self) -> bool:
        """True if only this machine can connect."""
        return self.socket is not None or is_loopback(self.host)
