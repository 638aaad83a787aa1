"""How the gateway is reached."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass, field, replace

from ladarreg_core.errors import OptionError

_NAME = re.compile(r"[A-Za-z0-9._-]+|[0-9A-Fa-f:]+")
_RESERVED = 128
"""Descriptors that connections leave to everything else."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionLimits:
    """How many connections the gateway keeps open, and how long it waits for them."""

    header_s: float = 10.0
    """For the whole header of a request, TLS included, from the connection or the last answer on; and for a stranger's
    form."""
    stall_s: float = 120.0
    """For the next bytes of an upload to come, or of an answer to be taken; and for a stranger's whole answer."""
    strangers: int = 128
    """Connections on which nobody has shown a valid cookie."""
    members: int = 512
    """Connections on which somebody has."""
    views: int = 64
    """Open 3-D views: each costs megabytes as long as it does not take what it is sent."""

    def within(self, descriptors: int | None) -> ConnectionLimits:
        """Return limits that leave files and jobs what they need of a process's descriptors.

        Args:
            descriptors: that the process may have open; None: no matter how many.
        """
        if descriptors is None:
            return self
        strangers, views = min(self.strangers, descriptors // 8), min(self.views, descriptors // 8)
        # A view is forwarded by two more descriptors, and a member may have a file on its way.
        rest = descriptors - min(_RESERVED, descriptors // 4) - strangers - 2 * views
        return replace(self, strangers=strangers, views=views, members=min(self.members, rest // 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewayOptions:
    """Where the gateway listens and what stands in front of it."""

    host: str = "127.0.0.1"
    """Address or name to listen on."""
    port: int = 8700
    """Wanted port; the next free one is taken where it is busy; 0 is any."""
    certfile: str | None = None
    """Certificate chain, PEM; TLS is on where it is given."""
    keyfile: str | None = None
    """Its key, PEM; None: in `certfile`."""
    behind_proxy: bool = False
    """Whether a reverse proxy stands in front, whose X-Forwarded headers are believed."""
    allowed_hosts: tuple[str, ...] = ()
    """Names, beside loopback's, under which browsers may ask for the page."""
    limits: ConnectionLimits = field(default_factory=ConnectionLimits)
    """How many connections are kept, and for how long; fewer where the system allows fewer descriptors."""

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise OptionError(f"the port is {self.port}; it must be between 0 and 65535")
        if self.keyfile and not self.certfile:
            raise OptionError("a key without its certificate was given; add --certfile")
        for name in self.allowed_hosts:
            if not _NAME.fullmatch(name):
                raise OptionError(f"{name!r} is no name of a host; give the name alone, without scheme and port")

    @property
    def tls(self) -> bool:
        """Whether the gateway speaks TLS itself."""
        return self.certfile is not None

    @property
    def on_loopback(self) -> bool:
        """Whether nobody but this machine can connect."""
        return is_loopback(self.host)


def is_loopback(host: str) -> bool:
    """Tell whether a name or address means this machine only.

    Args:
        host: name or address, IPv6 with or without brackets.
    """
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
