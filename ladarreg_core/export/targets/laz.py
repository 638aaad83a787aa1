"""The target `laz`: the coloured cloud as LAS 1.4, compressed.

A cloud that was read from LAS or LAZ is copied point by point: its coordinates, all its fields and its records stay as
they were, colours and three extra bytes are added. Any other scan is written anew, in the world where that is known.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import ladarreg_core
from ladarreg_core.arrays import FloatArray
from ladarreg_core.export.atomic_write import cannot_write
from ladarreg_core.export.folder import FileJob
from ladarreg_core.export.json import write_document
from ladarreg_core.export.targets.registered_scan import RegisteredScan
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.frames import Rigid
from ladarreg_core.progress import Progress, Report
from ladarreg_core.scan import Scan
from ladarreg_core.surface.best_photo import NO_PHOTO, PointColours
from ladarreg_core.surface.texture import Label, intensity_levels, intensity_rows

if TYPE_CHECKING:
    import laspy

EXTRA_BYTES = {
    "photo_id": ("uint16", "photograph, see legend; 0: none"),
    "label": ("uint8", "visibility class, see legend"),
    "sigma_px": ("float32", "uncertainty in photograph, px"),
}
"""Extra bytes that are added: type and description, at most 32 characters."""
_CHUNK = 500_000
_SCALE_M = 1e-4
_COARSER_SCALE_M = 1e-3
_LARGEST_INTEGER = 2**31 - 1
_OFFSET_ROUNDED_TO_M = 100.0
_WITHOUT_COLOUR = {0: 2, 1: 3, 6: 7}
_NEW_FORMATS = {0: 7, 1: 7, 2: 7, 3: 7, 6: 7, 7: 7, 8: 8}
_GEOTIFF_RECORDS = (34735, 34736, 34737)
_WKT_RECORD = 2112
_PROJECTION = "LASF_Projection"
_LEGEND_RECORD = 1
_SIXTEEN_BITS = 257  # 255 becomes 65535
_SCAN_ANGLE_STEP_DEG = 0.006


def laz_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return the cloud and `legend.json`, which explains photo ids and labels."""
    del options
    source = _las_source(handed)
    stem = "cloud" if handed.scan_file is None else handed.scan_file.stem
    name = f"{stem}.laz"

    def write(path: Path) -> None:
        try:
            if source is None:
                _write_scan(path, handed, report)
            else:
                _write_copy(path, source, handed, report)
        except OSError as error:
            raise cannot_write(path, error) from None

    return [("legend.json", lambda path: write_document(path, legend(handed, source))), (name, write)]


def legend(handed: RegisteredScan, source: Path | None) -> dict[str, Any]:
    """Return what the extra bytes and the coordinates mean."""
    if source is not None:
        frame = "the coordinates of the source file, unchanged"
    elif handed.scan.world_from_scanner is None:
        frame = "scanner frame, X forward, Y left, Z up; metres"
    else:
        frame = "world frame, as the scan's file states it; metres"
    return {
        "coordinates": frame,
        "photo_id": {"0": None, **{str(k): one.photo.name for k, one in enumerate(handed.photos, 1)}},
        "poses": {str(k): one.mark or "accepted" for k, one in enumerate(handed.photos, 1)},
        "label": {str(int(label)): label.name.lower().replace("_", " ") for label in Label},
        "sigma_px": "standard deviation of the point's position in the photograph, px; NaN where it is not known",
        "colour": "of the photograph; where none shows the point, that of the source file, or gray laser intensity",
        "software": f"ladarreg {ladarreg_core.__version__}",
    }


def _las_source(handed: RegisteredScan) -> Path | None:
    """Return the scan's file if it is LAS or LAZ."""
    path = handed.scan_file
    if path is None or not path.is_file():
        return None
    with open(path, "rb") as file:
        return path if file.read(4) == b"LASF" else None


# A cloud that was read from LAS.


def _write_copy(path: Path, source: Path, handed: RegisteredScan, report: Report | None) -> None:
    import laspy

    colourer = handed.point_colourer()
    scanner_from_file = (handed.scan.world_from_scanner or Rigid.identity()).inverse
    with laspy.open(source) as reader:
        header, names = _header_like(reader.header, handed, source)
        count, done = reader.header.point_count, 0
        with _writer(path, header) as writer:
            for chunk in reader.chunk_iterator(_CHUNK):
                xyz = np.stack([chunk[axis] * s for axis, s in zip("XYZ", reader.header.scales, strict=True)], axis=-1)
                xyz += reader.header.offsets
                points = scanner_from_file @ xyz
                record = _converted(chunk, header)
                gray = _gray_of(chunk.intensity, handed.scan)
                _set_colours(record, names, colourer.colours_of(points), _colours_before(chunk, gray))
                writer.write_points(record)
                done += len(chunk)
                _report(report, done, count, path)
            if reader.evlrs and header.version.minor >= 4:
                writer.write_evlrs(reader.evlrs)


