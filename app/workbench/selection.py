"""The selection: the photograph that all clients see."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..session.session import Session

if TYPE_CHECKING:
    from ladarreg_core.project.document import PhotoEntry
    from ladarreg_core.project.history import History


class Selection:
    """The photograph that all clients see; at first the one that was edited last.

    Args:
        session: the session.
        on_change: called after another photograph was selected.
    """

    def __init__(self, session: Session, on_change: Callable[[], None]) -> None:
        self._session = session
        self._on_change = on_change
        self._photo_id = _last_edited(session.history)

    @property
    def photo(self) -> PhotoEntry | None:
        """The selected photograph; without one the first, None if there is none."""
        document = self._session.document
        found = document.photo(self._photo_id or "")
        return found or (document.photos[0] if document.photos else None)

    def show(self, photo_id: str) -> None:
        """Select a photograph."""
        self._photo_id = photo_id
        self._on_change()


def _last_edited(history: History) -> str | None:
    """Return the id of the photograph that the newest step changed."""
    steps = history.entries[: history.at + 1]
    for before, after in zip(reversed(steps[:-1]), reversed(steps[1:]), strict=True):
        known = {photo.id: photo for photo in before.document.photos}
        for photo in after.document.photos:
            if photo.id not in known or photo != known[photo.id]:
                return photo.id
    return None
