"""The interface between the gateway and the workbench behind it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

Message = dict[str, Any]
"""A message to the clients: `{"slices": {...}, "version": 12}` or `{"event": name, ...}` (docs/workbench.md)."""


class Client(Protocol):
    """One open page."""

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
    """PNG or JPEG."""
    media_type: str
    """For example `image/png`."""
    etag: str
    """Changes whenever the picture does."""


class Workbench(Protocol):
    """The application behind the gateway; safe to call from any thread."""

    @property
    def limits(self) -> Limits:
        """Its limits."""

    def slices(self, client: Any) -> dict[str, Any]:
        """Return all slices of the state, as this client sees them."""

    def subscribe(self, listener: Callable[[Message], None]) -> Callable[[], None]:
        """Call the listener, from any thread, with every change; return the function that ends this."""

    def join(self, address: str) -> Client:
        """Connect a client; raises `LadarregError` if there are too many."""

    def leave(self, client: Any) -> None:
        """Disconnect a client."""

    def answer(self, client: Any, message: dict[str, Any]) -> dict[str, Any]:
        """Execute a command and return its reply; takes a few milliseconds and never raises."""

    def picture(self, path: str, query: Mapping[str, str]) -> Picture:
        """Draw a picture; raises `LadarregError`."""

    def upload_folder(self) -> Path:
        """Return the folder that uploads are written to before they are checked."""

    def take_upload(self, path: Path, name: str, what: str, photo: str | None, client: Any) -> str:
        """Open an uploaded file and return the id of what it became; raises `LadarregError`.

        The workbench owns the file from then on: it removes files that it refuses, but never those of the project.
        """

    def export_file(self, photo: str) -> tuple[Path, str] | None:
        """Return the latest export of a photograph and its download name."""
