"""The header of LAS and LAZ files, read and checked by hand before a library sees the file.

Source: ASPRS LAS 1.4 R15, tables 1 to 4; for LAZ, the LASzip record (user `laszip encoded`, number 22204).
"""

from __future__ import annotations

import io
import math
import struct
from dataclasses import dataclass
from typing import Any

from ladarreg_core.errors import DependencyError, FormatError
from ladarreg_core.formats.parsing.untrusted import one_line

POINT_FORMATS = {0: 20, 1: 28, 2: 26, 3: 34, 6: 30, 7: 36, 8: 38}
"""Least size of a point's record, bytes, by point format."""
WITH_COLOR = (2, 3, 7, 8)
_WAVEFORMS = (4, 5, 9, 10)
_HEADER_BYTES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375}
_RECORD_HEADER = 54
_LONG_RECORD_HEADER = 60
_MAX_RECORDS = 10_000
_LARGEST_WKT = 1 << 20
_POINTS_PER_BYTE = 4  # LASzip takes a few bytes per point; constant ones almost none
_ALWAYS_POINTS = 2_000_000
_ANY_CHUNK = (1 << 32) - 1
_LAYERS = {10: 9, 11: 1, 12: 2}  # of the points, colours, and colours with infrared of LAS 1.4
_EXTRA_BYTES = 14


@dataclass(frozen=True, slots=True)
class LasHeader:
    """What the header of a file says, after it has been compared with the file's size."""

    version: str
    point_format: int
    record_bytes: int
    compressed: bool
    points: int
    first_point: int
    """Offset of the point data, bytes."""
    scale: tuple[float, float, float]
    offset: tuple[float, float, float]
    lowest: tuple[float, float, float]
    """Smallest coordinates, m, as stated."""
    highest: tuple[float, float, float]
    software: str
    crs: str
    """Name of the coordinate reference system in the file's WKT; empty if there is none."""

    @property
    def has_color(self) -> bool:
        """Whether its points have colours."""
        return self.point_format in WITH_COLOR


def sniff_las(head: bytes) -> bool:
    """Return whether these are the first bytes of a LAS or LAZ file."""
    return head.startswith(b"LASF")


