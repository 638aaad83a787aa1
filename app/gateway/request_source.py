"""The source of a request: address, host and origin, as reported by the browser or by the reverse proxy in front."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import urlsplit

from starlette.types import Scope

_PREFIX = re.compile(r"(/[A-Za-z0-9._~-]+)*/?")
_HOST = re.compile(r"(?:\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::[0-9]{1,5})?")
_DEFAULT_PORTS = {"http": "80", "ws": "80", "https": "443", "wss": "443"}
_IPV6_NETWORK_BITS = 64


@dataclass(frozen=True, slots=True)
class RequestSource:
    """The peer and page that a request comes from, and the host that it names."""

    address: str
    """Address of the browser."""
    host: str
    """Host and port that the browser requested; empty if there is none or it is malformed."""
    secure: bool
    """True if the browser's connection is TLS."""
    prefix: str
    """URL prefix under which the page is served, at least `/`."""
    origin: str
    """Header Origin; empty if it is missing or repeated."""
    fetch_site: str = ""
    """Header Sec-Fetch-Site: relation of the requesting page to this site; empty if the browser does not send it."""
    fetch_dest: str = ""
    """Header Sec-Fetch-Dest: how the browser will use the response; empty if the browser does not send it."""

    @property
    def hostname(self) -> str:
        """The host without its port, in lower case."""
        return re.sub(r":[0-9]+$", "", self.host).lower()

    @property
    def is_from_elsewhere(self) -> bool:
        """True if the browser says that another page made the request: one of another site, or of another port."""
        return self.fetch_site in ("same-site", "cross-site")

    @property
    def is_same_origin(self) -> bool:
        """True if the header Origin names the requested scheme, host and port."""
        if not self.host:
            return False
        try:
            parts = urlsplit(self.origin)
        except ValueError:
            return False
        if parts.scheme != ("https" if self.secure else "http") or parts.path or parts.query or parts.fragment:
            return False
        return _with_port(parts.netloc, parts.scheme) == _with_port(self.host, parts.scheme)


def request_source(scope: Scope, *, behind_proxy: bool) -> RequestSource:
    """Return the source of a request.

    Args:
        scope: of an HTTP request or a websocket.
        behind_proxy: whether the X-Forwarded headers are trusted.
    """
    headers = [(name.lower(), value.decode("latin-1").strip()) for name, value in scope["headers"]]
    client = scope.get("client")
    address, host = client[0] if client else "", _only(headers, b"host")
    secure, prefix = scope["scheme"] in ("https", "wss"), "/"
    if behind_proxy:
        # A proxy appends its entry; everything before it was sent by the browser and is not trusted.
        address = _last(headers, b"x-forwarded-for") or address
        host = _last(headers, b"x-forwarded-host") or host
        secure = secure or _last(headers, b"x-forwarded-proto") == "https"
        prefix = _prefix(_last(headers, b"x-forwarded-prefix"))
    return RequestSource(
        address,
        host if _HOST.fullmatch(host) else "",
        secure,
        prefix,
        _only(headers, b"origin"),
        _only(headers, b"sec-fetch-site"),
        _only(headers, b"sec-fetch-dest"),
    )


def network_of(address: str) -> str:
    """Return what limits count as one peer: the /64 network of an IPv6 address, otherwise the address itself."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if parsed.version == 4:
        return address
    return str(parsed.ipv4_mapped or ipaddress.ip_network((parsed, _IPV6_NETWORK_BITS), strict=False))


def is_loopback(host: str) -> bool:
    """Return whether a name or address refers to this machine only.

    Args:
        host: name or address, IPv6 with or without brackets.
    """
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _only(headers: Iterable[tuple[bytes, str]], name: bytes) -> str:
    values = [value for key, value in headers if key == name]
    return values[0] if len(values) == 1 else ""


def _last(headers: Iterable[tuple[bytes, str]], name: bytes) -> str:
    values = [value for key, value in headers if key == name]
    return values[-1].split(",")[-1].strip() if values else ""


def _prefix(text: str) -> str:
    return text.rstrip("/") + "/" if text and _PREFIX.fullmatch(text) else "/"


def _with_port(netloc: str, scheme: str) -> str:
    netloc = netloc.lower()
    return netloc if re.search(r":[0-9]+$", netloc) else f"{netloc}:{_DEFAULT_PORTS[scheme]}"
