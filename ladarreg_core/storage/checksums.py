"""Checksum of a JSON result: SHA-256 of its canonical form without the field itself, so that reformatting is no change.

Source: RFC 8785, JSON Canonicalization Scheme: no white space, names in the order of their UTF-16 code units, numbers
as ECMAScript writes a double.

A report, which is HTML, has the SHA-256 of its bytes in its last line.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

CHECKSUM_FIELD = "sha256"
"""The field of a result with its own checksum."""
ChecksumState = Literal["intact", "edited", "no checksum"]
"""`no checksum`: as written by older versions of the program."""
_EXACT = 2**53  # integers beyond are doubles in other programs, which read the same file
_MAX_DIGITS = 21
_SEAL = b"<!-- ladarreg report, SHA-256 of all above %s -->\n"
_BLOCK_BYTES = 1 << 20


def canonical(value: Any) -> bytes:
    """Return the canonical form of plain JSON values.

    Raises:
        ValueError: if a number is not finite as a double, or a text has half a surrogate pair.
        TypeError: if a value is none of JSON.
        RecursionError: if it is nested too deeply.
    """
    parts: list[str] = []
    _append(value, parts)
    return "".join(parts).encode("utf-8")


def checksum(fields: Mapping[str, Any]) -> str:
    """Return the checksum of a result, whose own field is left out; errors as of `canonical`."""
    return hashlib.sha256(canonical({name: fields[name] for name in fields if name != CHECKSUM_FIELD})).hexdigest()


def sealed(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain fields with their checksum as the last one; errors as of `canonical`."""
    body = {name: value for name, value in fields.items() if name != CHECKSUM_FIELD}
    return {**body, CHECKSUM_FIELD: checksum(body)}


def checksum_state(fields: Mapping[str, Any]) -> ChecksumState:
    """Return whether fields are as they were when their checksum was written."""
    if CHECKSUM_FIELD not in fields:
        return "no checksum"
    try:
        return "intact" if checksum(fields) == fields[CHECKSUM_FIELD] else "edited"
    except (ValueError, TypeError, RecursionError):  # what the program never writes
        return "edited"


def _append(value: Any, parts: list[str]) -> None:
    if value is None or isinstance(value, bool | str):
        parts.append(json.dumps(value, ensure_ascii=False))
    elif isinstance(value, int | float):
        parts.append(_number(value))
    elif isinstance(value, Mapping):
        for k, name in enumerate(sorted(value, key=_utf_16)):
            parts.append("{" if k == 0 else ",")
            parts.append(json.dumps(name, ensure_ascii=False) + ":")
            _append(value[name], parts)
        parts.append("}" if value else "{}")
    elif isinstance(value, Sequence) and not isinstance(value, bytes):
        for k, item in enumerate(value):
            parts.append("[" if k == 0 else ",")
            _append(item, parts)
        parts.append("]" if value else "[]")
    else:
        raise TypeError(f"{type(value).__name__} is no value of JSON")


def _utf_16(name: str) -> bytes:
    if not isinstance(name, str):
        raise TypeError(f"the name {name!r} is no text")
    return name.encode("utf-16-be", "surrogatepass")


def _number(value: float) -> str:
    """Return a number as ECMAScript writes the double of its value (Number::toString)."""
    if isinstance(value, int):
        if abs(value) <= _EXACT:
            return str(value)
        try:
            value = float(value)
        except OverflowError:
            raise ValueError("an integer is too large for a double") from None
    if not math.isfinite(value):
        raise ValueError(f"{value} is no number of JSON")
    if value == 0:
        return "0"
    mantissa, _, power = repr(abs(value)).partition("e")
    whole, _, fraction = mantissa.partition(".")
    written = whole + fraction
    digits = written.lstrip("0")
    point = len(whole) + int(power or 0) - (len(written) - len(digits))  # the value is .DIGITS x 10^point
    digits = digits.rstrip("0")
    count = len(digits)
    if count <= point <= _MAX_DIGITS:
        text = digits + "0" * (point - count)
    elif 0 < point <= _MAX_DIGITS:
        text = f"{digits[:point]}.{digits[point:]}"
    elif -6 < point <= 0:
        text = f"0.{'0' * -point}{digits}"
    else:
        more = f".{digits[1:]}" if count > 1 else ""
        text = f"{digits[0]}{more}e{point - 1:+d}"
    return text if value > 0 else f"-{text}"


def sealed_page(page: bytes) -> bytes:
    """Return an HTML page with the checksum of what precedes it in its last line, a comment."""
    return page + b"\n" + _SEAL % hashlib.sha256(page).hexdigest().encode("ascii")


def is_sealed_page(path: Path) -> bool:
    """Return whether a file is a page of `sealed_page`, unchanged.

    Raises:
        OSError: if it cannot be read.
    """
    length = len(_SEAL % bytes(64))
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size - length - 1
        if size < 0:
            return False
        digest = hashlib.sha256()
        while size and (block := file.read(min(size, _BLOCK_BYTES))):
            digest.update(block)
            size -= len(block)
        return file.read() == b"\n" + _SEAL % digest.hexdigest().encode("ascii")
