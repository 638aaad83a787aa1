"""Writer of LAS and LAZ files, chunk by chunk, with records of another file copied byte by byte."""

from __future__ import annotations

import contextlib
import datetime
import os
import struct
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import DependencyError, ExportError
from ladarreg_core.formats.scans.las_records import point_dtype
from ladarreg_core.foundations.version import VERSION
from ladarreg_core.storage.atomic_write import cannot_write

_HEADER_BYTES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375}
_LEGACY_FORMATS = 6  # below it, counts of 32 bits and returns of 3
_LARGEST_RECORD = 65_535
_COPIED_AT_ONCE = 1 << 22
_WKT_BIT = 1 << 4
_EXTRA_BYTES_RECORD = 4
_EXTRA_TYPES = {"|u1": 1, "|i1": 2, "<u2": 3, "<i2": 4, "<u4": 5, "<i4": 6, "<u8": 7, "<i8": 8, "<f4": 9, "<f8": 10}


def variable_record(user: str, number: int, description: str, content: bytes) -> bytes:
    """Return a variable length record as it is stored.

    Raises:
        ExportError: if it is too large.
    """
    if len(content) > _LARGEST_RECORD:
        raise ExportError(f"a record of {len(content):,} bytes does not fit into a LAS file, which takes 65,535")
    return struct.pack("<H16sHH32s", 0, user.encode(), number, len(content), description.encode()) + content


def extra_bytes_entry(name: str, dtype: str, description: str = "") -> bytes:
    """Return the description (192 bytes) of one field behind those of the format. Source: LAS 1.4 R15, table 24.

    Args:
        name: of the field, at most 32 bytes.
        dtype: NumPy code of a number.
        description: at most 32 bytes.
    """
    code = _EXTRA_TYPES[np.dtype(dtype).str]
    return struct.pack("<2xBB32s124x32s", code, 0, name.encode()[:32], description.encode()[:32])


def extra_bytes_record(entries: bytes) -> bytes:
    """Return the record that describes the fields behind those of the format."""
    return variable_record("LASF_Spec", _EXTRA_BYTES_RECORD, "Extra bytes", entries)


