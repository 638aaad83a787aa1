"""The publisher: sends changed slices of the state to the clients."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ...session.debounce import Debouncer

if TYPE_CHECKING:
    from ...slices.events import Event

log = logging.getLogger(__name__)
Message = Mapping[str, Any]
Slices = Callable[[], dict[str, Any]]
Listener = Callable[[Message], None]


@dataclass(slots=True, eq=False)
class _Subscriber:
    listener: Listener
    client: str
    own: Slices
    published: dict[str, Any]


class Publisher:
    """Compares slices with those published last, and sends the difference.

    Args:
        quick: returns the slices that are published at once.
        slow: returns the slices that take time to compute, `measured` and those whose names begin with `judged:`.
        afterwards: called after the slow slices were published, unless there was another edit.
    """

    def __init__(self, quick: Slices, slow: Slices, afterwards: Callable[[], None]) -> None:
        self._quick, self._slow, self._afterwards = quick, slow, afterwards
        self._lock = threading.RLock()
        self._published: dict[bool, dict[str, Any]] = {False: {}, True: {}}
        """By whether they are slow."""
        self._version = 0
        self._subscribers: list[_Subscriber] = []
        self._debouncer = Debouncer()
        self._thread = threading.Thread(target=self._work, name="publisher", daemon=True)
        self._thread.start()

    def subscribe(self, listener: Listener, client: str, own: Slices) -> Callable[[], None]:
        """Send every message to a listener; return a function that ends the subscription.

        Args:
            listener: receives the messages of one client.
            client: its id.
            own: returns the slices that differ between the clients, as this one sees them.
        """
        with self._lock:
            subscriber = _Subscriber(listener, client, own, own())
            self._subscribers.append(subscriber)

        def unsubscribe() -> None:
            with self._lock:
                if subscriber in self._subscribers:
                    self._subscribers.remove(subscriber)

        return unsubscribe

    def all_slices(self) -> dict[str, Any]:
        """Return all slices that the clients share."""
        with self._lock:
            self.publish()
            return self._published[False] | self._published[True]

    def publish(self, *, slow: bool = False) -> None:
        """Publish changes; with `slow`, the slow slices follow.

        Never raises: a slice that cannot be computed must not fail an edit or keep a client from joining.
        """
        with self._lock:
            try:
                self._publish_difference(self._quick(), slow=False)
            except Exception:
                log.exception("slices could not be computed")
        if slow:
            self._debouncer.request()

    def publish_event(self, event: Event, *, to: Container[str] | None = None) -> None:
        """Send an event, which is not part of the state, to all clients or to some by their ids."""
        with self._lock:
            subscribers = [each for each in self._subscribers if to is None or each.client in to]
        for subscriber in subscribers:
            _send(subscriber.listener, event)

    def close(self) -> None:
        """End the thread."""
        self._debouncer.close()
        self._thread.join(30)

    def _publish_difference(self, slices: dict[str, Any], *, slow: bool) -> None:
        published = self._published[slow]
        changed = {
            name: value
            for name, value in slices.items()
            if name not in published or (published[name] is not value and published[name] != value)
        }
        gone = [name for name in published if name not in slices]
        published.update(changed)
        for name in gone:
            del published[name]
        self._version += bool(changed or gone)
        shared = {**changed, **dict.fromkeys(gone)}
        subscribers = list(self._subscribers)
        differences = [shared if slow else {**shared, **_own_difference(each)} for each in subscribers]
        # All at once, so that what sends them to the pages is woken once.
        for subscriber, slices in zip(subscribers, differences, strict=True):
            if slices:
                _send(subscriber.listener, {"slices": slices, "version": self._version})

    def _work(self) -> None:
        while self._debouncer.wait():
            try:
                found = self._slow()
                if self._debouncer.requested:
                    continue  # the document has changed meanwhile
                with self._lock:
                    self._publish_difference(found, slow=True)
                self._afterwards()
            except Exception:
                log.exception("slices could not be computed")


def _own_difference(subscriber: _Subscriber) -> dict[str, Any]:
    before, own = subscriber.published, subscriber.own()
    subscriber.published = own
    return {name: value for name, value in own.items() if before[name] is not value and before[name] != value}


def _send(listener: Listener, message: Message) -> None:
    try:
        listener(message)
    except Exception:
        log.exception("a listener failed at %s", message.get("event", "slices"))
