"""Tells every page what has changed: quick slices at once, slow ones as soon as they are computed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

from ..session.bounded_cache import BoundedCache, rough_bytes
from ..session.debounce import Quiet

log = logging.getLogger(__name__)
Message = dict[str, Any]
Slices = Callable[[], dict[str, Any]]
T = TypeVar("T")
_KEPT = 256
_KEPT_BYTES = 200_000_000


class Teller:
    """Compares slices with what was told last, and tells the difference.

    Args:
        quick: returns what is told at once.
        slow: returns what takes time to compute.
        last: what is done after that, as long as nobody edits.
    """

    def __init__(self, quick: Slices, slow: Slices, last: Callable[[], None]) -> None:
        self._quick, self._slow, self._last = quick, slow, last
        self._lock = threading.RLock()
        self._told: dict[str, Any] = {}
        self._version = 0
        self._listeners: list[Callable[[Message], None]] = []
        self._once: BoundedCache[tuple[Any, Any]] = BoundedCache(_KEPT, _KEPT_BYTES, lambda held: rough_bytes(held[1]))
        self._quiet = Quiet()
        self._thread = threading.Thread(target=self._work, name="teller", daemon=True)
        self._thread.start()

    def subscribe(self, listener: Callable[[Message], None]) -> Callable[[], None]:
        """Have a listener told every message; return what ends that."""
        with self._lock:
            self._listeners.append(listener)

        def off() -> None:
            with self._lock:
                if listener in self._listeners:
                    self._listeners.remove(listener)

        return off

    def once(self, key: Any, make: Callable[[], T]) -> T:
        """Return what was made of the same object before, or make it: equal slices stay the same object."""
        name = tuple(map(_name, key)) if isinstance(key, tuple) else _name(key)
        held = self._once.get(name)
        if held is None:
            held = key, make()  # the key is kept, so that its id cannot come to mean another object
            self._once.put(name, held)
        return held[1]

    def all_slices(self) -> dict[str, Any]:
        """Return everything that was told."""
        with self._lock:
            self.tell()
            return dict(self._told)

    def tell(self, *, slow: bool = False) -> None:
        """Tell what has changed; with `slow`, what takes time to compute follows.

        Never raises: whoever joins or edits must not be stopped by what cannot be shown.
        """
        with self._lock:
            try:
                self._tell_difference(self._quick(), slow=False)
            except Exception:
                log.exception("slices could not be computed")
        if slow:
            self._quiet.ask()

    def tell_event(self, event: Message) -> None:
        """Tell something that passes by."""
        with self._lock:
            listeners = list(self._listeners)
        _send(listeners, event)

    def close(self) -> None:
        """End the thread."""
        self._quiet.close()
        self._thread.join(30)

    def _tell_difference(self, slices: dict[str, Any], *, slow: bool) -> None:
        mine = {name for name in self._told if _is_slow(name) == slow}
        changed = {
            name: value
            for name, value in slices.items()
            if name not in self._told or (self._told[name] is not value and self._told[name] != value)
        }
        gone = {name for name in mine if name not in slices}
        self._told.update(changed)
        for name in gone:
            del self._told[name]
        if changed or gone:
            self._version += 1
            message = {"slices": {**changed, **dict.fromkeys(gone)}, "version": self._version}
            _send(list(self._listeners), message)

    def _work(self) -> None:
        while self._quiet.wait():
            try:
                found = self._slow()
                if self._quiet.asked:
                    continue  # the document has changed meanwhile
                with self._lock:
                    self._tell_difference(found, slow=True)
                self._last()
            except Exception:
                log.exception("slices could not be computed")


def _send(listeners: list[Callable[[Message], None]], message: Message) -> None:
    for listener in listeners:
        try:
            listener(message)
        except Exception:
            log.exception("a listener failed at %s", message.get("event", "slices"))


def _is_slow(name: str) -> bool:
    return name.startswith("judged:")


def _name(key: Any) -> Hashable:
    return key if isinstance(key, int | str | bytes | type(None)) else ("object", id(key))