def _header_like(source: laspy.LasHeader, handed: RegisteredScan, path: Path) -> tuple[Any, Mapping[str, str]]:
    """Return the header of the copy, and the names of the added extra bytes.

    LAS 1.4 needs WKT for the point formats from 6 on: a file whose reference system is in GeoTIFF keys alone stays in
    its version, in the point format of its own with colours.
    """
    import laspy

    old = source.point_format.id
    records = {(vlr.user_id, vlr.record_id) for vlr in source.vlrs}
    geotiff = any((_PROJECTION, key) in records for key in _GEOTIFF_RECORDS)
    wkt = (_PROJECTION, _WKT_RECORD) in records or any(
        getattr(vlr, "record_id", 0) == _WKT_RECORD for vlr in source.evlrs or ()
    )
    stays = geotiff and not wkt
    number = _WITHOUT_COLOUR.get(old, old) if stays else _NEW_FORMATS[old]
    lowest = {2: "1.2", 3: "1.2"}.get(number, "1.4")
    header = laspy.LasHeader(point_format=number, version=max(str(source.version), lowest) if stays else "1.4")
    header.scales, header.offsets = source.scales, source.offsets
    header.system_identifier, header.file_source_id = source.system_identifier, source.file_source_id
    header.generating_software = f"ladarreg {ladarreg_core.__version__}"
    header.creation_date, header.uuid = source.creation_date, source.uuid
    header.global_encoding = source.global_encoding
    header.global_encoding.wkt = number >= 6
    own = ("ExtraBytesVlr", "LasZipVlr")
    header.vlrs.extend([vlr for vlr in source.vlrs if type(vlr).__name__ not in own])
    taken = {name.lower() for name in source.point_format.dimension_names}
    for dimension in source.point_format.extra_dimensions:
        header.add_extra_dim(
            laspy.ExtraBytesParams(
                name=dimension.name,
                type=_type_of(dimension),
                description=dimension.description,
                offsets=dimension.offsets,
                scales=dimension.scales,
                no_data=dimension.no_data,
            )
        )
    names = {}
    for name, (kind, description) in EXTRA_BYTES.items():
        names[name] = name if name not in taken else next(n for n in _numbered(f"ladarreg_{name}") if n not in taken)
        header.add_extra_dim(laspy.ExtraBytesParams(name=names[name], type=kind, description=description))
    _add_legend(header, handed, path)
    return header, names


def _numbered(name: str) -> Iterator[str]:
    yield name
    number = 2
    while True:
        yield f"{name}_{number}"
        number += 1


def _type_of(dimension: Any) -> Any:
    base = dimension.dtype.base
    return base if dimension.num_elements == 1 else np.dtype((base, (dimension.num_elements,)))


def _converted(chunk: Any, header: Any) -> Any:
    """Return points in the format of a header; coordinates and all other values are those of the chunk, bit for bit."""
    import laspy

    record = laspy.ScaleAwarePointRecord.zeros(len(chunk), header=header)
    there = set(record.point_format.dimension_names)
    for name in chunk.point_format.dimension_names:
        if name in there:
            target = record.array[name] if name in (record.array.dtype.names or ()) else None
            plain = target is not None and name in (chunk.array.dtype.names or ())
            if plain:
                record.array[name] = chunk.array[name]  # as stored: scaled extra bytes are not rounded again
            else:
                record[name] = chunk[name]
        elif name == "scan_angle_rank" and "scan_angle" in there:
            record["scan_angle"] = np.rint(np.asarray(chunk[name], np.float64) / _SCAN_ANGLE_STEP_DEG).astype(np.int16)
    return record


