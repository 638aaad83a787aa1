"""Reader of LAS and LAZ clouds; they have no grid and do not say where the scanner stood."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import DependencyError, FormatError, ShapeError, UnderspecifiedError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import PathLike, as_float32, one_line, reading
from ladarreg_core.formats.scans.cloud import scan_of_cloud
from ladarreg_core.formats.scans.las_header import LasHeader, read_las_header
from ladarreg_core.formats.scans.scan_request import IntensitySource
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import describe_position
from ladarreg_core.scan import LUMA_NOTE, NO_INTENSITY_NOTE, Scan, luma

INTENSITY_NAMES = ("reflectance", "amplitude", "intensity", "reflectivity", "signal")
"""Extra bytes that are intensities, in the order of preference."""
_CHUNK = 500_000
# Measured peak memory of a read: per point as read, per point with its own cell, and per cell of a nearly empty grid.
_POINT_BYTES = 60
_GRIDDED_BYTES = 220
_CELL_BYTES = 300


def read_las(
    path: PathLike,
    *,
    origin: tuple[float, float, float] | None = None,
    intensity: IntensitySource = "auto",
    memory_bytes: int | None = None,
    report: Report | None = None,
) -> Scan:
    """Read a LAS 1.0 to 1.4 or LAZ cloud as a scan.

    Args:
        path: a cloud of point format 0 to 3 or 6 to 8, in metres.
        origin: where the scanner stood, (3,) m in the file's coordinates; None: found from the pattern of the points.
        intensity: `luma` takes the luminance of the colours; `auto` the intensity, or, where that is the same for all
            points, extra bytes with the name of an intensity.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress, in points.

    Returns:
        The scan in the scanner's frame, whose axes are the file's; `world_from_scanner` leads to the file's
        coordinates. Points that are marked as withheld are left out.

    Raises:
        DependencyError: if laspy or lazrs is not installed.
        FormatError: if it is damaged, has waveforms or no colours to take as intensity, or would need more memory than
            it may use.
        ShapeError: if there are too few points.
        UnderspecifiedError: if it is neither given nor clear where the scanner stood.
    """
    with reading(path) as file:
        budget = ReadBudget.of(file.stat().st_size, memory_bytes)
        with open(file, "rb") as stream:
            header = read_las_header(stream, budget.file_bytes)
        if header.points == 0:
            raise ShapeError("it has no points; a scan needs measured ranges")
        held = header.points * _POINT_BYTES
        budget.require(held + header.points * _GRIDDED_BYTES, f"its {header.points:,} points")
        points, columns, withheld = _read_points(file, header, report)
        notes = [] if not withheld else [f"{withheld:,} points that are marked as withheld were left out"]
        if header.crs:
            notes.append(f"the file's coordinate reference system is {header.crs}")
        color = _eight_bits(columns.pop("rgb", None))
        strength, said = _intensity(columns, color, intensity)
        return scan_of_cloud(
            points,
            strength,
            color,
            name=file.stem,
            origin=origin,
            most_cells=budget.cells_that_fit(_CELL_BYTES, besides_bytes=held),
            notes=[*notes, *said],
        )


def las_facts(header: LasHeader) -> dict[str, str]:
    """Return what the header says, as texts for the user, by name."""
    extent = " x ".join(f"{b - a:,.1f}" for a, b in zip(header.lowest, header.highest, strict=True))
    return {
        "format": f"{'LAZ' if header.compressed else 'LAS'} {header.version}, point format {header.point_format}",
        "bounds": f"{extent} m from {describe_position(header.lowest)}",
    }


def read_las_columns(
    path: PathLike, *, report: Report | None = None
) -> tuple[NDArray[np.float64], dict[str, NDArray[Any]], int]:
    """Return the points (N, 3) float64 of a LAS or LAZ file, its other columns by name, and how many were withheld.

    Raises:
        FormatError: if it is damaged, or of a version or point format that is not read.
    """
    with reading(path) as file:
        with open(file, "rb") as stream:
            header = read_las_header(stream, file.stat().st_size)
        return _read_points(file, header, report)


def _read_points(
    file: Path, header: LasHeader, report: Report | None
) -> tuple[NDArray[np.float64], dict[str, NDArray[Any]], int]:
    """Return the points (N, 3), the other columns by name, and the number of points that were left out."""
    try:
        import laspy
    except ImportError as error:
        raise DependencyError('reading LAS needs laspy, which is not installed: pip install "laspy[lazrs]"') from error
    count, label = header.points, f"reading {one_line(file.name, 40)}"
    if report is not None:
        report(Progress(0, count, label))
    points = np.empty((count, 3))
    columns: dict[str, NDArray[Any]] = {"intensity": np.empty(count, np.uint16)}
    if header.has_color:
        columns["rgb"] = np.empty((count, 3), np.uint16)
    done = withheld = 0
    with laspy.open(file, read_evlrs=False) as source:
        names = list(source.header.point_format.dimension_names)
        extra = {name: name for name in source.header.point_format.extra_dimension_names}
        wanted = {name: f"extra {name}" for name in extra if name.lower() in INTENSITY_NAMES}
        columns |= {key: np.empty(count, np.float32) for key in wanted.values()}
        if source.header.point_count != count or source.header.point_format.id != header.point_format:
            raise FormatError("its header is read in two ways; it is damaged")
        for chunk in source.chunk_iterator(_CHUNK):
            stop = done + len(chunk)
            if stop > count:
                raise FormatError("it contains more points than its header claims; it is damaged")
            use: Any = slice(None)
            if "withheld" in names and (marked := np.asarray(chunk.withheld, np.bool_)).any():
                use = ~marked
                withheld += int(marked.sum())
                stop = done + int(use.sum())
            for axis, name in enumerate("XYZ"):
                target = points[done:stop, axis]
                np.multiply(chunk[name][use], header.scale[axis], out=target)
                target += header.offset[axis]
            columns["intensity"][done:stop] = chunk["intensity"][use]
            if header.has_color:
                for k, name in enumerate(("red", "green", "blue")):
                    columns["rgb"][done:stop, k] = chunk[name][use]
            for name, key in wanted.items():
                values = np.asarray(chunk[name])
                columns[key][done:stop] = as_float32(values if values.ndim == 1 else values[:, 0])[use]
            done = stop
            if report is not None:
                report(Progress(done + withheld, count, label))
    if done + withheld != count:
        raise FormatError(f"it ends after {done + withheld:,} of {count:,} points; it is truncated")
    return points[:done], {name: values[:done] for name, values in columns.items()}, withheld


def _eight_bits(rgb: NDArray[Any] | None) -> ByteArray | None:
    """Return colours (N, 3) of 8 bits: the standard has 16, but many writers store 8 in them; None if all are black."""
    if rgb is None or not rgb.any():
        return None
    return np.asarray(rgb if rgb.max() < 256 else rgb >> 8, dtype=np.uint8)


def _intensity(
    columns: Mapping[str, NDArray[Any]], color: ByteArray | None, source: IntensitySource
) -> tuple[NDArray[np.float32], list[str]]:
    """Return the intensity (N,) and a note where it is not the field of that name."""
    if source == "luma":
        if color is None:
            raise FormatError("it has no colours to take the luminance of; leave `intensity='luma'` out")
        return luma(color), [LUMA_NOTE]
    if _varies(columns["intensity"]):
        return as_float32(columns["intensity"]), []
    extra = {name[6:]: values for name, values in columns.items() if name.startswith("extra ")}
    for name in sorted(extra, key=lambda each: INTENSITY_NAMES.index(each.lower())):
        if _varies(extra[name]):
            return extra[name], [f"the intensity was read from the extra bytes {one_line(name, 40)!r}"]
    if color is not None:
        raise UnderspecifiedError(
            "all its points have the same intensity; an intensity is needed for matching: export it again with "
            "intensity, or take the luminance of its colours by `intensity='luma'`"
        )
    return as_float32(columns["intensity"]), [NO_INTENSITY_NOTE]


def _varies(values: NDArray[Any]) -> bool:
    finite = values[np.isfinite(values)]
    return bool(finite.size) and bool((finite != finite[0]).any())
