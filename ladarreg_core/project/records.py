"""The records of a history's file: JSON objects with a checksum, one a line.

A record is `{"commit" | "amend": {number, label, author, when}, "document" | "change": ..., "seq": n, "crc": "..."}` or
`{"at": number, "seq": n, "crc": "..."}`. `seq` counts what was written; records that were written together, when a
history was written anew, have the same. Records of older versions of the program have neither `seq` nor `crc`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from ladarreg_core.project.checksum import sealed, unsealed
from ladarreg_core.project.codec import encode

Record = dict[str, Any]
_BEGINNINGS = re.compile(rb'\{"(?:commit|amend)":\{|\{"at":')
_MOST_MENDED_BYTES = 8 << 20
_KINDS = {"commit", "amend", "at"}


@dataclass(frozen=True, slots=True)
class Records:
    """What was read of a history's file."""

    found: tuple[Record | None, ...]
    """In order; None where one or several cannot be read."""
    sound: int | None
    """How many bytes can stay and be appended to; None where the file has to be written anew."""
    mended: int
    """How many records had a flipped bit, and have it no more."""


def record_line(fields: Mapping[str, Any], seq: int) -> bytes:
    """Return a record as a line of the file."""
    return sealed(encode({**fields, "seq": seq})) + b"\n"


def read_records(data: bytes) -> Records:
    """Return all records that can be read, whatever became of the file.

    Args:
        data: the file.
    """
    return _Reader(data).records()


class _Reader:
    def __init__(self, data: bytes) -> None:
        self._data = data
        self._found: list[Record | None] = []
        self._mended = 0
        self._left_to_mend = _MOST_MENDED_BYTES
        self._damaged = False

    def records(self) -> Records:
        *lines, torn = self._data.split(b"\n")
        broken: list[bytes] = []
        for line in lines:
            record = self._record(line)
            if record is None:
                broken.append(line)
                continue
            self._salvage(broken)
            broken = []
            self._found.append(record)
        self._end(broken, torn)
        damaged = self._damaged or self._mended > 0
        return Records(tuple(self._found), None if damaged else len(self._data) - len(torn), self._mended)

    def _end(self, broken: Sequence[bytes], torn: bytes) -> None:
        """Read what follows the last sound line: nothing, a line that was being written at a crash, or damage."""
        if broken:
            self._salvage([*broken, torn] if torn else broken)
        elif torn:
            last = [record for record in self._embedded(torn) if record is not None]
            self._found += last
            self._damaged |= bool(last)

    def _salvage(self, broken: Sequence[bytes]) -> None:
        """Read what there is to be read in lines that follow each other and are no records."""
        if not broken:
            return
        self._damaged = True
        # A flipped bit can make one line of two, and two of one.
        whole = self._record(b"\n".join(broken)) if len(broken) > 1 else None
        self._found += [whole] if whole is not None else self._embedded(b"\n".join(broken))

    def _embedded(self, text: bytes) -> Iterator[Record | None]:
        """Yield the records within a text, and None for what is between them."""
        begins = [found.start() for found in _BEGINNINGS.finditer(text)]
        if not begins:
            yield None
            return
        lost = begins[0] > 0
        for begin, end in zip(begins, [*begins[1:], len(text)], strict=True):
            record = self._record(text[begin:end]) or self._record(text[begin : end - 1])  # without the line's end
            if record is None:
                lost = True
                continue
            if lost:
                yield None
            lost = False
            yield record
        if lost:
            yield None

    def _record(self, line: bytes) -> Record | None:
        opened = unsealed(line, mend=self._left_to_mend >= len(line))
        if opened.state not in ("sound", "no seal"):
            self._left_to_mend -= len(line)
        if opened.state == "broken":
            return None
        try:
            fields = msgspec.json.decode(opened.data)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None
        if not isinstance(fields, dict) or (opened.state == "no seal" and not _KINDS & fields.keys()):
            return None
        self._mended += opened.state == "mended"
        return fields
