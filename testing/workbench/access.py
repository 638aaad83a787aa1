"""How a client of tests and benchmarks gets at what lies behind the login."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

OUTSIDE = ("/?token=", "/enter")
"""Beginnings of the paths of the login; everything else is below the path of a session."""


@dataclass(frozen=True, slots=True)
class Access:
    """A session: its cookie, and the path that the cookie is limited to."""

    cookie: str = ""
    """`name=value`."""
    path: str = "/"
    """Where it is valid, with slashes around it."""

    @staticmethod
    def granted(headers: Mapping[str, str]) -> Access:
        """Return the session that a login has opened, given the headers of the response by lower-case names."""
        cookie, *flags = headers["set-cookie"].split("; ")
        fields = dict(flag.partition("=")[::2] for flag in flags)
        return Access(cookie, next(value for name, value in fields.items() if name.lower() == "path"))

    def within(self, path: str) -> str:
        """Return the address of what a page names by a path from its own folder, `/picture/scan`."""
        return path if path.startswith(OUTSIDE) else self.path + path.removeprefix("/")
