"""The clients: open pages with their names."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from ladarreg_core.errors import OptionError

MAX_CLIENTS = 64


@dataclass(slots=True, eq=False)
class Client:
    """An open page."""

    name: str
    """Its display name, which is also the author of its edits."""
    address: str
    """Its network address."""


class Clients:
    """The clients that are connected now.

    Args:
        on_change: called after a client has joined, left or changed its name.
    """

    def __init__(self, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self._lock = threading.Lock()
        self._clients: list[Client] = []
        self._joined = 0

    @property
    def names(self) -> list[str]:
        """The names of all clients, in the order in which they joined."""
        with self._lock:
            return [client.name for client in self._clients]

    def join(self, address: str) -> Client:
        """Connect a client.

        Raises:
            OptionError: if there are too many.
        """
        with self._lock:
            if len(self._clients) >= MAX_CLIENTS:
                raise OptionError(f"{MAX_CLIENTS} pages are open, which is the maximum; close one to open this one")
            self._joined += 1
            client = Client(f"Operator {self._joined}", address)
            self._clients.append(client)
        self._on_change()
        return client

    def leave(self, client: Client) -> None:
        """Disconnect a client."""
        with self._lock:
            if client in self._clients:
                self._clients.remove(client)
        self._on_change()

    def rename(self, client: Client, name: str) -> None:
        """Change a client's name; a name that another client has gets a number."""
        with self._lock:
            taken = {other.name for other in self._clients if other is not client}
            client.name = name if name not in taken else f"{name} ({sum(n.startswith(name) for n in taken) + 1})"
        self._on_change()
