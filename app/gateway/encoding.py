"""What many pages are told, encoded once for all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from ..session.cache import BoundedCache, rough_bytes
from .delta import change_between
from .json_text import encode_part

_KEPT = 64
_KEPT_BYTES = 100_000_000


class Encoded:
    """Slices and their changes as JSON, kept for the pages that are told the same; of one thread."""

    def __init__(self) -> None:
        self._kept: BoundedCache[tuple[Any, Any, msgspec.Raw | None]] = BoundedCache(_KEPT, _KEPT_BYTES, _bytes_of)

    def slice(self, value: Any) -> msgspec.Raw:
        """Return a slice, whole."""
        found = self._once(None, value, lambda: encode_part(value))
        assert found is not None
        return found

    def change(self, before: Any, after: Any) -> msgspec.Raw | None:
        """Return what makes one slice of another; None where the whole is as short."""

        def make() -> msgspec.Raw | None:
            change = change_between(before, after)
            return None if change is None else encode_part(change)

        return self._once(before, after, make)

    def _once(self, before: Any, after: Any, make: Callable[[], msgspec.Raw | None]) -> msgspec.Raw | None:
        key = (id(before), id(after))
        held = self._kept.get(key)
        if held is None:
            held = before, after, make()  # both are kept, so that their ids cannot come to mean others
            self._kept.put(key, held)
        return held[2]


def _bytes_of(held: tuple[Any, Any, msgspec.Raw | None]) -> int:
    before, after, text = held
    return rough_bytes(before) + rough_bytes(after) + (0 if text is None else len(memoryview(text)))
