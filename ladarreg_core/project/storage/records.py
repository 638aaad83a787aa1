"""Records of the history file: JSON objects with a checksum, one per line.

A record is `{"commit" | "amend": {number, label, author, when}, "document" | "change": ..., "seq": n, "crc": "..."}` or
`{"at": number, "seq": n, "crc": "..."}`; a commit also has `automatic`, `by`, `undoes` and `redoes` where they apply.
`seq` counts the writes; records of a rewritten history all have the same. Records of older versions of the program
have neither `seq` nor `crc`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from ladarreg_core.project.checksum import verify_checksum, with_checksum
from ladarreg_core.project.storage.codec import encode

Record = dict[str, Any]
_BEGINNINGS = re.compile(rb'\{"(?:commit|amend)":\{|\{"at":')
_MAX_CORRECTED_BYTES = 8 << 20
_KINDS = {"commit", "amend", "at"}


@dataclass(frozen=True, slots=True)
class Records:
    """Contents of a history file."""

    found: tuple[Record | None, ...]
    """The records in order; None stands for one or several that cannot be read."""
    intact_bytes: int | None
    """Length of the intact part, which can be appended to; None if the file must be rewritten."""
    corrected: int
    """Number of records in which a flipped bit was corrected."""


def record_line(fields: Mapping[str, Any], seq: int) -> bytes:
    """Return a record as a line of the file."""
    return with_checksum(encode({**fields, "seq": seq})) + b"\n"


def read_records(data: bytes) -> Records:
    """Return all records that can be read from a history file, even if it is damaged."""
    return _Reader(data).records()


class _Reader:
    def __init__(self, data: bytes) -> None:
        self._data = data
        self._found: list[Record | None] = []
        self._corrected = 0
        self._correction_bytes_left = _MAX_CORRECTED_BYTES
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
        damaged = self._damaged or self._corrected > 0
        return Records(tuple(self._found), None if damaged else len(self._data) - len(torn), self._corrected)

    def _end(self, broken: Sequence[bytes], torn: bytes) -> None:
        """Read what follows the last readable line: nothing, a line cut short by a crash, or damage."""
        if broken:
            self._salvage([*broken, torn] if torn else broken)
        elif torn:
            last = [record for record in self._embedded(torn) if record is not None]
            self._found += last
            self._damaged |= bool(last)

    def _salvage(self, broken: Sequence[bytes]) -> None:
        """Recover what is readable from consecutive lines that are not records."""
        if not broken:
            return
        self._damaged = True
        # A flipped bit can join two lines, or split one.
        whole = self._record(b"\n".join(broken)) if len(broken) > 1 else None
        self._found += [whole] if whole is not None else self._embedded(b"\n".join(broken))

    def _embedded(self, text: bytes) -> Iterator[Record | None]:
        """Yield the records within a text, and None for unreadable parts between them."""
        begins = [found.start() for found in _BEGINNINGS.finditer(text)]
        if not begins:
            yield None
            return
        lost = begins[0] > 0
        for begin, end in zip(begins, [*begins[1:], len(text)], strict=True):
            record = self._record(text[begin:end]) or self._record(text[begin : end - 1])  # without the newline
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
        checked = verify_checksum(line, correct=self._correction_bytes_left >= len(line))
        if checked.state not in ("intact", "no checksum"):
            self._correction_bytes_left -= len(line)
        if checked.state == "damaged":
            return None
        try:
            fields = msgspec.json.decode(checked.data)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None
        if not isinstance(fields, dict) or (checked.state == "no checksum" and not _KINDS & fields.keys()):
            return None
        self._corrected += checked.state == "corrected"
        return fields
