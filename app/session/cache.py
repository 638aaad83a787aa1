"""Caches bounded by number and by bytes: the least recently used value is dropped first."""

from __future__ import annotations

import dataclasses
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from itertools import count
from typing import Any, Generic, TypeVar

T = TypeVar("T")
S = TypeVar("S")
_JSON_ENTRIES = 4096
_JSON_BYTES = 200_000_000
_GROWING_BELOW = 100


class BoundedCache(Generic[T]):
    """A least-recently-used cache, safe for several threads; the newest value stays whatever its size.

    Args:
        max_count: the largest number of values.
        max_bytes: the largest total size.
        size_of: returns the size of a value, bytes.
        values_grow: whether values compute and keep more later; all are then measured again at each `put`.
        clock: returns rising numbers; caches that share one can be compared by `oldest_use`.
    """

    def __init__(
        self,
        max_count: int,
        max_bytes: int,
        size_of: Callable[[T], int],
        *,
        values_grow: bool = False,
        clock: Callable[[], int] | None = None,
    ) -> None:
        self._max_count, self._max_bytes, self._size_of, self._values_grow = max_count, max_bytes, size_of, values_grow
        self._entries: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()
        self._used_at: dict[Hashable, int] = {}
        self._total = 0  # kept, since adding up thousands of sizes with every value would take longer than making it
        self._clock = clock or count().__next__
        self._lock = threading.Lock()
        self.changes = 0
        """How often values have come or gone."""

    def __contains__(self, key: Hashable) -> bool:
        return key in self._entries

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def bytes(self) -> int:
        """Total size of the values when they were last measured."""
        with self._lock:
            return self._total

    def get(self, key: Hashable) -> T | None:
        """Return the value of a key, or None."""
        with self._lock:
            if key not in self._entries:
                return None
            self._entries.move_to_end(key)
            self._used_at[key] = self._clock()
            return self._entries[key][0]

    def put(self, key: Hashable, value: T) -> list[tuple[Hashable, T]]:
        """Store a value; drop the least recently used ones that exceed the limits, and return them with their keys."""
        with self._lock:
            self.changes += 1
            if self._values_grow:
                for name, (one, _) in self._entries.items():
                    self._keep(name, one)
            self._keep(key, value)
            self._entries.move_to_end(key)
            self._used_at[key] = self._clock()
            dropped = []
            while len(self._entries) > 1 and (len(self._entries) > self._max_count or self._total > self._max_bytes):
                oldest = next(iter(self._entries))
                dropped.append((oldest, self._entries[oldest][0]))
                self._drop(oldest)
            return dropped

    def drop_where(self, is_concerned: Callable[[Hashable], bool]) -> None:
        """Drop the values of some keys."""
        with self._lock:
            for key in [key for key in self._entries if is_concerned(key)]:
                self._drop(key)

    def clear(self) -> None:
        """Drop everything."""
        with self._lock:
            self.changes += 1
            self._entries.clear()
            self._used_at.clear()
            self._total = 0

    @property
    def oldest_use(self) -> int | None:
        """When the least recently used value was used last, by the clock; None if there is no value."""
        with self._lock:
            return self._used_at[next(iter(self._entries))] if self._entries else None

    def drop_oldest(self) -> int:
        """Drop the least recently used value, if there is one, and return its size."""
        with self._lock:
            return self._drop(next(iter(self._entries))) if self._entries else 0

    def _keep(self, key: Hashable, value: T) -> None:
        _, before = self._entries.get(key, (None, 0))
        self._entries[key] = value, self._size_of(value)
        self._total += self._entries[key][1] - before

    def _drop(self, key: Hashable) -> int:
        self.changes += 1
        _, size = self._entries.pop(key)
        del self._used_at[key]
        self._total -= size
        return size


class GroupedCache:
    """Named groups of arrays, each with its own limits and lock: only callers of the same group wait for each other.

    Args:
        limits: the largest number of values and the largest total size, bytes, of each group.
        derived: for a group, the groups of what is made of its values: when a value is dropped, so are those whose
            keys contain its key or its id.
        max_bytes: the largest total size of all groups besides the newest value; None: only the groups' own limits.
        uncounted: groups that do not count.
    """

    def __init__(
        self,
        limits: Mapping[str, tuple[int, int]],
        *,
        derived: Mapping[str, Sequence[str]] | None = None,
        max_bytes: int | None = None,
        uncounted: Sequence[str] = (),
    ) -> None:
        clock = count().__next__
        self._groups: dict[str, BoundedCache[tuple[Any]]] = {
            name: BoundedCache(
                most, size, lambda entry: array_bytes(entry[0]), values_grow=most < _GROWING_BELOW, clock=clock
            )
            for name, (most, size) in limits.items()
        }
        self._counted = [group for name, group in self._groups.items() if name not in uncounted]
        self._max_bytes, self._total_lock = max_bytes, threading.Lock()
        self._derived = dict(derived or {})
        self._locks = {name: threading.RLock() for name in limits}

    def __getitem__(self, group: str) -> BoundedCache[tuple[Any]]:
        """Return a group; each value is wrapped in a tuple, as it may be None."""
        return self._groups[group]

    def get(self, group: str, key: Hashable, make: Callable[[], T]) -> T:
        """Return the value of a key in a group; make it first where it is missing."""
        with self._locks[group]:
            entry = self._groups[group].get(key)
            if entry is None:
                entry = (make(),)
                dropped = self._groups[group].put(key, entry)
                gone = [part for name, (value,) in dropped for part in (name, id(value))]
                for name in self._derived.get(group, ()) if gone else ():
                    self._groups[name].drop_where(lambda of: any(_contains(of, part) for part in gone))
                self._shrink()
            return entry[0]

    @property
    def bytes(self) -> int:
        """Total size of the values that count, when they were last measured."""
        return sum(group.bytes for group in self._counted)

    def _shrink(self) -> None:
        """Drop the least recently used values of all groups until the rest fits; the newest one stays."""
        if self._max_bytes is None:
            return
        with self._total_lock:
            total = self.bytes
            while total > self._max_bytes:
                ages = [(age, group) for group in self._counted if (age := group.oldest_use) is not None]
                if sum(len(group) for group in self._counted) <= 1:
                    break
                total -= min(ages, key=lambda each: each[0])[1].drop_oldest()


