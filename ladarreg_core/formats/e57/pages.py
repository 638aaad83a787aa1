"""The pages of an E57 file: 1020 bytes and their CRC-32C each, so that damage anywhere in the file is found.

Offsets in the file's header and XML are physical: they count the checksums, too. Everything else counts logical bytes,
which do not: `E57Pages` reads these, and compares the checksum of every page that it reads.

Source: ASTM E2807-11, 8.3; the polynomial is that of RFC 3720, the checksum is stored most significant byte first.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError

PAGE_BYTES = 1024
PAGE_DATA = 1020
"""Logical bytes of a page; its last four bytes are the checksum."""
_WORDS = PAGE_BYTES // 4 - 1
_POLYNOMIAL = 0x82F63B78  # CRC-32C, reflected
_PAGES_AT_ONCE = 4096  # a column of words stays in the processor's cache
_PAGES_OF_A_PART = 16_384
_MAX_PARTS = 32  # of larger files, parts that are spread evenly are looked at


class E57Pages:
    """The logical bytes of an E57 file.

    Args:
        stream: the open file.
        size: its size, bytes.
    """

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream = stream
        self.file_bytes = size
        """Size of the file."""
        self.logical_bytes = size // PAGE_BYTES * PAGE_DATA
        """Size of its content without the checksums."""

    def logical(self, physical: int, what: str) -> int:
        """Return the logical offset of a physical one.

        Raises:
            FormatError: if it is not inside the file, or inside the checksum of a page.
        """
        page, offset = divmod(physical, PAGE_BYTES)
        if not 0 <= physical < self.file_bytes:
            raise FormatError(
                f"the E57 puts {what} at byte {physical:,} of {self.file_bytes:,}; it is damaged: copy it again"
            )
        if offset >= PAGE_DATA:
            raise FormatError(
                f"the E57 puts {what} at byte {physical:,}, inside the checksum of a page; it is malicious or damaged: "
                "export it again"
            )
        return page * PAGE_DATA + offset

    def read(self, start: int, count: int, what: str) -> NDArray[np.uint8]:
        """Return logical bytes (count,).

        Args:
            start: logical offset of the first one.
            count: their number.
            what: they are, for the error message.

        Raises:
            FormatError: if the file ends before, or the checksum of a page is wrong.
        """
        if not (start >= 0 and 0 <= count <= self.logical_bytes - start):
            raise FormatError(f"{what} of {count:,} bytes ends with the E57; it is truncated or damaged: copy it again")
        first, skipped = divmod(start, PAGE_DATA)
        last = -(-(start + count) // PAGE_DATA)
        parts = [self._pages(at, min(_PAGES_AT_ONCE, last - at)) for at in range(first, last, _PAGES_AT_ONCE)]
        data = parts[0] if len(parts) == 1 else np.concatenate([*parts, np.zeros(0, np.uint8)])
        return data[skipped : skipped + count]

    def _pages(self, first: int, count: int) -> NDArray[np.uint8]:
        self._stream.seek(first * PAGE_BYTES)
        data = self._stream.read(count * PAGE_BYTES)
        if len(data) < count * PAGE_BYTES:
            raise FormatError("the E57 became shorter while it was read; read it again when it is complete")
        bad = _bad_pages(data)
        if len(bad):
            at = (first + int(bad[0])) * PAGE_BYTES
            raise FormatError(
                f"the E57 is damaged: the checksum of the page at byte {at:,} is wrong; copy or export it again"
            )
        return np.frombuffer(data, np.uint8).reshape(-1, PAGE_BYTES)[:, :PAGE_DATA].ravel()


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
        count = size // PAGE_BYTES
        parts = -(-count // _PAGES_OF_A_PART)
        chosen = sorted({round(k) for k in np.linspace(0, parts - 1, min(parts, _MAX_PARTS))})
        wrong, looked, first = 0, 0, 0
        for part in chosen:
            file.seek(part * _PAGES_OF_A_PART * PAGE_BYTES)
            data = file.read(_PAGES_OF_A_PART * PAGE_BYTES)
            bad = _bad_pages(data)
            if len(bad) and not wrong:
                first = (part * _PAGES_OF_A_PART + int(bad[0])) * PAGE_BYTES
            wrong, looked = wrong + len(bad), looked + len(data) // PAGE_BYTES
    if wrong:
        pages_are = "page is" if wrong == 1 else "pages are"
        raise FormatError(
            f"{wrong:,} of {looked:,} {pages_are} damaged, the first at byte {first:,}: the checksum is wrong; copy it "
            "again from where it was written, or export it again"
        )
    return (
        "" if looked == count else f"the checksums of {looked:,} of its {count:,} pages were compared: they are right"
    )


def _bad_pages(data: bytes) -> NDArray[np.intp]:
    """Return the numbers of the complete pages whose checksum is wrong."""
    pages = np.frombuffer(data, "<u4", count=len(data) // PAGE_BYTES * (PAGE_BYTES // 4)).reshape(-1, PAGE_BYTES // 4)
    strips = [pages[k : k + _PAGES_AT_ONCE] for k in range(0, len(pages), _PAGES_AT_ONCE)]
    wrong = [_checksums(strip[:, :_WORDS]) != strip[:, _WORDS].byteswap() for strip in strips]
    return np.flatnonzero(np.concatenate(wrong)) if wrong else np.zeros(0, np.intp)


def _checksums(words: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the CRC-32C (P,) of pages of little-endian words (P, W), all pages at once."""
    first_half, second_half = _tables()
    found = np.full(len(words), 0xFFFFFFFF, "<u4")
    halves = found.view("<u2").reshape(-1, 2)
    for column in np.ascontiguousarray(words.T):
        found ^= column
        found[:] = first_half.take(halves[:, 0]) ^ second_half.take(halves[:, 1])
    return found ^ np.uint32(0xFFFFFFFF)


@cache
def _tables() -> NDArray[np.uint32]:
    """Return the tables (2, 65536) that take the first and the second two bytes of a word."""
    tables = np.zeros((4, 256), np.uint32)
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = value >> 1 ^ (_POLYNOMIAL if value & 1 else 0)
        tables[0, byte] = value
    for k in range(1, 4):
        tables[k] = tables[k - 1] >> 8 ^ tables[0][tables[k - 1] & 0xFF]
    pairs = np.arange(1 << 16)
    return np.stack([tables[k + 1][pairs & 0xFF] ^ tables[k][pairs >> 8] for k in (2, 0)])
