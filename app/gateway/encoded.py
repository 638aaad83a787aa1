"""What many pages are told, encoded once for all of them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import msgspec

from app.gateway.changes import change_between
from app.gateway.json_text import encode_part

_KEPT = 64


class Encoded:
    """Slices and their changes as JSON, kept for the pages that are told the same; of one thread."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[int, int], tuple[Any, Any, msgspec.Raw | None]] = OrderedDict()

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
        if key not in self._kept:
            self._kept[key] = before, after, make()  # both are kept, so that their ids cannot come to mean others
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key][2]
