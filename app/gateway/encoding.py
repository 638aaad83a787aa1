"""JSON encoding of the messages to the pages; what all pages are sent is encoded once and shared."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from ..session.cache import BoundedCache, rough_bytes
from .delta import change_between

_MAX_CACHED = 64
_MAX_CACHED_BYTES = 100_000_000


class InvalidMessageError(ValueError):
    """A text that is not a JSON object."""


class SharedEncoder:
    """Slices and their changes as JSON, cached for the clients that are sent the same; for use by one thread."""

    def __init__(self) -> None:
        self._cache: BoundedCache[tuple[Any, Any, msgspec.Raw | None]] = BoundedCache(
            _MAX_CACHED, _MAX_CACHED_BYTES, _entry_bytes
        )

    def slice(self, value: Any) -> msgspec.Raw:
        """Return a whole slice, encoded."""
        found = self._cached(None, value, lambda: encode_part(value))
        assert found is not None
        return found

    def change(self, before: Any, after: Any) -> msgspec.Raw | None:
        """Return the encoded change between two values of a slice; None if it is no shorter than the whole slice."""

        def make() -> msgspec.Raw | None:
            change = change_between(before, after)
            return None if change is None else encode_part(change)

        return self._cached(before, after, make)

    def _cached(self, before: Any, after: Any, make: Callable[[], msgspec.Raw | None]) -> msgspec.Raw | None:
        key = (id(before), id(after))
        entry = self._cache.get(key)
        if entry is None:
            entry = before, after, make()  # keeps both values alive, so that their ids remain unique
            self._cache.put(key, entry)
        return entry[2]


def encode(message: Any) -> str:
    """Return the JSON text of a message; arrays of any library become lists, non-finite numbers null.

    Raises:
        TypeError: if it contains a value that JSON cannot represent.
    """
    return msgspec.json.encode(message, enc_hook=_as_list).decode()


def encode_part(value: Any) -> msgspec.Raw:
    """Return part of a message, encoded; `encode` inserts it unchanged.

    Raises:
        TypeError: if it contains a value that JSON cannot represent.
    """
    return msgspec.Raw(msgspec.json.encode(value, enc_hook=_as_list))


def joined(first: str, second: str) -> str:
    """Return one object with the fields of two, given and returned as JSON texts; neither is empty."""
    return f"{first[:-1]},{second[1:]}"


def decode_object(text: str) -> dict[str, Any]:
    """Return the JSON object that a text represents.

    Raises:
        InvalidMessageError: if it is not a JSON object.
    """
    try:
        message = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError, UnicodeError) as error:
        raise InvalidMessageError(str(error)) from None
    if not isinstance(message, dict):
        raise InvalidMessageError("the message is not an object")
    return message


def _entry_bytes(entry: tuple[Any, Any, msgspec.Raw | None]) -> int:
    before, after, text = entry
    return rough_bytes(before) + rough_bytes(after) + (0 if text is None else len(memoryview(text)))


def _as_list(value: Any) -> Any:
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be encoded as JSON")
