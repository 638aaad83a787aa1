"""Reader of PCD point clouds: ascii, binary and binary_compressed; organised, or gridded by spherical projection."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading, require_cells
from ladarreg_core.formats.scans.field_cloud import PACKED_COLOR_NAMES, scan_of_fields
from ladarreg_core.formats.scans.scan_request import IntensitySource
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan

_LONGEST_HEADER = 1 << 16
_MAX_FIELDS = 256
_LARGEST_FIELD = 1 << 16
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
# Measured peak memory of a read beyond the file's data: per point with its cell, per point alone, and per cell of a
# grid that is mostly empty.
_POINT_BYTES = 340
_HELD_BYTES = 120
_CELL_BYTES = 300
_LARGEST_GROWTH = 90  # of LZF: three bytes expand to at most 264
_TYPES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}


def sniff_pcd(head: bytes) -> bool:
    """Return whether these are the first bytes of a PCD header."""
    lines = [line.strip() for line in head[:1024].splitlines()]
    words = [line.split()[0] for line in lines if line and not line.startswith(b"#")]
    return head.lstrip().startswith(b"# .PCD") or (bool(words) and words[0] in (b"VERSION", b"FIELDS"))


def read_pcd(
    path: PathLike,
    *,
    origin: tuple[float, float, float] | None = None,
    intensity: IntensitySource = "auto",
    memory_bytes: int | None = None,
    report: Report | None = None,
) -> Scan:
    """Read a PCD cloud as a scan.

    Args:
        path: a cloud with x, y, z (m) and intensity; a `ring` field is used if present.
        origin: where the scanner stood, (3,) m in the file's coordinates; None: at their zero point, unless the pattern
            of the points says otherwise.
        intensity: `luma` takes the luminance of the colours.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress.

    Returns:
        The scan in the scanner's frame, whose axes are the file's. An organised cloud keeps its grid if its directions
        confirm it; any other cloud is gridded.

    Raises:
        FormatError: if the header is damaged, claims more than the file contains or than fits into memory, or if the
            points lack what is asked for as the intensity.
        ShapeError: if there are no returns.
    """
    with reading(path) as file:
        budget = ReadBudget.of(file.stat().st_size, memory_bytes)
        with open(file, "rb") as stream:
            header = _read_header(stream)
            _require_bytes(header, budget.file_bytes - header.data_offset)
            budget.require_cells(header.height, header.width, header.bytes_per_point + _POINT_BYTES)
            held = header.points * (header.bytes_per_point + _HELD_BYTES)
            most_cells = budget.cells_that_fit(_CELL_BYTES, besides_bytes=held)
            _report(report, 0)
            columns = _read_body(stream, header, budget.file_bytes - header.data_offset)
        _report(report, 1)
        scan = scan_of_fields(
            columns,
            (header.height, header.width),
            name=file.stem,
            intensity=intensity,
            origin=origin,
            pose=_pose(header.viewpoint),
            most_cells=most_cells,
        )
        _report(report, 2)
        return scan


@dataclass(frozen=True, slots=True)
class _Header:
    dtype: np.dtype[Any]
    width: int
    height: int
    viewpoint: tuple[float, ...]
    encoding: str
    data_offset: int

    @property
    def points(self) -> int:
        return self.width * self.height

    @property
    def numbers(self) -> int:
        """Count of numbers in a point's record."""
        return sum(math.prod(self.dtype[name].shape) for name in self.dtype.names or ())

    @property
    def bytes_per_point(self) -> int:
        """Memory that a point's record takes while it is read, bytes."""
        if self.encoding == "ascii":  # every number becomes a float64, in a table that is doubled while it grows
            return 16 * self.numbers
        return self.dtype.itemsize * (2 if self.encoding == "binary_compressed" else 1)


def _read_header(stream: io.BufferedReader) -> _Header:
    entries: dict[str, list[str]] = {}
    while "DATA" not in entries:
        line = stream.readline(_LONGEST_HEADER)
        if not line.endswith(b"\n") or stream.tell() > _LONGEST_HEADER:
            raise FormatError("the PCD header ends before its DATA line; the file is truncated or not a PCD")
        words = line.decode("latin-1").split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in _KEYS:
            raise FormatError(f"the PCD header has the line {one_line(line.decode('latin-1'), 60)!r}; it is damaged")
        entries[words[0]] = words[1:]
    fields = entries.get("FIELDS", [])
    if not 1 <= len(fields) <= _MAX_FIELDS:
        raise FormatError(f"the PCD header names {len(fields)} fields; it must name 1 to {_MAX_FIELDS}")
    sizes, types = _whole(entries, "SIZE", len(fields)), entries.get("TYPE", [])
    counts = _whole(entries, "COUNT", len(fields)) if "COUNT" in entries else [1] * len(fields)
    if len(types) != len(fields):
        raise FormatError(f"the PCD header has {len(fields)} FIELDS and {len(types)} TYPEs; they must agree")
    width = _whole(entries, "WIDTH", 1)[0]
    height = _whole(entries, "HEIGHT", 1)[0] if "HEIGHT" in entries else 1
    require_cells(height, width)
    if "POINTS" in entries and _whole(entries, "POINTS", 1)[0] != width * height:
        raise FormatError(f"the PCD header says POINTS {entries['POINTS'][0]}, but WIDTH x HEIGHT is {width * height}")
    encoding = " ".join(entries["DATA"]).lower()
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise FormatError(
            f"the PCD data are {one_line(encoding, 40)!r}; ascii, binary and binary_compressed are supported"
        )
    if 0 in counts and encoding == "binary":
        counts = _counts_by_size(stream, width * height, sizes, counts)
    dtype = _record_type(fields, sizes, types, counts)
    return _Header(dtype, width, height, _viewpoint(entries.get("VIEWPOINT")), encoding, stream.tell())


