"""Lists made thing by thing, where most things are the same objects as the last time."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Generic, TypeVar

T = TypeVar("T")
S = TypeVar("S")


class EachOnce(Generic[T, S]):
    """Remembers, list by list, what was made of each thing; safe to be asked by several threads.

    Args:
        make: makes one of a thing that never changes.
    """

    def __init__(self, make: Callable[[T], S]) -> None:
        self._make = make
        self._lists: dict[Hashable, tuple[Sequence[T], list[S]]] = {}

    def of(self, name: Hashable, things: Sequence[T]) -> list[S]:
        """Return what is made of each thing; what is the same as in the last list of this name is not made again.

        The list is the same object for the same sequence, and must not be changed.
        """
        before, made = self._lists.get(name, ((), []))
        if before is things:
            return made
        known = {id(thing): one for thing, one in zip(before, made, strict=True)}
        found = [known[id(thing)] if id(thing) in known else self._make(thing) for thing in things]
        self._lists[name] = things, found
        return found
