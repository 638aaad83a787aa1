"""The clients: the people at open pages, and what each of them looks at."""

from __future__ import annotations

import base64
import hashlib
import secrets
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError
from ladarreg_core.project.history import Author

from ...gateway.protocol import Visitor
from ...gateway.seats import Seats
from ...scene.model_view import ModelChoice

if TYPE_CHECKING:
    from ...slices.choices import SmoothingShow
    from ...slices.project import People

MAX_CLIENTS = 64
_LIMIT = Seats(MAX_CLIENTS)
COLORS = 6
"""Number of colours that tell people apart."""
_MAX_NAME = 80
_REMEMBERED = 256
"""Clients that are recognised when they return."""
_RELOAD_S = 1.0
"""Time within which the old connection of a reloaded page ends."""
_ID_BYTES = 9


@dataclass(frozen=True, slots=True)
class SmoothingChoice:
    """The preview that a client looks at."""

    photo: str
    """Id of the photograph by whose pose ranges would be replaced."""
    show: SmoothingShow
    """What the 3-D view shows of it."""
    rev: str
    """Changes with the ranges, the pose, and what it would replace."""


@dataclass(slots=True, eq=False)
class Client:
    """A person at an open page; the same one when the page reconnects or is reloaded."""

    id: str
    """Random and URL-safe; stable for a browser tab."""
    name: str
    """Display name, which is also the author of the edits."""
    address: str
    """Network address."""
    color: int = 1
    """Number of the colour that others see, from 1 to `COLOURS`."""
    photo: str | None = None
    """Id of the photograph that this person sees."""
    model: ModelChoice = field(default_factory=ModelChoice)
    """Display of the model in this person's 3-D view."""
    smoothing: SmoothingChoice | None = None
    """The preview of smoothed ranges that this person looks at."""
    follows: str | None = None
    """Id of the client whose view this person follows."""
    read_only: bool = False
    """True if this client is read-only."""

    @property
    def author(self) -> Author:
        """The author of this person's edits."""
        return Author(self.name, self.id)


@dataclass(slots=True)
class _Seat:
    client: Client
    page: str
    connections: int