def read_las_header(stream: io.BufferedReader, file_bytes: int) -> LasHeader:
    """Return the header of a LAS 1.0 to 1.4 or LAZ file.

    Args:
        stream: the file.
        file_bytes: its size.

    Raises:
        FormatError: if it is damaged, claims more than the file contains, or has a version or point format that is not
            read.
    """
    stream.seek(0)
    head = stream.read(375)
    if len(head) < 227:
        raise FormatError(f"it ends after {len(head)} bytes, within the LAS header; it is truncated")
    major, minor = head[24], head[25]
    if major != 1 or minor not in _HEADER_BYTES:
        raise FormatError(f"it is LAS {major}.{minor}; 1.0 to 1.4 are read: export it as LAS 1.4")
    header_bytes, first_point, records = struct.unpack_from("<HII", head, 94)
    code, record_bytes, legacy_points = struct.unpack_from("<BHI", head, 104)
    numbers = struct.unpack_from("<12d", head, 131)
    points = legacy_points
    if minor == 4 and len(head) >= 375:
        points = struct.unpack_from("<Q", head, 247)[0] or legacy_points
    if header_bytes < _HEADER_BYTES[minor] or not header_bytes <= first_point <= file_bytes:
        raise FormatError(
            f"its header claims {header_bytes} bytes and points from byte {first_point:,} of {file_bytes:,}; it is "
            "truncated or damaged"
        )
    compressed = bool(code & 0x80)
    point_format = code & 0x3F
    _require_format(point_format, record_bytes)
    if not all(map(math.isfinite, numbers)) or not all(0 < value < 1e6 for value in numbers[:3]):
        scales = ", ".join(f"{value:.3g}" for value in numbers[:3])
        raise FormatError(f"its scales ({scales}) or bounds are not usable numbers; the LAS header is damaged")
    if records > min(_MAX_RECORDS, (first_point - header_bytes) // _RECORD_HEADER):
        raise FormatError(f"its header claims {records:,} variable length records, more than fit; it is damaged")
    variable = _variable_records(stream, header_bytes, first_point, records)
    here = file_bytes - first_point
    if compressed:
        _require_compressed(stream, variable, points, record_bytes, first_point, file_bytes)
    elif points * record_bytes > here:
        raise FormatError(
            f"its header claims {points:,} points of {record_bytes} bytes, but only {here:,} bytes follow; the file is "
            "truncated"
        )
    long_at, long_count = struct.unpack_from("<QI", head, 235) if minor == 4 and len(head) >= 375 else (0, 0)
    wkt = _wkt(variable) or _long_wkt(stream, long_at, long_count, file_bytes)
    x1, x0, y1, y0, z1, z0 = numbers[6:]
    return LasHeader(
        f"{major}.{minor}", point_format, record_bytes, compressed, points, first_point, numbers[:3], numbers[3:6],
        (x0, y0, z0), (x1, y1, z1), one_line(head[58:90].split(b"\0")[0].decode("latin-1"), 32), _crs_name(wkt),
    )  # fmt: skip


def _require_format(point_format: int, record_bytes: int) -> None:
    if point_format in _WAVEFORMS:
        raise FormatError(
            f"its points have the format {point_format}, with waveforms, which is not read: export the points alone "
            "(point format 6, 7 or 8; in las2las: -set_point_type 6)"
        )
    if point_format not in POINT_FORMATS:
        raise FormatError(
            f"its points have the format {point_format}; {', '.join(map(str, POINT_FORMATS))} are read: export it as "
            "LAS 1.4 with point format 6 or 7"
        )
    if record_bytes < POINT_FORMATS[point_format]:
        raise FormatError(
            f"its points take {record_bytes} bytes each; point format {point_format} needs "
            f"{POINT_FORMATS[point_format]}: the LAS header is damaged"
        )


def _variable_records(stream: io.BufferedReader, start: int, end: int, count: int) -> dict[tuple[str, int], bytes]:
    """Return the contents of the records by user and number."""
    found: dict[tuple[str, int], bytes] = {}
    at = start
    for _ in range(count):
        stream.seek(at)
        head = stream.read(_RECORD_HEADER)
        if len(head) < _RECORD_HEADER:
            break
        user = head[2:18].split(b"\0")[0].decode("latin-1").lower()
        number, size = struct.unpack_from("<HH", head, 18)
        at += _RECORD_HEADER + size
        if at > end:
            raise FormatError("its variable length records reach into its points; the LAS file is damaged")
        if (user, number) in (("lasf_projection", 2112), ("laszip encoded", 22204)):
            found[user, number] = stream.read(size)
    return found


def _require_compressed(
    stream: io.BufferedReader,
    variable: dict[tuple[str, int], bytes],
    points: int,
    record_bytes: int,
    first_point: int,
    file_bytes: int,
) -> None:
    """Refuse a LAZ file whose claims the decompressor would believe: it allocates what they say."""
    record = variable.get(("laszip encoded", 22204), b"")
    if len(record) < 34:
        raise FormatError("its points are compressed, but it has no LASzip record; the LAZ file is damaged")
    compressor, chunk = struct.unpack_from("<H", record, 0)[0], struct.unpack_from("<I", record, 12)[0]
    items = struct.unpack_from("<H", record, 32)[0]
    sizes = [struct.unpack_from("<HH", record, 34 + 6 * k)[1] for k in range(items) if 40 + 6 * k <= len(record)]
    if compressor not in (2, 3) or len(sizes) != items or sum(sizes) != record_bytes or chunk == 0:
        raise FormatError("its LASzip record disagrees with its header, or is of a kind that is not read; "
                          "decompress it to LAS (e.g. with las2las or PDAL)")  # fmt: skip
    if points > max(_ALWAYS_POINTS, _POINTS_PER_BYTE * file_bytes):
        raise FormatError(
            f"it claims {points:,} points in {file_bytes:,} bytes; a LAZ file of that size contains at most "
            f"{max(_ALWAYS_POINTS, _POINTS_PER_BYTE * file_bytes):,}: it is damaged"
        )
    if points == 0:
        return
    _require_chunks(stream, record, points, record_bytes, first_point, file_bytes)


def _require_chunks(
    stream: io.BufferedReader, record: bytes, points: int, record_bytes: int, first_point: int, file_bytes: int
) -> None:
    """Refuse a table of compressed chunks, or chunks, whose claimed sizes exceed the file."""
    chunk = struct.unpack_from("<I", record, 12)[0]
    stream.seek(first_point)
    table = struct.unpack("<q", stream.read(8).ljust(8, b"\0"))[0]
    if table == -1:  # a writer that could not seek back stores it at the end
        stream.seek(file_bytes - 8)
        table = struct.unpack("<q", stream.read(8))[0]
    if not first_point + 8 <= table <= file_bytes - 8:
        raise FormatError("its table of compressed chunks lies outside the file; the LAZ file is truncated")
    stream.seek(table)
    chunks = struct.unpack("<II", stream.read(8))[1]
    expected = points if chunk == _ANY_CHUNK else -(-points // chunk)
    if not (chunks == expected or (chunk == _ANY_CHUNK and chunks <= points)):
        raise FormatError(
            f"its table lists {chunks:,} compressed chunks, its header {expected:,}; it is truncated or damaged"
        )

    layers = _layers(record)
    if not layers:
        return
    try:
        import lazrs
    except ImportError as error:
        raise DependencyError('reading LAZ needs lazrs, which is not installed: pip install "laspy[lazrs]"') from error
    stream.seek(first_point)
    at = first_point + 8
    for _, size in lazrs.read_chunk_table(stream, lazrs.LazVlr(record)):
        stream.seek(at + record_bytes)
        sizes = stream.read(4 * (layers + 1)).ljust(4 * (layers + 1), b"\0")
        if at + size > table or sum(struct.unpack(f"<{layers + 1}I", sizes)[1:]) > size:
            raise FormatError("a compressed chunk claims more bytes than it has; the LAZ file is truncated or damaged")
        at += size


def _layers(record: bytes) -> int:
    """Return the number of separately compressed layers of a chunk, whose sizes it states; 0 for older points."""
    count = 0
    for k in range(struct.unpack_from("<H", record, 32)[0]):
        kind, size = struct.unpack_from("<HH", record, 34 + 6 * k)
        count += size if kind == _EXTRA_BYTES else _LAYERS.get(kind, 0)
    return count


def _wkt(variable: dict[tuple[str, int], bytes]) -> bytes:
    return variable.get(("lasf_projection", 2112), b"")


def _long_wkt(stream: io.BufferedReader, at: int, count: int, file_bytes: int) -> bytes:
    """Return the WKT of an extended variable length record behind the points; empty if there is none."""
    for _ in range(min(count, _MAX_RECORDS)):
        if not 0 < at <= file_bytes - _LONG_RECORD_HEADER:
            break
        stream.seek(at)
        head = stream.read(_LONG_RECORD_HEADER)
        user = head[2:18].split(b"\0")[0].decode("latin-1").lower()
        number, size = struct.unpack_from("<HQ", head, 18)
        if (user, number) == ("lasf_projection", 2112):
            return stream.read(min(size, _LARGEST_WKT))
        at += _LONG_RECORD_HEADER + size
    return b""


def _crs_name(wkt: Any) -> str:
    """Return the quoted name behind the first bracket of a WKT."""
    text = wkt.split(b"\0")[0].decode("utf-8", "replace")
    parts = text.split('"', 2)
    return one_line(parts[1], 80) if len(parts) == 3 and "[" in parts[0] else ""
