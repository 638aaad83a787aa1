"""Reader of PLY clouds: ascii, and binary of either byte order."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.number_rows import numbers_of, row_parts
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading
from ladarreg_core.formats.scans.cloud import most_cells_of, scan_of_cloud
from ladarreg_core.formats.scans.intensity import (
    as_points,
    chosen_intensity,
    color_names,
    colors_as_bytes,
    field_named,
    intensity_name,
    require_intensity,
)
from ladarreg_core.formats.scans.scan_request import IntensitySource
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.scan import Scan

_LONGEST_HEADER = 1 << 18
_LONGEST_LINE = 1 << 14
_MAX_PROPERTIES = 256
_LARGEST_COUNT = 10**12
_PART = 1 << 20  # points
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_ENCODINGS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_OURS = b"comment ladarreg: scanner frame"
_READ_BYTES = 35
"""Bytes that a point's coordinates, intensity and colours take."""


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: tuple[tuple[str, str], ...]
    """Names and type codes; the code is empty for a list."""

    @property
    def has_lists(self) -> bool:
        return any(not code for _, code in self.properties)

    def dtype(self, order: str) -> np.dtype[Any]:
        return np.dtype([(f"f{k}", order + code) for k, (_, code) in enumerate(self.properties)])


@dataclass(frozen=True, slots=True)
class _Header:
    encoding: str
    elements: tuple[_Element, ...]
    data_offset: int
    is_ours: bool
    """Whether a comment says that the points are in the scanner's frame, as our own export has it."""

    @property
    def is_ascii(self) -> bool:
        return self.encoding == "ascii"


def sniff_ply(head: bytes) -> bool:
    """Return whether these are the first bytes of a PLY file."""
    return head.startswith(b"ply") and head[:16].splitlines()[0].strip() == b"ply"


def read_ply(
    path: PathLike,
    *,
    origin: tuple[float, float, float] | None = None,
    intensity: IntensitySource = "auto",
    memory_bytes: int | None = None,
    report: Report | None = None,
) -> Scan:
    """Read a PLY cloud as a scan.

    Args:
        path: a file whose vertices have x, y, z (m) and an intensity under one of its usual names, or colours.
        origin: where the scanner stood, in the file's coordinates, m.
        intensity: `luma` takes the luminance of the colours.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress.

    Returns:
        The scan, on a grid of directions. The faces of a mesh are left out, and its notes say so.

    Raises:
        FormatError: if the header is damaged, claims more than the file contains or than fits into memory, or if the
            vertices lack what is asked for as the intensity.
        ShapeError: if there are too few returns for a grid.
    """
    with reading(path) as file:
        budget = ReadBudget.of(file.stat().st_size, memory_bytes)
        with open(file, "rb") as stream:
            header = _read_header(stream)
            at = [element.name for element in header.elements].index("vertex")
            vertex = header.elements[at]
            names = [name for name, code in vertex.properties if code]
            position = [field_named(names, (axis,)) for axis in "xyz"]
            strength, paint = intensity_name(names), color_names(names)
            listed = " ".join(names)
            if None in position:
                raise FormatError(
                    f"its vertices have {one_line(listed, 80)!r}; a scan needs x, y, z and intensity: export it again "
                    "with them"
                )
            faces = next((e.count for e in header.elements if e.name == "face"), 0)
            if faces and strength is None and paint is None:
                raise FormatError(
                    f"it is a mesh of {faces:,} faces whose vertices have {one_line(listed, 60)!r}, neither intensity "
                    "nor colours, so it is not a scan: export the scan's points"
                )
            require_intensity(
                intensity, has_intensity=strength is not None, has_color=paint is not None, what="its vertices",
                fields=listed,
            )  # fmt: skip
            most_cells = most_cells_of(budget, vertex.count, _READ_BYTES)
            wanted = [name for name in (*position, strength, *(paint or ())) if name is not None]
            _skip(stream, header, header.elements[:at], budget.file_bytes)
            columns = _read_vertices(stream, header, vertex, wanted, budget.file_bytes, report)
        notes = (f"the file is a mesh; its {vertex.count:,} vertices are the scan, its {faces:,} faces are left out",)
        color = None if paint is None else colors_as_bytes([columns.pop(name) for name in paint])
        points = as_points([columns.pop(name) for name in position if name is not None])
        laser = None if strength is None else columns[strength]
        value, said = chosen_intensity(intensity, laser, color, points.shape[:-1])
        return scan_of_cloud(
            points,
            value,
            color,
            name=file.stem,
            origin=origin,
            zero_is_stated=header.is_ours,
            most_cells=most_cells,
            notes=(*(notes if faces else ()), *said),
        )