class Clients:
    """The clients that are connected now.

    Args:
        on_change: called after a client has joined, left or changed its name.
    """

    def __init__(self, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self._changed = threading.Condition()
        self._seats: dict[str, _Seat] = {}
        self._known: OrderedDict[str, Client] = OrderedDict()
        self._joined = 0
        self.read_only_token = ""
        """The token of the read-only link; empty if there is none."""

    def listen(self, on_change: Callable[[], None]) -> None:
        """Call another function after changes from now on."""
        self._on_change = on_change

    @property
    def present(self) -> list[Client]:
        """All clients, in the order in which they joined."""
        with self._changed:
            return [seat.client for seat in self._seats.values()]

    def is_alone(self, client: Client) -> bool:
        """Return whether nobody else is connected who may edit."""
        return all(other is client or other.read_only for other in self.present)

    def find(self, client_id: object) -> Client | None:
        """Return the connected client of an id; None if there is none."""
        with self._changed:
            seat = self._seats.get(client_id) if isinstance(client_id, str) else None
            return seat.client if seat else None

    def join(self, visitor: Visitor) -> Client:
        """Connect a page.

        A page that reconnects takes its former place, even before its broken connection is noticed. A tab that a
        browser has copied presents the same secret while the original is open: it becomes a client of its own.

        Raises:
            OptionError: if there are too many.
        """
        with self._changed:
            client_id = _id_of(visitor.tab)
            seat = self._seats.get(client_id)
            if seat is not None and seat.page != visitor.page:
                left = self._changed.wait_for(lambda: client_id not in self._seats, _RELOAD_S)
                client_id = client_id if left else _id_of(f"{visitor.tab} {visitor.page}")
                seat = self._seats.get(client_id)
            if seat is None:
                self._check_room(read_only=visitor.read_only)
                seat = self._seats[client_id] = _Seat(self._returning(client_id, visitor), visitor.page, 0)
            seat.connections += 1
            client = seat.client
            client.address, client.read_only = visitor.address, visitor.read_only
        self._on_change()
        return client

    def leave(self, client: Client) -> None:
        """End a connection of a client."""
        with self._changed:
            seat = self._seats.get(client.id)
            if seat is not None and seat.client is client:
                seat.connections -= 1
                if seat.connections == 0:
                    del self._seats[client.id]
                    self._remember(client)
                    self._changed.notify_all()
        self._on_change()

    def rename(self, client: Client, name: str) -> None:
        """Change a client's name; a name that another client has gets a number."""
        with self._changed:
            client.name = self._free_name(name, client)
        self._on_change()

    def follow(self, client: Client, client_id: object) -> None:
        """Let a client see what another one sees; None: what it selects itself.

        Raises:
            OptionError: if the other one is not connected, or follows this one.
        """
        leader = self.find(client_id)
        if client_id is not None and (leader is None or leader is client):
            raise OptionError("this person is not connected any more; choose another")
        chain = leader
        for _ in range(MAX_CLIENTS):
            chain = self.find(chain.follows) if chain else None
            if chain is client and leader is not None:
                raise OptionError(f"{leader.name} follows you already; one of the two has to lead")
        client.follows = leader.id if leader else None
        self._on_change()

    def leader_of(self, client: Client) -> Client:
        """Return the client whose view a client sees: the end of the chain of those who follow."""
        leader = client
        for _ in range(MAX_CLIENTS):
            followed = self.find(leader.follows) if leader.follows else None
            if followed is None or followed is client:
                break
            leader = followed
        return leader

    def slice(self, client: Client, photo_of: Callable[[Client], str | None]) -> People:
        """Return the slice `people` of a client; `photo_of` returns the photograph that each sees."""
        people = self.present
        return {
            "count": len(people),
            "you": client.id,
            "clients": [
                {
                    "id": each.id,
                    "name": each.name,
                    "colour": each.color,
                    "photo": photo_of(each),
                    "follows": each.follows,
                    "read_only": each.read_only,
                }
                for each in people
            ],
        }

    def _check_room(self, *, read_only: bool) -> None:
        readers = sum(seat.client.read_only for seat in self._seats.values())
        if _LIMIT.is_free(taken=len(self._seats), by_readers=readers, read_only=read_only):
            return
        if read_only and len(self._seats) < MAX_CLIENTS:
            raise OptionError(f"{readers} read-only pages are open, which is the maximum; close one to open this one")
        raise OptionError(f"{MAX_CLIENTS} pages are open, which is the maximum; close one to open this one")

    def _returning(self, client_id: str, visitor: Visitor) -> Client:
        """Return the client of an id, new or as it left."""
        client = self._known.pop(client_id, None)
        if client is None:
            self._joined += 1
            client = Client(client_id, f"Operator {self._joined}", visitor.address, photo=visitor.photo or None)
            name = visitor.name and valid_name(visitor.name)
            client.name = name or client.name
        client.name = self._free_name(client.name, client)
        used = Counter(seat.client.color for seat in self._seats.values())
        client.color = min(range(1, COLORS + 1), key=lambda color: (used[color], color != client.color))
        return client

    def _free_name(self, name: str, client: Client) -> str:
        taken = {seat.client.name for seat in self._seats.values() if seat.client is not client}
        free, number = name, 1
        while free in taken:
            number += 1
            free = f"{name} ({number})"
        return free

    def _remember(self, client: Client) -> None:
        self._known[client.id] = client
        while len(self._known) > _REMEMBERED:
            self._known.popitem(last=False)


def valid_name(text: str) -> str:
    """Return a name without line breaks and invisible characters, of limited length; empty if nothing is left."""
    return "".join(character for character in " ".join(text.split()) if character.isprintable())[:_MAX_NAME].strip()


def _id_of(tab: str) -> str:
    """Return the public id of a tab's secret, the same after a restart; a random one if the page has none."""
    if not tab:
        return secrets.token_urlsafe(_ID_BYTES)
    digest = hashlib.blake2b(tab.encode(), digest_size=_ID_BYTES, person=b"ladarreg client")
    return base64.urlsafe_b64encode(digest.digest()).decode()