def _counts_by_size(stream: io.BufferedReader, points: int, sizes: list[int], counts: list[int]) -> list[int]:
    """Return the counts, where a 0 is none or, as old converters wrote it, one: the size of the body says which."""
    begin = stream.tell()
    body = stream.seek(0, io.SEEK_END) - begin
    stream.seek(begin)
    for meant in (counts, [max(count, 1) for count in counts]):
        record = sum(size * count for size, count in zip(sizes, meant, strict=True))
        if 0 <= body - points * record < max(record, 1):
            return meant
    raise FormatError(
        f"the PCD header has a COUNT of 0, and its {points:,} points fit {body:,} bytes neither with nor without that "
        "field; correct the header"
    )


def _whole(entries: dict[str, list[str]], key: str, count: int) -> list[int]:
    words = entries.get(key, [])
    if len(words) != count or not all(word.isascii() and word.isdigit() and len(word) <= 18 for word in words):
        found = one_line(" ".join(words), 40) or "missing"
        raise FormatError(f"the PCD header's {key} is {found!r}; it must be {count} whole number{'s' * (count > 1)}")
    return [int(word) for word in words]


def _record_type(fields: list[str], sizes: list[int], types: list[str], counts: list[int]) -> np.dtype[Any]:
    """Return the type of one point; repeated names (padding is called `_`) are numbered."""
    names: list[str] = []
    formats: list[Any] = []
    for field, size, letter, count in zip(fields, sizes, types, counts, strict=True):
        if size not in _TYPES.get(letter, ()):
            raise FormatError(
                f"the field {one_line(field, 30)!r} is of TYPE {letter[:3]} SIZE {size}; PCD has no such type"
            )
        if count > _LARGEST_FIELD:
            raise FormatError(f"the field {one_line(field, 30)!r} has COUNT {count}; it must be 0 to {_LARGEST_FIELD}")
        names.append(field if field not in names and field != "_" else f"_{len(names)}")
        code = f"<{letter.lower()}{size}"
        formats.append(code if count == 1 else (code, (count,)))
    return np.dtype({"names": names, "formats": formats})


def _viewpoint(words: list[str] | None) -> tuple[float, ...]:
    try:
        numbers = tuple(float(word) for word in words or ())
    except ValueError:
        numbers = ()
    return numbers if len(numbers) == 7 and np.isfinite(numbers).all() else (0, 0, 0, 1, 0, 0, 0)