def _colours_before(chunk: Any, gray: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the colours (N, 3) of points that no photograph shows: their own, or gray."""
    if "red" not in chunk.point_format.dimension_names:
        return np.repeat(gray[:, None], 3, axis=1)
    return np.stack([np.asarray(chunk[name], np.uint16) for name in ("red", "green", "blue")], axis=-1)


def _gray_of(intensity: Any, scan: Scan) -> NDArray[np.uint16]:
    return intensity_rows(np.asarray(intensity, np.float32), intensity_levels(scan)).astype(np.uint16) * _SIXTEEN_BITS


# A scan of another format.


@dataclass(frozen=True, slots=True)
class _Coordinates:
    """Scale and offset of written coordinates."""

    scale_m: float
    offset_m: FloatArray


def _write_scan(path: Path, handed: RegisteredScan, report: Report | None) -> None:
    import laspy

    scan, colours = handed.scan, handed.colours
    pose = scan.world_from_scanner or Rigid.identity()
    coordinates = _coordinates(scan, pose)
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, coordinates.scale_m), coordinates.offset_m
    header.generating_software = f"ladarreg {ladarreg_core.__version__}"
    header.global_encoding.wkt = True
    for name, (kind, description) in EXTRA_BYTES.items():
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=kind, description=description))
    _add_legend(header, handed, None)
    levels, factor = intensity_levels(scan), _intensity_factor(scan)
    count, done = int(np.count_nonzero(scan.valid)), 0
    rows_at_once = max(1, _CHUNK // scan.shape[1])
    with _writer(path, header) as writer:
        for first in range(0, scan.shape[0], rows_at_once):
            rows = slice(first, first + rows_at_once)
            valid = scan.valid[rows]
            xyz = pose @ scan.points_at(rows, slice(None))[valid].astype(np.float64)
            record = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header)
            for k, axis in enumerate("XYZ"):
                record[axis] = np.rint((xyz[:, k] - coordinates.offset_m[k]) / coordinates.scale_m).astype(np.int32)
            intensity = scan.intensity[rows][valid]
            record["intensity"] = np.clip(np.rint(np.nan_to_num(intensity) * factor), 0, 65535).astype(np.uint16)
            record["return_number"] = record["number_of_returns"] = np.ones(len(xyz), np.uint8)
            found = PointColours(
                colours.image[rows][valid],
                colours.labels[rows][valid],
                colours.photo[rows][valid],
                colours.sigma_px[rows][valid],
            )
            before = _colours_of_scan(scan, rows, valid, levels)
            _set_colours(record, {name: name for name in EXTRA_BYTES}, found, before)
            writer.write_points(record)
            done += len(xyz)
            _report(report, done, count, path)


def _coordinates(scan: Scan, pose: Rigid) -> _Coordinates:
    """Return a scale and an offset that hold all coordinates of a scan."""
    reach = float(np.nanmax(scan.ranges))
    large = np.abs(pose.translation).max() > _OFFSET_ROUNDED_TO_M
    offset = np.round(pose.translation / _OFFSET_ROUNDED_TO_M) * _OFFSET_ROUNDED_TO_M + 0.0 if large else np.zeros(3)
    fine = (reach + _OFFSET_ROUNDED_TO_M) / _SCALE_M < _LARGEST_INTEGER
    return _Coordinates(_SCALE_M if fine else _COARSER_SCALE_M, offset)


def _intensity_factor(scan: Scan) -> float:
    """Return the factor that brings intensities into 16 bits: 1 where they are whole numbers that fit."""
    largest = float(np.nanmax(scan.intensity)) if np.isfinite(scan.intensity).any() else 0.0
    some = scan.intensity[:: max(1, scan.shape[0] // 64)]
    some = some[np.isfinite(some)]
    fits = largest <= 65535 and float(some.min(initial=0.0)) >= 0 and bool((some == np.rint(some)).all())
    return 1.0 if fits or largest <= 0 else 65535.0 / largest


def _colours_of_scan(
    scan: Scan, rows: slice, valid: NDArray[np.bool_], levels: tuple[float, float]
) -> NDArray[np.uint16]:
    if scan.color is not None:
        return scan.color[rows][valid].astype(np.uint16) * np.uint16(_SIXTEEN_BITS)
    gray = intensity_rows(scan.intensity[rows][valid], levels).astype(np.uint16) * np.uint16(_SIXTEEN_BITS)
    return np.repeat(gray[:, None], 3, axis=1)


# Both.


def _set_colours(record: Any, names: Mapping[str, str], found: PointColours, before: NDArray[np.uint16]) -> None:
    shown = found.photo != NO_PHOTO
    rgb = np.where(shown[:, None], found.colour.astype(np.uint16) * np.uint16(_SIXTEEN_BITS), before)
    for k, name in enumerate(("red", "green", "blue")):
        record[name] = rgb[:, k]
    record[names["photo_id"]] = np.where(shown, found.photo + np.uint16(1), 0).astype(np.uint16)
    record[names["label"]] = found.labels
    record[names["sigma_px"]] = found.sigma_px


def _add_legend(header: Any, handed: RegisteredScan, source: Path | None) -> None:
    import laspy

    text = json.dumps(legend(handed, source), ensure_ascii=True).encode()[:65000]
    header.vlrs.append(laspy.VLR("ladarreg", _LEGEND_RECORD, "labels and photographs (JSON)", text))


def _writer(path: Path, header: Any) -> Any:
    import laspy

    return laspy.open(path, mode="w", header=header, do_compress=True, laz_backend=laspy.LazBackend.LazrsParallel)


def _report(report: Report | None, done: int, count: int, path: Path) -> None:
    if report is not None:
        report(Progress(done, count, f"writing {path.name}"))
