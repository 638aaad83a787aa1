"""Where a layer is drawn: in the view of one client, or in everybody's."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import viser


class Place(Protocol):
    """A viser client, or the server for all of them."""

    scene: viser.SceneApi

    def atomic(self) -> AbstractContextManager[None]:
        """Group changes that must appear together."""
