"""JSON as browsers read it: not-a-number is null."""

from __future__ import annotations

from typing import Any

import msgspec


class NotJson(ValueError):  # noqa: N818 - it is what the text is
    """A text that is no JSON object."""


def encode(message: Any) -> str:
    """Return the text of a message; arrays of any library become lists.

    Raises:
        TypeError: if it holds what JSON cannot.
    """
    return msgspec.json.encode(message, enc_hook=_plain).decode()


def encode_part(value: Any) -> msgspec.Raw:
    """Return a part of messages, encoded; `encode` takes it in as it is.

    Raises:
        TypeError: if it holds what JSON cannot.
    """
    return msgspec.Raw(msgspec.json.encode(value, enc_hook=_plain))


def decode_object(text: str) -> dict[str, Any]:
    """Return what a text holds.

    Raises:
        NotJson: if it is no JSON object.
    """
    try:
        message = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError, UnicodeError) as error:
        raise NotJson(str(error)) from None
    if not isinstance(message, dict):
        raise NotJson("it is no object")
    return message


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be sent to a page")