def _read_header(stream: io.BufferedReader) -> _Header:
    encoding, is_ours = "", False
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    while True:
        line = stream.readline(_LONGEST_LINE)
        if not line.endswith(b"\n") or stream.tell() > _LONGEST_HEADER:
            raise FormatError("the PLY header does not come to its end_header; the file is truncated or not a PLY")
        words = line.decode("latin-1").split()
        if not words or words[0] in ("ply", "comment", "obj_info"):
            is_ours |= line.startswith(_OURS)
            continue
        if words[0] == "end_header":
            break
        if words[0] == "format" and len(words) >= 2:
            encoding = words[1]
            if encoding not in _ENCODINGS:
                raise FormatError(
                    f"the PLY format is {one_line(encoding, 30)!r}; {', '.join(_ENCODINGS)} are read: export it as one "
                    "of these"
                )
        elif words[0] == "element" and len(words) == 3 and words[2].isdigit() and len(words[2]) <= 12:
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property" and elements and len(words) >= 3:
            elements[-1][2].append(_property(words))
            if len(elements[-1][2]) > _MAX_PROPERTIES:
                raise FormatError(f"an element of the PLY has more than {_MAX_PROPERTIES} properties; it is damaged")
        else:
            raise FormatError(f"the PLY header has the line {one_line(' '.join(words), 60)!r}; it is damaged")
    if not encoding:
        raise FormatError("the PLY header does not state its format; it is damaged")
    found = tuple(_Element(name, count, tuple(properties)) for name, count, properties in elements)
    vertex = next((element for element in found if element.name == "vertex"), None)
    if vertex is None or not vertex.properties:
        raise FormatError("the PLY has no vertices; a scan needs x, y, z and intensity of its points")
    if vertex.has_lists:
        raise FormatError("the vertices of the PLY have lists, which are not read: export it with plain properties")
    if vertex.count == 0:
        raise FormatError("the PLY has 0 vertices; a scan needs points")
    return _Header(encoding, found, stream.tell(), is_ours)


def _property(words: list[str]) -> tuple[str, str]:
    if words[1] == "list":
        if len(words) < 5:
            raise FormatError(f"the PLY header has the line {one_line(' '.join(words), 60)!r}; it is damaged")
        return " ".join(words[4:]), ""
    if words[1] not in _TYPES:
        raise FormatError(
            f"the PLY property {one_line(words[-1], 30)!r} has the type {one_line(words[1], 20)!r}, which PLY does not "
            "have; it is damaged"
        )
    return " ".join(words[2:]), _TYPES[words[1]]


def _skip(stream: io.BufferedReader, header: _Header, elements: tuple[_Element, ...], size: int) -> None:
    """Skip the elements before the vertices."""
    for element in elements:
        if header.is_ascii:
            for _ in range(element.count):
                if not stream.readline(_LONGEST_LINE):
                    raise FormatError(f"the PLY ends within its {one_line(element.name, 30)!r}; it is truncated")
        elif element.count and element.has_lists:
            raise FormatError(
                f"the PLY has lists ({one_line(element.name, 30)!r}) before its vertices, which is not read: export "
                "the points alone"
            )
        else:
            stream.seek(min(stream.tell() + element.count * element.dtype("<").itemsize, size))


def _read_vertices(
    stream: io.BufferedReader, header: _Header, vertex: _Element, wanted: list[str], size: int, report: Report | None
) -> dict[str, NDArray[Any]]:
    """Return the wanted properties by name, each (N,), after a check that the file is large enough for them."""
    there = max(size - stream.tell(), 0)
    places = {name: k for k, (name, _) in reversed(list(enumerate(vertex.properties)))}
    record = vertex.dtype(_ENCODINGS[header.encoding] or "<")
    least = vertex.count * (2 * len(vertex.properties) if header.is_ascii else record.itemsize)
    if there + 1 < least:
        raise FormatError(
            f"the PLY header claims {vertex.count:,} vertices of {len(vertex.properties)} numbers, but only {there:,} "
            "bytes follow; the file is truncated"
        )
    types = {name: record[places[name]].newbyteorder("=") for name in wanted}
    columns: dict[str, NDArray[Any]] = {name: np.empty(vertex.count, types[name]) for name in wanted}
    if header.is_ascii:
        _read_ascii(stream, vertex, {name: places[name] for name in wanted}, columns, size, report)
        return columns
    for done in range(0, vertex.count, _PART):
        if report is not None:
            report(Progress(done, vertex.count, "reading the points"))
        count = min(_PART, vertex.count - done)
        records = np.frombuffer(stream.read(count * record.itemsize), dtype=record, count=count)
        for name, column in columns.items():
            column[done : done + count] = records[f"f{places[name]}"]
    if report is not None:
        report(Progress(vertex.count, vertex.count, "reading the points"))
    return columns


def _read_ascii(
    stream: io.BufferedReader,
    vertex: _Element,
    places: dict[str, int],
    columns: dict[str, NDArray[Any]],
    size: int,
    report: Report | None,
) -> None:
    done = 0
    for part in row_parts(stream, size, report=report, label="reading the points"):
        lines = part.splitlines(keepends=True) if done + part.count(b"\n") > vertex.count else None
        if lines is not None:  # what follows the vertices are faces
            part = b"".join([line for line in lines if line.strip()][: vertex.count - done])
        rows = numbers_of(part, len(vertex.properties))[: vertex.count - done]
        for name, column in columns.items():
            column[done : done + len(rows)] = _as_type(rows[:, places[name]], column.dtype)
        done += len(rows)
        if done >= vertex.count:
            return
    raise FormatError(
        f"the PLY header claims {vertex.count:,} vertices and the file contains {done:,}; it is truncated: copy or "
        "export it again"
    )


def _as_type(values: NDArray[np.float64], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return numbers in the type that the header states, clipped to what it can hold."""
    if dtype.kind in "iu":
        limits, exact = np.iinfo(dtype), 2.0**53
        low, high = max(float(limits.min), -exact), min(float(limits.max), exact)
        return np.clip(np.nan_to_num(values), low, high).astype(dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(dtype)
