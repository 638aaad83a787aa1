"""The interface between the gateway and the workbench behind it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

READ_ONLY = "This page is read-only: to change anything, open the workbench with the link that permits editing."
"""Refusal of everything but looking."""
Message = Mapping[str, Any]
"""A message to the clients: `{"slices": {...}, "version": 12}` or `{"event": name, ...}` (docs/workbench.md)."""


@dataclass(frozen=True, slots=True)
class Visitor:
    """A page that connects, by what it says of itself; everything but the address may be empty."""

    address: str
    """Network address."""
    tab: str = ""
    """Secret of the browser tab, by which it is recognised when it returns."""
    page: str = ""
    """Distinguishes two pages that present the same secret: a browser copies it with the tab."""
    name: str = ""
    """Name that the person had before."""
    photo: str = ""
    """Id of the photograph that the person saw before."""
    read_only: bool = False
    """True if its token only permits looking."""


class Client(Protocol):
    """The person at an open page."""

    @property
    def id(self) -> str:
        """Public id, stable for a browser tab."""

    @property
    def name(self) -> str:
        """Name shown to the other clients."""


class Limits(Protocol):
    """Limits of the workbench."""

    @property
    def upload_bytes(self) -> int:
        """Size of the largest file accepted."""


@dataclass(frozen=True, slots=True)
class Picture:
    """An encoded picture."""

    data: bytes
    """PNG, JPEG or WebP."""
    media_type: str
    """For example `image/png`."""
    etag: str
    """Changes whenever the picture does."""
    headers: Mapping[str, str] = field(default_factory=dict)
    """Further headers of the response."""


class Workbench(Protocol):
    """The application behind the gateway; safe to call from any thread."""

    @property
    def limits(self) -> Limits:
        """Its limits."""

    @property
    def urgent_commands(self) -> Collection[str]:
        """The commands that wait neither for earlier ones of their page nor for a thread."""

    def slices(self, client: Any) -> dict[str, Any]:
        """Return all slices of the state, as this client sees them."""

    def subscribe(self, listener: Callable[[Message], None], client: Any) -> Callable[[], None]:
        """Call the listener, from any thread, with every change that this client sees; return what ends this."""

    def join(self, visitor: Visitor) -> Client:
        """Connect a client; raises `LadarregError` if there are too many."""

    def leave(self, client: Any) -> None:
        """Disconnect a client."""

    def answer(self, client: Any, message: dict[str, Any]) -> dict[str, Any]:
        """Execute a command and return its reply; takes a few milliseconds and never raises."""

    def picture(self, path: str, query: Mapping[str, str]) -> Picture:
        """Draw a picture; raises `LadarregError`."""

    def first_pictures(self) -> Mapping[str, str]:
        """Return the URL, relative to the page, of the picture that each pane (`scan`, `photo`) shows first.

        Those that are not known without reading a file are omitted.
        """

    def upload_folder(self) -> Path:
        """Return the folder that uploads are written to before they are checked."""

    def take_upload(self, path: Path, name: str, what: str, photo: str | None, client: Any) -> str:
        """Open an uploaded file and return the id of what it became; raises `LadarregError`.

        The workbench owns the file from then on: it removes files that it refuses, but never those of the project.
        """

    def export_file(self, name: str, ending: Literal["zip", "html"] = "zip") -> tuple[Path, str] | None:
        """Return the latest zip or report of a photograph's id, or `all`, and its download name."""
