"""Caches bounded by number and by bytes: what was used longest ago is forgotten first."""

from __future__ import annotations

import dataclasses
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class BoundedCache(Generic[T]):
    """Keeps what was put into it last; the newest is kept whatever its size. Safe to be used by several threads.

    Args:
        most: how many are kept.
        most_bytes: how much they may hold together.
        size_of: returns the bytes of one.
        they_grow: whether things compute and keep more in themselves later, and are measured again.
    """

    def __init__(self, most: int, most_bytes: int, size_of: Callable[[T], int], *, they_grow: bool = False) -> None:
        self._most, self._most_bytes, self._size_of, self._they_grow = most, most_bytes, size_of, they_grow
        self._kept: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()
        self._lock = threading.Lock()

    def __contains__(self, key: Hashable) -> bool:
        return key in self._kept

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def bytes(self) -> int:
        """What is held, as far as it was measured."""
        with self._lock:
            return sum(size for _, size in self._kept.values())

    def get(self, key: Hashable) -> T | None:
        """Return what was kept under a key, or None."""
        with self._lock:
            if key not in self._kept:
                return None
            self._kept.move_to_end(key)
            return self._kept[key][0]

    def put(self, key: Hashable, value: T) -> None:
        """Keep something under a key; what was used longest ago goes where there is too much."""
        with self._lock:
            if self._they_grow:
                for name, (one, _) in self._kept.items():
                    self._kept[name] = one, self._size_of(one)
            self._kept[key] = value, self._size_of(value)
            self._kept.move_to_end(key)
            total = sum(size for _, size in self._kept.values())
            while len(self._kept) > 1 and (len(self._kept) > self._most or total > self._most_bytes):
                total -= self._kept.popitem(last=False)[1][1]

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._kept.clear()


def array_bytes(thing: object) -> int:
    """Return the bytes of the arrays and byte strings that a thing holds, each counted once.

    Scans, photographs and views inside it are not counted: they are kept elsewhere.
    """
    from ladarreg_core.inspection.pictures import NamedView
    from ladarreg_core.photo import Photo
    from ladarreg_core.scan import Scan
    from ladarreg_core.surface.perspective import View

    seen: set[int] = set()

    def count(one: Any, *, inner: bool) -> int:
        if id(one) in seen or (inner and isinstance(one, Scan | Photo | View | NamedView)):
            return 0
        seen.add(id(one))
        if isinstance(one, bytes):
            return len(one)
        if hasattr(one, "nbytes") and hasattr(one, "base"):
            shared = hasattr(one.base, "nbytes") or isinstance(one.base, bytes)
            return count(one.base, inner=True) if shared else int(one.nbytes)
        if isinstance(one, Mapping):
            parts: Any = one.values()
        elif isinstance(one, tuple | list):
            parts = one
        else:
            parts = list(getattr(one, "__dict__", {}).values())
            if dataclasses.is_dataclass(one):
                parts += [getattr(one, field.name, None) for field in dataclasses.fields(one)]
        return sum(count(part, inner=True) for part in parts)

    if isinstance(thing, tuple):  # (what its key stands for, what was made of it)
        thing = thing[-1]
    return count(thing, inner=False)


def rough_bytes(value: object) -> int:
    """Return about how many bytes a value made for JSON takes; of a list only the first and the last are looked at."""
    size = sys.getsizeof(value)
    if isinstance(value, Mapping):
        return size + sum(rough_bytes(part) for part in value.values())
    if isinstance(value, list | tuple) and value:
        return size + len(value) * max(rough_bytes(value[0]), rough_bytes(value[-1]))
    return size