def _read_body(stream: io.BufferedReader, header: _Header, there: int) -> dict[str, NDArray[Any]]:
    """Return the scalar fields by name, each (N,); nothing is allocated before its size has been checked."""
    count, dtype = header.points, header.dtype
    if header.encoding == "ascii":
        return _read_ascii(stream, header)
    if header.encoding == "binary":
        records = np.frombuffer(stream.read(count * dtype.itemsize), dtype=dtype, count=count)
        return {name: records[name] for name in _single(dtype)}
    sizes = np.frombuffer(stream.read(8).ljust(8, b"\0"), "<u4").tolist()
    if sizes[0] > there - 8:
        raise FormatError(
            f"the PCD body claims {sizes[0]:,} compressed bytes, {max(there - 8, 0):,} are present; it is truncated"
        )
    if sizes[1] != count * dtype.itemsize:
        raise FormatError(
            f"the PCD body contains {sizes[1]:,} bytes, but the header claims {count:,} points of {dtype.itemsize}"
        )
    data = lzf_decompress(stream.read(sizes[0]), sizes[1])
    columns: dict[str, NDArray[Any]] = {}
    at = 0
    for name in dtype.names or ():  # a compressed body stores one field after the other
        field = dtype[name]
        if not field.shape:
            columns[name] = np.frombuffer(data, dtype=field, count=count, offset=at)
        at += field.itemsize * count
    return columns


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Decompress LZF data, the body of a binary_compressed file, to `size` bytes.

    A token below 32 is followed by that many literal bytes plus one; any other token copies bytes from up to 8 KB back:
    three bits of length, five of distance. One pass in plain Python with a slice per token: 10 MB/s. Resolving the
    copies with NumPy was measured to take twice as long, since tokens are short and must be found sequentially.

    Raises:
        FormatError: if they are damaged, or decompress to another size.
    """
    if size > _LARGEST_GROWTH * len(data) + 32:
        raise FormatError(
            f"{len(data):,} compressed bytes claim to expand to {size:,}, which is impossible; the file is damaged"
        )
    out = bytearray()
    at = made = 0
    end = len(data)
    try:
        while at < end:
            token = data[at]
            at += 1
            if token < 32:
                after = at + token + 1
                out += data[at:after]
                at = after
                made += token + 1
                continue
            length = token >> 5
            if length == 7:
                length += data[at]
                at += 1
            length += 2
            distance = ((token & 31) << 8) + data[at] + 1
            at += 1
            begin = made - distance
            if begin < 0:
                raise FormatError("the compressed points refer to bytes before their start; the file is damaged")
            if distance >= length:
                out += out[begin : begin + length]
            else:  # the copy overlaps its source, which repeats
                out += (out[begin:] * (length // distance + 1))[:length]
            made += length
            if made > size:
                break
    except IndexError:
        raise FormatError("the compressed points end within a token; the file is truncated") from None
    if made != size or len(out) != size:
        raise FormatError(
            f"the compressed points expand to {len(out):,} bytes instead of {size:,}; the file is damaged"
        )
    return bytes(out)


def _require_bytes(header: _Header, there: int) -> None:
    """Refuse a header that claims more data than follow it; a compressed body states its own size."""
    if header.encoding == "ascii":
        least, what = (
            2 * header.points * header.numbers - 1,
            f"{header.numbers} numbers",
        )  # at least a digit and a separator each
    else:
        least, what = header.points * header.dtype.itemsize, f"{header.dtype.itemsize} bytes"
    if header.encoding != "binary_compressed" and there < least:
        raise FormatError(
            f"the PCD header claims {header.points:,} points of {what}, but only {max(there, 0):,} bytes follow; the "
            "file is truncated"
        )


def _single(dtype: np.dtype[Any]) -> list[str]:
    return [name for name in dtype.names or () if not dtype[name].shape]


def _read_ascii(stream: io.BufferedReader, header: _Header) -> dict[str, NDArray[Any]]:
    dtype, count = header.dtype, header.points
    lengths = [int(np.prod(dtype[name].shape, dtype=np.int64)) for name in dtype.names or ()]
    try:
        table = np.loadtxt(stream, dtype=np.float64, ndmin=2, max_rows=count, comments=None, encoding="latin-1")
    except ValueError as error:
        raise FormatError(f"its rows of numbers are damaged ({one_line(error, 80)})") from error
    if table.shape != (count, sum(lengths)):
        raise FormatError(
            f"the PCD header claims {count:,} points of {sum(lengths)} numbers, the file contains "
            f"{table.shape[0]:,} x {table.shape[1]}; it is truncated or damaged"
        )
    starts = np.cumsum([0, *lengths])
    columns: dict[str, NDArray[Any]] = {
        name: table[:, starts[k]] for k, name in enumerate(dtype.names or ()) if not dtype[name].shape
    }
    for name in set(columns) & set(PACKED_COLOR_NAMES):
        packed = columns[name]
        columns[name] = packed.astype(np.float32) if dtype[name].kind == "f" else _clipped_uint32(packed)
    return columns


def _clipped_uint32(values: NDArray[Any]) -> NDArray[np.uint32]:
    return np.asarray(np.clip(np.nan_to_num(values), 0, 2**32 - 1), dtype=np.uint32)


def _pose(viewpoint: tuple[float, ...]) -> Rigid | None:
    """Return the pose of VIEWPOINT (tx ty tz qw qx qy qz), or None for the identity."""
    x, y, z, *quaternion = viewpoint
    return pose_of_quaternion(quaternion, (x, y, z))


def pose_of_quaternion(quaternion: Any, translation: Any) -> Rigid | None:
    """Return the transform of a quaternion (w, x, y, z) of any length; None for the identity and for invalid values."""
    q, t = np.asarray(quaternion, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    length = float(np.linalg.norm(q))
    if not (np.isfinite(q).all() and np.isfinite(t).all() and length > 1e-9):
        return None
    w, x, y, z = q / length
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return None if np.array_equal(R, np.eye(3)) and not t.any() else Rigid(R, t)


def _report(report: Report | None, done: int) -> None:
    if report is not None:
        report(Progress(done, 2, "reading the cloud"))