class LasWriter:
    """Writes one file; used as a context manager, which finishes it unless an exception is raised.

    Args:
        path: of the file, which is compressed.
        point_format: 2 or 3, 7 or 8.
        dtype: of a point's record.
        minor: x of LAS 1.x.
        scale: of the coordinates, m.
        offset: of the coordinates, m.
        records: variable length records as they are stored.
        head: header block of the file whose identifiers and flags are kept.
        has_wkt: whether a coordinate system is stated as WKT, or could only be.

    Raises:
        DependencyError: if lazrs is not installed.
        ExportError: if the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        *,
        point_format: int,
        dtype: np.dtype[Any],
        minor: int,
        scale: Sequence[float],
        offset: Sequence[float],
        records: Sequence[bytes],
        head: bytes = b"",
        has_wkt: bool,
    ) -> None:
        try:
            import lazrs
        except ImportError as error:
            raise DependencyError(
                'writing LAZ needs lazrs, which is not installed: pip install "laspy[lazrs]"'
            ) from error
        standard = point_dtype(point_format).itemsize
        laszip = lazrs.LazVlr.new_for_compression(point_format, dtype.itemsize - standard)
        self._path, self._dtype = path, dtype
        self._format, self._minor = point_format, minor
        self._scale, self._offset = np.asarray(scale), np.asarray(offset)
        self._records = [
            *records,
            variable_record("laszip encoded", 22204, "by lazrs", bytes(laszip.record_data())),
        ]
        self._base = _base(head, minor, has_wkt=has_wkt)
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self._returns = np.zeros(16, np.int64)
        self._points, self._long_at, self._long_count = 0, 0, 0
        with self._failures():
            self._stream = open(path, "wb")  # noqa: SIM115 - closed by __exit__
            self._write_head()
            self._stream.flush()
            self._compressor = lazrs.ParLasZipCompressor(self._stream, laszip)

    def write(self, points: NDArray[Any]) -> None:
        """Append points (N,) of the writer's dtype."""
        if not len(points):
            return
        for axis, name in enumerate("XYZ"):
            whole = points[name]
            self._low[axis] = min(self._low[axis], int(whole.min()))
            self._high[axis] = max(self._high[axis], int(whole.max()))
        number = points["bits"] & 7 if self._format < _LEGACY_FORMATS else points["returns"] & 15
        self._returns += np.bincount(number, minlength=16)
        self._points += len(points)
        with self._failures():
            self._compressor.compress_many(np.ascontiguousarray(points).view(np.uint8).reshape(-1))

    def finish(self, source: Path | None = None, long_records: Sequence[tuple[int, int]] = ()) -> None:
        """Complete the file, with records (start, size) copied from another one behind the points."""
        with self._failures():
            self._compressor.done()
            self._stream.seek(0, os.SEEK_END)
            if source is not None and long_records:
                self._long_at, self._long_count = self._stream.tell(), len(long_records)
                with open(source, "rb") as other:
                    for start, size in long_records:
                        other.seek(start)
                        for done in range(0, size, _COPIED_AT_ONCE):
                            self._stream.write(other.read(min(_COPIED_AT_ONCE, size - done)))
            self._stream.seek(0)
            self._write_head()
            self._stream.flush()
            os.fsync(self._stream.fileno())

    def __enter__(self) -> LasWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):
            self._stream.close()

    @contextlib.contextmanager
    def _failures(self) -> Any:
        """Turn a failure, also one that the compressor wraps, into a sentence."""
        try:
            yield
        except OSError as error:
            raise cannot_write(self._path, error) from None
        except Exception as error:
            if type(error).__module__.startswith("lazrs") or type(error).__name__ == "LazrsError":
                raise ExportError(
                    f"cannot write {self._path}: the disk may be full ({error}); give a writable folder with enough "
                    "free space"
                ) from error
            raise

    def _write_head(self) -> None:
        head = bytearray(self._base)
        first_point = len(head) + sum(map(len, self._records))
        struct.pack_into("<HIIBH", head, 94, len(head), first_point, len(self._records), self._format | 0x80,
                         self._dtype.itemsize)  # fmt: skip
        legacy = self._format < _LEGACY_FORMATS
        struct.pack_into("<6I", head, 107, *([self._points, *self._returns[1:6]] if legacy else [0] * 6))
        struct.pack_into("<6d", head, 131, *self._scale, *self._offset)
        low, high = (np.where(np.isfinite(each), each * self._scale + self._offset, 0) for each in
                     (self._low, self._high))  # fmt: skip
        struct.pack_into("<6d", head, 179, *np.stack([high, low], axis=-1).ravel())
        if self._minor >= 3:
            struct.pack_into("<Q", head, 227, 0)
        if self._minor >= 4:
            struct.pack_into("<QIQ15Q", head, 235, self._long_at, self._long_count, self._points, *self._returns[1:])
        self._stream.write(head)
        for record in self._records:
            self._stream.write(record)


def _base(head: bytes, minor: int, *, has_wkt: bool) -> bytes:
    """Return a header block without the figures that are known in the end."""
    old = _HEADER_BYTES.get(head[25], 375) if head else 0
    new = _HEADER_BYTES[minor]
    made = bytearray(head[: min(old, new)].ljust(new, b"\0") + head[old:])
    made[:4] = b"LASF"
    flags = struct.unpack_from("<H", made, 6)[0]
    struct.pack_into("<H", made, 6, flags | _WKT_BIT if has_wkt else flags)
    made[24:26] = 1, minor
    struct.pack_into("<32s", made, 58, f"ladarreg {VERSION}".encode()[:32])
    if not head:
        today = datetime.date.today()
        struct.pack_into("<32s", made, 26, b"OTHER")
        struct.pack_into("<HH", made, 90, today.timetuple().tm_yday, today.year)
    return bytes(made)
