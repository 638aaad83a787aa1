"""The pages of an E57 file: 1020 bytes and their CRC-32C each, so that damage anywhere in the file is found.

Source: ASTM E2807-11, 8.3; the polynomial is that of RFC 3720, the checksum is stored most significant byte first.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError

_PAGE = 1024
_WORDS = _PAGE // 4 - 1
_POLYNOMIAL = 0x82F63B78  # CRC-32C, reflected
_PAGES_AT_ONCE = 16_384
_MOST_PARTS = 32  # of larger files, parts that are spread evenly are looked at


def require_intact_pages(path: Path) -> str:
    """Refuse an E57 file with damaged pages.

    Args:
        path: a file whose header was read.

    Returns:
        a note where only a part of a large file was looked at; else empty.

    Raises:
        FormatError: naming what is damaged.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        count = size // _PAGE
        parts = -(-count // _PAGES_AT_ONCE)
        chosen = sorted({round(k) for k in np.linspace(0, parts - 1, min(parts, _MOST_PARTS))})
        wrong, looked, first = 0, 0, 0
        for part in chosen:
            file.seek(part * _PAGES_AT_ONCE * _PAGE)
            data = file.read(_PAGES_AT_ONCE * _PAGE)
            pages = np.frombuffer(data, "<u4", count=len(data) // _PAGE * (_PAGE // 4)).reshape(-1, _PAGE // 4)
            bad = np.flatnonzero(_checksums(pages[:, :_WORDS]) != pages[:, _WORDS].byteswap())
            if len(bad) and not wrong:
                first = (part * _PAGES_AT_ONCE + int(bad[0])) * _PAGE
            wrong, looked = wrong + len(bad), looked + len(pages)
    if wrong:
        pages_are = "page is" if wrong == 1 else "pages are"
        raise FormatError(
            f"{wrong:,} of {looked:,} {pages_are} damaged, the first at byte {first:,}: the checksum is wrong; copy it "
            "again from where it was written, or export it again"
        )
    return (
        "" if looked == count else f"the checksums of {looked:,} of its {count:,} pages were compared: they are right"
    )


def _checksums(words: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the CRC-32C (P,) of pages of little-endian words (P, W), all pages at once."""
    tables = _tables()
    found = np.full(len(words), 0xFFFFFFFF, np.uint32)
    for column in np.ascontiguousarray(words.T):
        found ^= column
        found = (
            tables[3][found & 0xFF]
            ^ tables[2][found >> 8 & 0xFF]
            ^ tables[1][found >> 16 & 0xFF]
            ^ tables[0][found >> 24]
        )
    return found ^ np.uint32(0xFFFFFFFF)


@cache
def _tables() -> NDArray[np.uint32]:
    """Return the tables (4, 256) that take four bytes at a time."""
    tables = np.zeros((4, 256), np.uint32)
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = value >> 1 ^ (_POLYNOMIAL if value & 1 else 0)
        tables[0, byte] = value
    for k in range(1, 4):
        tables[k] = tables[k - 1] >> 8 ^ tables[0][tables[k - 1] & 0xFF]
    return tables
