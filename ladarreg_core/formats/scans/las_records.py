"""The stored parts of LAS and LAZ files: header, variable length records and the bytes of every point, for copies."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import DependencyError, FormatError
from ladarreg_core.formats.parsing.untrusted import reading
from ladarreg_core.formats.scans.las_header import LasHeader, read_las_header

PROJECTION = "lasf_projection"
WKT_RECORD, GEOTIFF_RECORD = 2112, 34735
EXTRA_BYTES_RECORD = ("lasf_spec", 4)
LASZIP_RECORD = ("laszip encoded", 22204)
_RECORD_HEADER, _LONG_RECORD_HEADER = 54, 60
_EXTRA_ENTRY = 192
_EXTRA_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 8, 8: 8, 9: 4, 10: 8}
_UNDOCUMENTED = 255
_LEGACY_RECORDS = np.dtype(
    [("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"), ("bits", "u1"), ("class_bits", "u1"),
     ("scan_angle_rank", "i1"), ("user_data", "u1"), ("point_source_id", "<u2")]
)  # fmt: skip
_RECORDS = np.dtype(
    [("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"), ("returns", "u1"), ("flags", "u1"),
     ("classification", "u1"), ("user_data", "u1"), ("scan_angle", "<i2"), ("point_source_id", "<u2"),
     ("gps_time", "<f8")]
)  # fmt: skip
_TIME, _RGB, _NIR = [("gps_time", "<f8")], [(name, "<u2") for name in ("red", "green", "blue")], [("nir", "<u2")]
_FIELDS: dict[int, tuple[np.dtype[Any], list[tuple[str, str]]]] = {
    0: (_LEGACY_RECORDS, []), 1: (_LEGACY_RECORDS, _TIME), 2: (_LEGACY_RECORDS, _RGB),
    3: (_LEGACY_RECORDS, _TIME + _RGB), 6: (_RECORDS, []), 7: (_RECORDS, _RGB), 8: (_RECORDS, _RGB + _NIR),
}  # fmt: skip


def point_dtype(point_format: int, extra: list[tuple[str, str]] | None = None) -> np.dtype[Any]:
    """Return the record of a point as it is stored; the bits of flags stay packed.

    Args:
        point_format: 0 to 3 or 6 to 8.
        extra: names and types of the fields behind those of the format.

    Source: ASPRS LAS 1.4 R15, tables 7 to 17.
    """
    base, more = _FIELDS[point_format]
    return np.dtype([*base.descr, *more, *(extra or [])])


@dataclass(frozen=True, slots=True)
class StoredRecord:
    """A variable length record as it is stored."""

    user: str
    """In lower case."""
    number: int
    data: bytes
    """With its header of 54 bytes."""

    @property
    def content(self) -> bytes:
        """What follows its header."""
        return self.data[_RECORD_HEADER:]

    @property
    def key(self) -> tuple[str, int]:
        """User and number, by which records are known."""
        return self.user, self.number


@dataclass(frozen=True, slots=True)
class StoredLongRecord:
    """An extended variable length record, which may be large: where it stands."""

    user: str
    number: int
    start: int
    """Offset of its header of 60 bytes in the file, bytes."""
    size: int
    """With its header, bytes."""


class LasRecords:
    """The stored parts of a file.

    Args:
        path: a LAS or LAZ file that is read, see `read_las_header`.

    Raises:
        FormatError: if it is damaged or of a kind that is not read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with reading(path) as file, open(file, "rb") as stream:
            size = file.stat().st_size
            self.header: LasHeader = read_las_header(stream, size)
            stream.seek(0)
            head_bytes, first_point, count = struct.unpack_from("<HII", stream.read(104), 94)
            stream.seek(0)
            self.head: bytes = stream.read(head_bytes)
            """The header block, with what its writer may have appended to it."""
            self.records: tuple[StoredRecord, ...] = tuple(_records(stream.read(first_point - head_bytes), count))
            """The variable length records in front of the points."""
            self.long_records: tuple[StoredLongRecord, ...] = tuple(_long_records(stream, self.head, size))
            """Those behind the points."""

    def has(self, number: int) -> bool:
        """Return whether there is a record of the coordinate system with a number, in front or behind."""
        wanted = PROJECTION, number
        return wanted in {one.key for one in self.records} | {(one.user, one.number) for one in self.long_records}

    def chunks(self, count: int) -> Iterator[NDArray[np.uint8]]:
        """Yield the stored points, (n, record_bytes) uint8 each, decompressed; the same memory is used again.

        Raises:
            DependencyError: if they are compressed and lazrs is not installed.
            FormatError: if they cannot be decompressed, or the file is truncated.
        """
        width, total = self.header.record_bytes, self.header.points
        memory = np.empty(min(count, total) * width, np.uint8)
        with open(self.path, "rb") as stream:
            stream.seek(self.header.first_point)
            source = self._decompressor(stream) if self.header.compressed and total else None
            for first in range(0, total, count):
                part = memory[: min(count, total - first) * width]
                with reading(self.path):
                    if source is not None:
                        source.decompress_many(part)
                    elif stream.readinto(part.data) != part.nbytes:
                        raise FormatError("it ends within its points; it is truncated")
                yield part.reshape(-1, width)

    def _decompressor(self, stream: io.BufferedReader) -> Any:
        with reading(self.path):
            try:
                import lazrs
            except ImportError as error:
                raise DependencyError(
                    'reading LAZ needs lazrs, which is not installed: pip install "laspy[lazrs]"'
                ) from error
            record = next(one for one in self.records if one.key == LASZIP_RECORD)
            everything = lazrs.DecompressionSelection(lazrs.SELECTIVE_DECOMPRESS_ALL)
            return lazrs.ParLasZipDecompressor(stream, record.content, everything)