class IdentityCache:
    """JSON values by the identity of the objects that they were made of; those objects must not change."""

    def __init__(self) -> None:
        self._entries: BoundedCache[tuple[Any, Any]] = BoundedCache(
            _JSON_ENTRIES, _JSON_BYTES, lambda entry: rough_bytes(entry[1])
        )

    def get(self, sources: Any, make: Callable[[], T]) -> T:
        """Return the value made of the same source, or of the same tuple of sources; make it where it is missing."""
        key = tuple(map(_identity, sources)) if isinstance(sources, tuple) else _identity(sources)
        entry = self._entries.get(key)
        if entry is None:
            entry = sources, make()  # keeping the sources keeps their ids from being reused
            self._entries.put(key, entry)
        return entry[1]


class ListCache(Generic[T, S]):
    """Lists converted item by item, where most items are the same objects as the last time; safe for several threads.

    Args:
        convert: converts one item, which never changes.
    """

    def __init__(self, convert: Callable[[T], S]) -> None:
        self._convert = convert
        self._lists: BoundedCache[tuple[Sequence[T], list[S]]] = BoundedCache(
            _JSON_ENTRIES, _JSON_BYTES, lambda entry: rough_bytes(entry[1])
        )

    def get(self, name: Hashable, items: Sequence[T]) -> list[S]:
        """Return the converted items; items of the last list of this name are not converted again.

        The list is the same object for the same sequence, and must not be changed.
        """
        before, converted = self._lists.get(name) or ((), [])
        if before is items:
            return converted
        first = _common_start(before, items)
        last = min(_common_start(before[::-1], items[::-1]), min(len(before), len(items)) - first)
        old, new = slice(first, len(before) - last), slice(first, len(items) - last)
        known = {id(item): one for item, one in zip(before[old], converted[old], strict=True)}
        between = [known[id(item)] if id(item) in known else self._convert(item) for item in items[new]]
        result = [*converted[:first], *between, *converted[old.stop :]]
        self._lists.put(name, (items, result))
        return result


def array_bytes(value: object) -> int:
    """Return the size of the arrays and byte strings that an object holds, each counted once.

    Scans and photographs inside it are not counted: they have caches of their own.
    """
    from ladarreg_core.photo import Photo
    from ladarreg_core.scan import Scan

    seen: set[int] = set()

    def size_of(one: Any, *, inner: bool) -> int:
        if id(one) in seen or (inner and isinstance(one, Scan | Photo)):
            return 0
        seen.add(id(one))
        if isinstance(one, bytes):
            return len(one)
        if hasattr(one, "nbytes") and hasattr(one, "base"):
            shared = hasattr(one.base, "nbytes") or isinstance(one.base, bytes)
            return size_of(one.base, inner=True) if shared else int(one.nbytes)
        if isinstance(one, Mapping):
            parts: Any = one.values()
        elif isinstance(one, tuple | list):
            parts = one
        else:
            parts = list(getattr(one, "__dict__", {}).values())
            if dataclasses.is_dataclass(one):
                parts += [getattr(one, field.name, None) for field in dataclasses.fields(one)]
        return sum(size_of(part, inner=True) for part in parts)

    if isinstance(value, tuple):  # (object that the key identifies, value made of it)
        value = value[-1]
    return size_of(value, inner=False)


def rough_bytes(value: object) -> int:
    """Return the approximate size of a JSON value; of a list only the first and the last item are measured."""
    size = sys.getsizeof(value)
    if type(value) in (str, float, int):  # nearly all values are: what follows takes longer
        return size
    if isinstance(value, Mapping):
        return size + sum(map(rough_bytes, value.values()))
    if isinstance(value, list | tuple) and value:
        return size + len(value) * max(rough_bytes(value[0]), rough_bytes(value[-1]))
    return size


def _contains(key: Hashable, part: Hashable) -> bool:
    """Return whether a key is something or, as a tuple, contains it."""
    return key == part or (isinstance(key, tuple) and any(_contains(each, part) for each in key))


def _common_start(a: Sequence[object], b: Sequence[object]) -> int:
    """Return how many items at the start are the same objects; usually a single item of a list differs."""
    return next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x is not y), min(len(a), len(b)))


def _identity(source: Any) -> Hashable:
    return source if isinstance(source, int | str | bytes | type(None)) else ("object", id(source))
