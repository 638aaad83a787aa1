"""What a request says of itself, seen through the proxy in front where there is one."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import urlsplit

from starlette.types import Scope

_PREFIX = re.compile(r"(/[A-Za-z0-9._~-]+)*/?")
_HOST = re.compile(r"(?:\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::[0-9]{1,5})?")
_DEFAULT_PORTS = {"http": "80", "ws": "80", "https": "443", "wss": "443"}


@dataclass(frozen=True, slots=True)
class Asked:
    """Who asks, and for which host."""

    address: str
    """Of the browser."""
    host: str
    """Name and port that the browser asked for, empty if it said none that is one."""
    secure: bool
    """Whether the browser's connection is TLS."""
    prefix: str
    """The folder that the page lives under, `/` at least."""
    origin: str
    """The header Origin, empty if there is none, or several."""
    from_site: str = ""
    """The header Sec-Fetch-Site: whose page asks, empty where the browser does not say."""
    shown_as: str = ""
    """The header Sec-Fetch-Dest: what the answer becomes in the browser, empty where it does not say."""

    @property
    def name(self) -> str:
        """The host without its port, lower case."""
        return re.sub(r":[0-9]+$", "", self.host).lower()

    @property
    def same(self) -> bool:
        """Whether the header Origin names the host that was asked."""
        if not self.host:
            return False
        try:
            parts = urlsplit(self.origin)
        except ValueError:
            return False
        if parts.scheme not in ("http", "https") or parts.path or parts.query or parts.fragment:
            return False
        return _with_port(parts.netloc, parts.scheme) == _with_port(self.host, parts.scheme)


def asked_of(scope: Scope, *, behind_proxy: bool) -> Asked:
    """Return what a request says of itself.

    Args:
        scope: of a request or a websocket.
        behind_proxy: whether X-Forwarded headers are believed.
    """
    headers = [(name.lower(), value.decode("latin-1").strip()) for name, value in scope["headers"]]
    client = scope.get("client")
    address, host = client[0] if client else "", _only(headers, b"host")
    secure, prefix = scope["scheme"] in ("https", "wss"), "/"
    if behind_proxy:
        # A proxy appends; what stands before its own entry is the browser's word.
        address = _last(headers, b"x-forwarded-for") or address
        host = _last(headers, b"x-forwarded-host") or host
        secure = secure or _last(headers, b"x-forwarded-proto") == "https"
        prefix = _prefix(_last(headers, b"x-forwarded-prefix"))
    return Asked(
        address,
        host if _HOST.fullmatch(host) else "",
        secure,
        prefix,
        _only(headers, b"origin"),
        _only(headers, b"sec-fetch-site"),
        _only(headers, b"sec-fetch-dest"),
    )


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