def _records(data: bytes, count: int) -> Iterator[StoredRecord]:
    at = 0
    for _ in range(count):
        head = data[at : at + _RECORD_HEADER]
        if len(head) < _RECORD_HEADER:
            break
        number, size = struct.unpack_from("<HH", head, 18)
        yield StoredRecord(_user(head), number, data[at : at + _RECORD_HEADER + size])
        at += _RECORD_HEADER + size


def _long_records(stream: io.BufferedReader, head: bytes, file_bytes: int) -> Iterator[StoredLongRecord]:
    if head[25] < 4 or len(head) < 247:
        return
    at, count = struct.unpack_from("<QI", head, 235)
    for _ in range(count):
        stream.seek(at)
        start = stream.read(_LONG_RECORD_HEADER)
        number, size = struct.unpack_from("<HQ", start.ljust(_LONG_RECORD_HEADER, b"\0"), 18)
        if len(start) < _LONG_RECORD_HEADER or at + _LONG_RECORD_HEADER + size > file_bytes:
            raise FormatError("a record behind its points is not complete; the LAS file is truncated")
        yield StoredLongRecord(_user(start), number, at, _LONG_RECORD_HEADER + size)
        at += _LONG_RECORD_HEADER + size


def _user(head: bytes) -> str:
    return head[2:18].split(b"\0")[0].decode("latin-1").lower()


def extra_bytes_of(described: bytes, size: int) -> tuple[bytes, set[str]]:
    """Return descriptions of all extra bytes of a point, and the names of these fields in lower case.

    Bytes that are not described are described as such, so that more fields can follow them.

    Args:
        described: content of the record that describes extra bytes.
        size: extra bytes of a point.

    Source: ASPRS LAS 1.4 R15, table 24.
    """
    kept, names, known = b"", set(), 0
    for at in range(0, len(described) - _EXTRA_ENTRY + 1, _EXTRA_ENTRY):
        entry = described[at : at + _EXTRA_ENTRY]
        if known + _extra_size(entry) > size:
            break
        kept, known = kept + entry, known + _extra_size(entry)
        names.add(entry[4:36].split(b"\0")[0].decode("latin-1").lower())
    while known < size:
        more = min(_UNDOCUMENTED, size - known)
        name = f"undocumented_{known}"
        kept += struct.pack("<2xBB32s156x", 0, more, name.encode())
        names.add(name)
        known += more
    return kept, names


def _extra_size(entry: bytes) -> int:
    """Return the bytes of a described field; types 11 to 30 are the pairs and triples of older writers."""
    code, options = entry[2], entry[3]
    return options if code == 0 else _EXTRA_SIZES[(code - 1) % 10 + 1] * ((code - 1) // 10 + 1)
