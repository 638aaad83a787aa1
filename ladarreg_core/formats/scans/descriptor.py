"""Descriptor JSON: metadata that turn plain depth images and raw count files into scans."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import CameraError, FormatError, ShapeError
from ladarreg_core.formats.cameras.camera_file import pinhole_from_fields
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.byte_order import require_byte_order
from ladarreg_core.formats.parsing.json_file import choice, number, read_json_object, whole_number
from ladarreg_core.formats.parsing.untrusted import (
    PathLike,
    as_float32,
    inside_folder,
    one_line,
    reading,
    require_cells,
    unit_notes,
)
from ladarreg_core.formats.photos.image_file import read_image
from ladarreg_core.formats.scans.npz import OFFSETS, SCALARS, counts_geometry
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.scan import NO_INTENSITY_NOTE, IntensityKind, Scan
from ladarreg_core.scanner.grids import PinholeGrid, range_from_counts

# Measured peak memory per cell of a read; undistorting takes the most.
_DEPTH_BYTES = 300
_PLAIN_DEPTH_BYTES = 160
_COUNTS_BYTES = 80
KINDS = ("depth-image", "counts")
_DTYPE = re.compile(r"([<>|]?)([iuf])([1248])")
_DTYPE_WORDS = {
    "uint8": "u1", "int8": "i1", "uint16": "<u2", "int16": "<i2", "uint32": "<u4", "int32": "<i4", "uint64": "<u8",
    "int64": "<i8", "float32": "<f4", "float64": "<f8",
}  # fmt: skip


def read_descriptor(path: PathLike, *, memory_bytes: int | None = None, report: Report | None = None) -> Scan:
    """Read the scan described by a descriptor.

    Args:
        path: a JSON object with `kind` `depth-image` or `counts`.
        memory_bytes: memory that the read may use, bytes; None: see `budget`, for the total size of its files.
        report: receives the progress.

    Raises:
        FormatError: if a field is missing or invalid, a file that it names is missing, damaged or outside its folder,
            or they would need more memory than may be used.
        ShapeError: if images and camera differ in size, or there is no return.
        CameraError: if the camera is missing or invalid.
    """
    with reading(path) as file:
        fields = read_json_object(file, "a scan descriptor")
        if "kind" not in fields:
            names = one_line(", ".join(list(fields)[:6]), 80) or "nothing"
            raise FormatError(f"it is JSON with {names}, but not a scan: a descriptor has 'kind': {' or '.join(KINDS)}")
        kind = choice(fields, "kind", KINDS)
        reader = _depth_image if kind == "depth-image" else _counts
        return reader(file, fields, memory_bytes, report)


def named_files(fields: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the files that a descriptor names, as paths relative to its folder; none that would lead out of it."""
    wanted = ("depth", "intensity") if fields.get("kind") == "depth-image" else ("file", "intensity_file")
    names = [fields[name] for name in wanted if isinstance(fields.get(name), str)]
    return tuple(dict.fromkeys(name for name in names if _is_plain(name)))


def _is_plain(name: str) -> bool:
    """Return whether every system takes a name for a path inside the folder."""
    parts = name.split("/")
    return name.isprintable() and not any(
        not part or part.startswith((".", " ")) or part.endswith((".", " ")) or set(part) & set('<>:"|?*\\')
        for part in parts
    )


def _intensity_is(fields: Mapping[str, Any]) -> IntensityKind:
    word = choice(fields, "intensity_is", ("raw", "range_normalised"), "raw")
    return "raw" if word == "raw" else "range_normalised"


def _budget(file: Path, fields: Mapping[str, Any], names: tuple[str, ...], memory_bytes: int | None) -> ReadBudget:
    """Return the budget of a descriptor and the files that it names."""
    targets = [inside_folder(file.parent, fields[name], f"the file of {name!r}") for name in names if fields.get(name)]
    files = {file.resolve(), *(target for target in targets if target.is_file())}
    return ReadBudget.of(sum(each.stat().st_size for each in files), memory_bytes)


def _depth_image(file: Path, fields: Mapping[str, Any], memory_bytes: int | None, report: Report | None) -> Scan:
    if fields.get("intensity") is None:
        raise FormatError("the field 'intensity' is missing; a scan needs the laser's intensity, too")
    unit = number(fields, "depth_unit_m")
    if unit <= 0:
        raise FormatError(f"'depth_unit_m' is {unit:g}; it must be the positive length of one depth unit in metres")
    is_z = choice(fields, "depth_is", ("z", "range")) == "z"
    if not isinstance(fields.get("camera"), dict):
        raise CameraError("the field 'camera' is missing; a depth image needs width, height, fx, fy, cx, cy")
    geometry = PinholeGrid(pinhole_from_fields(fields["camera"]))
    require_cells(*geometry.shape)
    budget = _budget(file, fields, ("depth", "intensity"), memory_bytes)
    budget.require_cells(*geometry.shape, _DEPTH_BYTES if geometry.camera.distortion else _PLAIN_DEPTH_BYTES)
    depth = _plane(file, fields, "depth", geometry.shape, budget)
    _report(report, 1)
    intensity = _plane(file, fields, "intensity", geometry.shape, budget)
    _report(report, 2)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        metres = depth.astype(np.float64) * unit
        # z is measured along the camera's axis, which is the scanner's X.
        ranges = as_float32(metres / geometry.rays[..., 0] if is_z else metres)
    return Scan(
        geometry,
        ranges,
        as_float32(intensity),
        intensity_is=_intensity_is(fields),
        name=file.parent.name if file.stem == "scan" else file.stem,
        notes=unit_notes(ranges),
    )


