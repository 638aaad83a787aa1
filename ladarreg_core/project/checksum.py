"""A checksum as the last field of a JSON object, `{..., "crc": "89abcdef"}`, that also mends one flipped bit.

Source: the CRC-32 of ISO 3309 as in zlib; two different single flipped bits never have the same syndrome in a text as
short as these.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from typing import Literal

_PATTERN = re.compile(rb',"crc":"([0-9a-f]{8})"\}')
_LENGTH = len(b',"crc":"89abcdef"}')
_LONGEST_MENDED = 8 << 20
_POLYNOMIAL = 0xEDB88320


def _remainder(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (_POLYNOMIAL if byte & 1 else 0)
    return byte


_REMAINDERS = tuple(map(_remainder, range(256)))
_BYTE_OF_TOP = {remainder >> 24: byte for byte, remainder in enumerate(_REMAINDERS)}
_BIT_OF_REMAINDER = {_REMAINDERS[1 << bit]: 1 << bit for bit in range(8)}


@dataclass(frozen=True, slots=True)
class Unsealed:
    """What the seal of a text says of it."""

    data: bytes
    """The text, mended where that was possible."""
    state: Literal["sound", "mended", "no seal", "broken"]
    """`no seal`: as files are that an older version of the program wrote; `broken`: it is not what was sealed."""


def sealed(data: bytes) -> bytes:
    """Return a JSON object, not empty, with its checksum."""
    body = data[:-1]
    return body + _seal(body)


def unsealed(data: bytes, *, mend: bool = True) -> Unsealed:
    """Return what the seal of a text says of it; the checksum stays in the text.

    Args:
        data: as `sealed` wrote it, or with damage.
        mend: whether to look for one flipped bit, which takes seconds for some megabytes.
    """
    body, tail = data[:-_LENGTH], data[-_LENGTH:]
    right = _seal(body)
    if tail == right:
        return Unsealed(data, "sound")
    if _bits_apart(tail, right) == 1:  # the flipped bit is one of the seal
        return Unsealed(body + right, "mended")
    found = _PATTERN.fullmatch(tail)
    if found is None:
        return Unsealed(data, "no seal")
    whole = _mended(body, int(found[1], 16)) if mend and len(body) <= _LONGEST_MENDED else None
    return Unsealed(data, "broken") if whole is None else Unsealed(whole + tail, "mended")


def _seal(body: bytes) -> bytes:
    return b',"crc":"%08x"}' % zlib.crc32(body)


def _bits_apart(one: bytes, other: bytes) -> int:
    return (int.from_bytes(one, "little") ^ int.from_bytes(other, "little")).bit_count()


def _mended(body: bytes, checksum: int) -> bytes | None:
    """Return the text of a checksum that is one bit away; None where there is none.

    The checksum is linear: a flipped bit adds the remainder of that bit followed by zeros. So the zeros are taken off
    the syndrome one by one, until it is the remainder of a single bit.
    """
    syndrome = zlib.crc32(body) ^ checksum
    for index in range(len(body) - 1, -1, -1):
        bit = _BIT_OF_REMAINDER.get(syndrome)
        if bit is not None:
            return body[:index] + bytes([body[index] ^ bit]) + body[index + 1 :]
        byte = _BYTE_OF_TOP[syndrome >> 24]
        syndrome = (syndrome ^ _REMAINDERS[byte]) << 8 & 0xFFFFFFFF | byte
    return None
