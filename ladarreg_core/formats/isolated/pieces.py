"""A stream in pieces with their lengths: what one sender says ends where the process that passes it on says so.

A process that a file has taken over may send anything, but it cannot write the length of a piece, nor the empty piece
that ends its turn.
"""

from __future__ import annotations

import io
from typing import IO

_LENGTH_BYTES = 4
_MAX_BYTES = 1 << 20


def write_piece(stream: IO[bytes], data: bytes | memoryview) -> None:
    """Write bytes as pieces, and flush; no bytes are the end of a turn."""
    for at in range(0, max(1, len(data)), _MAX_BYTES):
        part = data[at : at + _MAX_BYTES]
        stream.write(len(part).to_bytes(_LENGTH_BYTES, "little"))
        stream.write(part)
    stream.flush()


class Turn(io.RawIOBase):
    """The bytes of one turn.

    Args:
        stream: a buffered stream of pieces.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        super().__init__()
        self._stream, self._left, self._is_over = stream, 0, False

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        """Fill a buffer; 0 at the end of the turn.

        Raises:
            EOFError: if the stream ends before.
            ValueError: if it does not consist of pieces.
        """
        if self._left == 0 and not self._is_over:
            length = self._stream.read(_LENGTH_BYTES)
            if len(length) < _LENGTH_BYTES:
                raise EOFError("the other process has ended")
            self._left = int.from_bytes(length, "little")
            if self._left > _MAX_BYTES:
                raise ValueError(f"a piece has {self._left:,} bytes; at most {_MAX_BYTES:,} are allowed")
            self._is_over = self._left == 0
        if self._is_over:
            return 0
        count: int = self._stream.readinto(memoryview(buffer)[: self._left])  # type: ignore[attr-defined]
        if count == 0:
            raise EOFError("the other process has ended")
        self._left -= count
        return count