def _plane(
    file: Path, fields: Mapping[str, Any], name: str, shape: tuple[int, int], budget: ReadBudget
) -> NDArray[Any]:
    target = inside_folder(file.parent, fields.get(name), f"the file of {name!r}")
    with reading(target) as picture:
        values = read_image(picture, budget=budget).values
    if values.ndim != 2:
        raise ShapeError(f"the image in {name!r} has colours; it must have one channel")
    if values.shape != shape:
        found, wanted = (" x ".join(map(str, s[::-1])) for s in (values.shape, shape))
        raise ShapeError(f"the image in {name!r} is {found} pixels, the camera {wanted}; they must agree")
    return values


def _counts(file: Path, fields: Mapping[str, Any], memory_bytes: int | None, report: Report | None) -> Scan:
    rows, columns = whole_number(fields, "rows", least=1), whole_number(fields, "columns", least=1)
    require_cells(rows, columns)
    scalars = {name: number(fields, name) for name in SCALARS} | {name: number(fields, name, 0.0) for name in OFFSETS}
    packed = fields.get("intensity_mask") is not None
    if packed and fields.get("intensity_file") is not None:
        raise FormatError("it names both 'intensity_file' and 'intensity_mask'; the intensity is in one of them")
    budget = _budget(file, fields, ("file", "intensity_file"), memory_bytes)
    budget.require_cells(rows, columns, _COUNTS_BYTES)
    words, notes = _raster(file, fields, "file", "dtype", (rows, columns))
    _report(report, 1)
    counts = _bits(words, fields, "count")
    _require_byte_order(words, counts, fields)
    if packed:
        intensity = _bits(words, fields, "intensity")
    elif fields.get("intensity_file") is None:
        intensity, notes = np.zeros(counts.shape, np.float32), (*notes, NO_INTENSITY_NOTE)
    else:
        intensity, more = _raster(file, fields, "intensity_file", "intensity_dtype", (rows, columns))
        notes += more
    _report(report, 2)
    if counts.dtype.kind == "i" and counts.min() < 0:
        raise FormatError(f"the counts contain {counts.min()}; check 'dtype' and its byte order")
    geometry = counts_geometry((rows, columns), scalars)
    ranges = as_float32(range_from_counts(counts, scalars["r0_m"], scalars["dr_m"]))
    return Scan(
        geometry,
        ranges,
        as_float32(intensity),
        intensity_is=_intensity_is(fields),
        name=file.parent.name if file.stem == "scan" else file.stem,
        notes=(*notes, *unit_notes(ranges)),
    )


def _require_byte_order(words: NDArray[Any], counts: NDArray[Any], fields: Mapping[str, Any]) -> None:
    code = str(fields.get("dtype"))
    order = "<" if _dtype(code, "dtype").byteorder == ">" else ">"
    other = f"{order}{words.dtype.str.lstrip('<>=|')}"
    swapped = _bits(words.byteswap(), fields, "count")
    if words.dtype.itemsize > 1:
        require_byte_order(counts, swapped, what="the counts", wanted=f"'dtype' should be {other!r}, not {code!r}")


def _raster(
    file: Path, fields: Mapping[str, Any], name: str, type_name: str, shape: tuple[int, int]
) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Return the values of a raw file, and a note if it is longer than expected."""
    dtype = _dtype(fields.get(type_name, fields.get("dtype") if type_name != "dtype" else None), type_name)
    if name == "file" and dtype.kind == "f":
        raise FormatError(f"'dtype' is {dtype.str!r}; counts are integers: give an integer type such as '>u2'")
    header = whole_number(fields, "header_bytes", 0) if name == "file" else 0
    target = inside_folder(file.parent, fields.get(name), f"the file of {name!r}")
    count = shape[0] * shape[1]
    with reading(target) as raster:
        there, needed = raster.stat().st_size, header + count * dtype.itemsize
        if there < needed:
            raise FormatError(
                f"it has {there:,} bytes; {shape[0]} x {shape[1]} values of {dtype.itemsize} bytes and {header} header "
                f"bytes need {needed:,}: check rows, columns and dtype"
            )
        values = np.fromfile(raster, dtype=dtype, count=count, offset=header).reshape(shape)
    notes = () if there == needed else (f"{target.name} has {there - needed:,} bytes more than the descriptor says",)
    return values.astype(dtype.newbyteorder("=")), notes


def _dtype(code: Any, name: str) -> np.dtype[Any]:
    """Return a numeric type; without a byte order it is little-endian."""
    text = _DTYPE_WORDS.get(code, code) if isinstance(code, str) else ""
    match = _DTYPE.fullmatch(text)
    if match is None or (match[2] == "f" and match[3] in "12"):
        raise FormatError(
            f"{name!r} is {one_line(repr(code), 40)}; it must be a NumPy code with its byte order, such as '<u2'"
        )
    return np.dtype(f"{match[1].replace('|', '') or '<'}{match[2]}{match[3]}")


def _bits(words: NDArray[Any], fields: Mapping[str, Any], name: str) -> NDArray[Any]:
    """Return (word >> shift) & mask, or the unchanged words where neither is given."""
    if fields.get(f"{name}_mask") is None and fields.get(f"{name}_shift") is None:
        return words
    bits = words.dtype.itemsize * 8
    shift = whole_number(fields, f"{name}_shift", 0)
    mask = whole_number(fields, f"{name}_mask", (1 << min(bits, 52)) - 1, least=1)
    if shift >= bits or mask >= 1 << bits:
        raise FormatError(f"{name}_shift {shift} and {name}_mask {mask} do not fit words of {bits} bits")
    unsigned = words.view(words.dtype.str.replace("i", "u"))
    return np.asarray((unsigned >> unsigned.dtype.type(shift)) & unsigned.dtype.type(mask))


def _report(report: Report | None, done: int) -> None:
    if report is not None:
        report(Progress(done, 2, "reading the scan"))
