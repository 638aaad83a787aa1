"""Lists made thing by thing, where most things are the same objects as the last time."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Generic, TypeVar

from .bounded_cache import BoundedCache, rough_bytes

_MOST_LISTS = 256
_MOST_BYTES = 200_000_000
T = TypeVar("T")
S = TypeVar("S")


class EachOnce(Generic[T, S]):
    """Remembers, list by list, what was made of each thing; safe to be asked by several threads.

    Args:
        make: makes one of a thing that never changes.
    """

    def __init__(self, make: Callable[[T], S]) -> None:
        self._make = make
        self._lists: BoundedCache[tuple[Sequence[T], list[S]]] = BoundedCache(
            _MOST_LISTS, _MOST_BYTES, lambda held: rough_bytes(held[1])
        )

    def of(self, name: Hashable, things: Sequence[T]) -> list[S]:
        """Return what is made of each thing; what is the same as in the last list of this name is not made again.

        The list is the same object for the same sequence, and must not be changed.
        """
        before, made = self._lists.get(name) or ((), [])
        if before is things:
            return made
        first = _same(before, things)
        last = min(_same(before[::-1], things[::-1]), min(len(before), len(things)) - first)
        old, new = slice(first, len(before) - last), slice(first, len(things) - last)
        known = {id(thing): one for thing, one in zip(before[old], made[old], strict=True)}
        between = [known[id(thing)] if id(thing) in known else self._make(thing) for thing in things[new]]
        result = [*made[:first], *between, *made[old.stop :]]
        self._lists.put(name, (things, result))
        return result


def _same(a: Sequence[object], b: Sequence[object]) -> int:
    """Return how many things at the start are the same: seldom more than one in a list has changed."""
    return next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x is not y), min(len(a), len(b)))
