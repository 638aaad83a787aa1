"""What one page has been told, so that it need only be told what is new."""

from __future__ import annotations

from typing import Any

from .encoding import Encoded
from .json_text import encode
from .protocol import Client, Message


class Told:
    """The slices as a page has them; its messages are numbered, so that it would notice if it missed one.

    Args:
        client: the page.
        encoded: shared by all pages.
    """

    def __init__(self, client: Client, encoded: Encoded) -> None:
        self._client, self._encoded = client, encoded
        self._slices: dict[str, Any] = {}
        self._version = 0

    def text(self, message: Message) -> str:
        """Return a message as this page is to be sent it, and take it for sent."""
        return self._news(message["slices"]) if "slices" in message else encode(message)

    def _news(self, slices: dict[str, Any]) -> str:
        self._version += 1
        whole: dict[str, Any] = {}
        changes: dict[str, Any] = {}
        for name, value in slices.items():
            if name == "people" and value:  # everybody is somebody else in it
                whole[name] = value | {"you": self._client.name}
                continue
            before = self._slices.get(name)
            change = None if before is None or value is None else self._encoded.change(before, value)
            if change is None:
                whole[name] = self._encoded.slice(value)
            else:
                changes[name] = change
        self._slices = {name: value for name, value in (self._slices | slices).items() if value is not None}
        parts = {"slices": whole, "changes": changes} if changes else {"slices": whole}
        return encode({**parts, "version": self._version})
