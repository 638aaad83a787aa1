"""The selection: which photograph each client sees."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from ...session.session import Session
from .clients import Client

if TYPE_CHECKING:
    from ladarreg_core.project.document import PhotoEntry
    from ladarreg_core.project.history import History


class Selection:
    """The photograph that each client sees; at first the one that was selected last by anyone.

    Args:
        session: the session.
        on_change: called after another photograph was selected.
        leader_of: returns the client whose view a client sees.
    """

    def __init__(
        self,
        session: Session,
        on_change: Callable[[], None],
        leader_of: Callable[[Client], Client] = lambda client: client,
    ) -> None:
        self._leader_of = leader_of
        self._session = session
        self._on_change = on_change
        self._latest = _last_edited(session.history)
        self._by_id: tuple[Sequence[PhotoEntry], dict[str, PhotoEntry]] = (), {}

    @property
    def photo(self) -> PhotoEntry | None:
        """The photograph that was selected last, and that a new client sees."""
        return self._entry(self._latest)

    def photo_of(self, client: Client | None) -> PhotoEntry | None:
        """Return the photograph that a client sees; without one the first, None if there is none."""
        if client is None:
            return self.photo
        leader = self._leader_of(client)
        if leader.photo is None:
            leader.photo = self._latest
        client.photo = leader.photo  # it stays when the leader leaves
        return self._entry(client.photo)

    def show(self, client: Client | None, photo_id: str) -> None:
        """Select a photograph, for one client only."""
        self._latest = photo_id
        if client is not None:
            client.photo = photo_id
            client.follows = None
        self._on_change()

    def _entry(self, photo_id: str | None) -> PhotoEntry | None:
        photos = self._session.document.photos
        of, by_id = self._by_id
        if of is not photos:  # asked for every client at every edit: not a search among all photographs each time
            by_id = {entry.id: entry for entry in photos}
            self._by_id = photos, by_id
        return by_id.get(photo_id or "") or (photos[0] if photos else None)


def _last_edited(history: History) -> str | None:
    """Return the id of the photograph that the newest step changed."""
    steps = history.entries[: history.at + 1]
    for before, after in zip(reversed(steps[:-1]), reversed(steps[1:]), strict=True):
        known = {photo.id: photo for photo in before.document.photos}
        for photo in after.document.photos:
            if photo.id not in known or photo != known[photo.id]:
                return photo.id
    return None
