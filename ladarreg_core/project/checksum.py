"""Checksum as the last field of a JSON object, `{..., "crc": "89abcdef"}`, which can also correct one flipped bit.

Source: the CRC-32 of ISO 3309 as in zlib; in texts as short as these no two single-bit errors have the same syndrome.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from typing import Literal

_PATTERN = re.compile(rb',"crc":"([0-9a-f]{8})"\}')
_LENGTH = len(b',"crc":"89abcdef"}')
_LONGEST_CORRECTED = 8 << 20
_POLYNOMIAL = 0xEDB88320


def _remainder(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (_POLYNOMIAL if byte & 1 else 0)
    return byte


_REMAINDERS = tuple(map(_remainder, range(256)))
_BYTE_OF_TOP = {remainder >> 24: byte for byte, remainder in enumerate(_REMAINDERS)}
_BIT_OF_REMAINDER = {_REMAINDERS[1 << bit]: 1 << bit for bit in range(8)}


@dataclass(frozen=True, slots=True)
class CheckedText:
    """A text after verification of its checksum."""

    data: bytes
    """The text, corrected where that was possible."""
    state: Literal["intact", "corrected", "no checksum", "damaged"]
    """`no checksum`: as written by older versions of the program."""


def with_checksum(data: bytes) -> bytes:
    """Return a non-empty JSON object with its checksum appended as a field."""
    body = data[:-1]
    return body + _checksum_field(body)


def verify_checksum(data: bytes, *, correct: bool = True) -> CheckedText:
    """Verify the checksum of a text, which remains in the text.

    Args:
        data: a text written by `with_checksum`, possibly damaged.
        correct: whether to search for one flipped bit, which takes seconds for some megabytes.
    """
    body, tail = data[:-_LENGTH], data[-_LENGTH:]
    right = _checksum_field(body)
    if tail == right:
        return CheckedText(data, "intact")
    if _bits_apart(tail, right) == 1:  # the flipped bit is in the checksum field
        return CheckedText(body + right, "corrected")
    found = _PATTERN.fullmatch(tail)
    if found is None:
        return CheckedText(data, "no checksum")
    whole = _corrected(body, int(found[1], 16)) if correct and len(body) <= _LONGEST_CORRECTED else None
    return CheckedText(data, "damaged") if whole is None else CheckedText(whole + tail, "corrected")


def _checksum_field(body: bytes) -> bytes:
    return b',"crc":"%08x"}' % zlib.crc32(body)


def _bits_apart(one: bytes, other: bytes) -> int:
    return (int.from_bytes(one, "little") ^ int.from_bytes(other, "little")).bit_count()


def _corrected(body: bytes, checksum: int) -> bytes | None:
    """Return the text with the given checksum that differs in one bit; None if there is none.

    The CRC is linear: a flipped bit adds the remainder of that bit followed by zeros. So zeros are removed from the
    syndrome one byte at a time until it is the remainder of a single bit.
    """
    syndrome = zlib.crc32(body) ^ checksum
    for index in range(len(body) - 1, -1, -1):
        bit = _BIT_OF_REMAINDER.get(syndrome)
        if bit is not None:
            return body[:index] + bytes([body[index] ^ bit]) + body[index + 1 :]
        byte = _BYTE_OF_TOP[syndrome >> 24]
        syndrome = (syndrome ^ _REMAINDERS[byte]) << 8 & 0xFFFFFFFF | byte
    return None
