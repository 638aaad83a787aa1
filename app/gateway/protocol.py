"""What the gateway asks of the workbench behind it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

Message = dict[str, Any]
"""What goes to the pages: `{"slices": {...}, "version": 12}` or `{"event": name, ...}` (docs/workbench.md)."""


class Client(Protocol):
    """One open page."""

    @property
    def name(self) -> str:
        """What the others call it."""


class Limits(Protocol):
    """What the workbench takes."""

    @property
    def upload_bytes(self) -> int:
        """The largest file."""


class PictureLike(Protocol):
    """An encoded picture."""

    @property
    def data(self) -> bytes:
        """PNG or JPEG."""

    @property
    def media_type(self) -> str:
        """Its kind, `image/png` say."""

    @property
    def etag(self) -> str:
        """What changes when the picture does."""


@dataclass(frozen=True, slots=True)
class Picture:
    """An encoded picture."""

    data: bytes
    """PNG or JPEG."""
    media_type: str
    """Its kind, `image/png` say."""
    etag: str
    """What changes when the picture does."""


class Workbench(Protocol):
    """The application, safe to call from any thread."""

    @property
    def limits(self) -> Limits:
        """What it takes."""

    def slices(self, client: Any) -> dict[str, Any]:
        """Return all slices, as this page is to be told them."""

    def subscribe(self, listener: Callable[[Message], None]) -> Callable[[], None]:
        """Call the listener, from any thread, with what changes; return what ends it."""

    def join(self, address: str) -> Client:
        """Let a page in."""

    def leave(self, client: Any) -> None:
        """Let a page go."""

    def answer(self, client: Any, message: dict[str, Any]) -> dict[str, Any]:
        """Do what a page asks for; a few milliseconds, never raises."""

    def picture(self, path: str, query: Mapping[str, str]) -> PictureLike:
        """Draw a picture; raises `LadarregError`."""

    def upload_room(self) -> Path:
        """Return the folder that uploads are written to before they are looked at."""

    def take_upload(self, path: Path, name: str, what: str, photo: str | None, client: Any) -> str:
        """Take a file that has arrived and return its id; raises `LadarregError`.

        The file is the workbench's from then on: it removes what it refuses, and never what is in the project.
        """

    def export_file(self, photo: str) -> tuple[Path, str] | None:
        """Return the last export of a photograph and the name to save it by."""
