"""The target `laz`: the coloured cloud as LAS 1.4, compressed.

A cloud that was read from LAS or LAZ is copied point by point: its coordinates, all its fields and its records stay as
they were, colours and three extra bytes are added. Any other scan is written anew, in the world where that is known.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import LadarregError
from ladarreg_core.export.clouds.cloud_part import SixteenBitIntensity
from ladarreg_core.export.clouds.las_file import LasWriter, extra_bytes_entry, extra_bytes_record, variable_record
from ladarreg_core.export.json import write_document
from ladarreg_core.export.layered_scan import LayeredScan
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.formats.scans.las_header import sniff_las
from ladarreg_core.formats.scans.las_records import (
    EXTRA_BYTES_RECORD,
    GEOTIFF_RECORD,
    LASZIP_RECORD,
    WKT_RECORD,
    LasRecords,
    extra_bytes_of,
    point_dtype,
)
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.version import VERSION
from ladarreg_core.frames import Rigid
from ladarreg_core.surface.texture.best_photo import NO_PHOTO
from ladarreg_core.surface.texture.registered_texture import Label, dimmed_gray, dimmed_levels

EXTRA_BYTES = {
    "photo_id": ("<u2", "photograph, see legend; 0: none"),
    "label": ("|u1", "visibility class, see legend"),
    "sigma_px": ("<f4", "uncertainty in photograph, px"),
}
"""Extra bytes that are added: type and description, at most 32 characters."""
_CHUNK = 400_000  # eight chunks of LASzip
_COLORS = ("red", "green", "blue")
_SCALE_M = 1e-4
_COARSER_SCALE_M = 1e-3
_LARGEST_INTEGER = 2**31 - 1
_OFFSET_ROUNDED_TO_M = 100.0
_LEGACY = (0, 1, 2, 3)
_WITH_COLOR = {0: 2, 1: 3, 6: 7}
_NEW_FORMATS = {0: 7, 1: 7, 2: 7, 3: 7, 6: 7, 7: 7, 8: 8}
_USER = "ladarreg"
_LARGEST_LEGEND = 60_000
_SIXTEEN_BITS = np.uint16(257)  # 255 becomes 65535
_SCAN_ANGLE_STEP_DEG = 0.006
_BYTE_ORDER_RECORDS = ("copc",)  # they state where chunks of points stand, which is not so in the copy


def laz_refusal(handed: RegisteredScan, options: ExportOptions) -> str | None:
    """Return why the scan's file cannot be copied; None if it can."""
    del options
    try:
        if (source := _las_source(handed)) is not None:
            _Copy(handed, source)
    except LadarregError as error:
        return str(error)
    return None


def laz_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return the cloud and `legend.json`, which explains photo ids and labels."""
    del options
    source = _las_source(handed)
    stem = "cloud" if handed.scan_file is None else handed.scan_file.stem
    if stem.lower().endswith(".copc"):  # its points have another order, which readers know by the name
        stem = stem[:-5]
    cloud = _Returns([LayeredScan(handed)]) if source is None else _Copy(handed, source)
    return _files(stem, cloud, [handed], report)


def layered_laz_files(parts: Sequence[LayeredScan], report: Report | None) -> Sequence[FileJob]:
    """Return one cloud of the returns of scans, `cloud.laz`, with layers as extra bytes, and `legend.json`."""
    return _files("cloud", _Returns(parts), [part.handed for part in parts], report)


def _files(
    stem: str, cloud: _Copy | _Returns, scans: Sequence[RegisteredScan], report: Report | None
) -> Sequence[FileJob]:
    def write(path: Path) -> None:
        for handed in scans:
            handed.compute_colors(report)
        done, label = 0, f"writing {path.name}"
        if report is not None:
            report(Progress(done, cloud.count, label))
        with cloud.writer(path) as file:
            for points in cloud.chunks():
                file.write(points)
                done += len(points)
                if report is not None:
                    report(Progress(done, cloud.count, label))
            cloud.finish(file)

    return [("legend.json", lambda path: write_document(path, cloud.legend)), (f"{stem}.laz", write)]


def _las_source(handed: RegisteredScan) -> Path | None:
    """Return the scan's file if it is LAS or LAZ, and has the scan's ranges."""
    path = handed.scan_file
    if path is None or not path.is_file() or not handed.ranges_as_read:
        return None
    try:
        with open(path, "rb") as file:
            return path if sniff_las(file.read(4)) else None
    except OSError:
        return None


def _legend(handed: RegisteredScan, coordinates: str, intensity: str, unseen: str, notes: Sequence[str]) -> Any:
    """Return what the extra bytes and the coordinates mean."""
    return {
        "coordinates": coordinates,
        "photo_id": {"0": None, **{str(k): one.photo.name for k, one in enumerate(handed.photos, 1)}},
        "poses": {str(k): one.registration.standing for k, one in enumerate(handed.photos, 1)},
        "label": {str(int(label)): label.name.lower().replace("_", " ") for label in Label},
        "sigma_px": "standard deviation of the point's position in the photograph, px; NaN where it is not known",
        "colour": f"16 bits, of the photograph; where none shows the point, {unseen}",
        "intensity": intensity,
        "notes": list(notes),
        "software": f"ladarreg {VERSION}",
    }


def _legend_record(legend: Mapping[str, Any], number: int) -> bytes:
    """Return the legend as a record; names of so many photographs that they do not fit stand in the file alone."""
    content = json.dumps(legend).encode()
    if len(content) > _LARGEST_LEGEND:
        content = json.dumps({**legend, "photo_id": "see legend.json", "poses": _marked(legend["poses"])}).encode()
    return variable_record(_USER, number, "labels and photographs, JSON", content)


def _marked(poses: Mapping[str, str]) -> str:
    marks = sorted(set(poses.values()) - {"accepted"})
    return f"some: {', '.join(marks)}; see legend.json" if marks else "accepted"


def _opaque(size: int) -> list[tuple[str, str]]:
    return [("extra", f"V{size}")] if size else []


class _Copy:
    """A cloud that was read from LAS or LAZ.

    LAS 1.4 needs WKT for the point formats from 6 on: a file whose reference system is in GeoTIFF keys alone stays in
    its version, in the point format of its own with colours.
    """

    def __init__(self, handed: RegisteredScan, source: Path) -> None:
        self._handed = handed
        self._stored = stored = LasRecords(source)
        header = stored.header
        self.count = header.points
        self._old = header.point_format
        stays = stored.has(GEOTIFF_RECORD) and not stored.has(WKT_RECORD)
        self._new = _WITH_COLOR.get(self._old, self._old) if stays else _NEW_FORMATS[self._old]
        version = int(header.version.split(".")[1])
        self._minor = max(version, 2) if stays else 4
        self._has_wkt = not stays
        self._has_color = "red" in (point_dtype(self._old).names or ())
        extra = header.record_bytes - point_dtype(self._old).itemsize
        self._as_read = point_dtype(self._old, _opaque(extra))
        described = next((one.content for one in stored.records if one.key == EXTRA_BYTES_RECORD), b"")
        entries, taken = extra_bytes_of(described, extra)
        taken |= {name.lower() for part in (self._old, self._new) for name in point_dtype(part).fields or {}}
        self._names = {name: _free_name(name, taken) for name in EXTRA_BYTES}
        added = [(self._names[name], dtype) for name, (dtype, _) in EXTRA_BYTES.items()]
        entries += b"".join(extra_bytes_entry(self._names[name], *rest) for name, rest in EXTRA_BYTES.items())
        self._extra_bytes = extra_bytes_record(entries)
        self._dtype = point_dtype(self._new, _opaque(extra) + added)
        self.legend = _legend(
            handed,
            "the coordinates of the source file, unchanged",
            "the source file's, unchanged",
            "that of the source file" if self._has_color else "the dimmed laser intensity",
            self._notes(stays),
        )

    def writer(self, path: Path) -> LasWriter:
        """Return the writer of the copy."""
        stored = self._stored
        kept = [one for one in stored.records if not _is_rewritten(one.user, one.number)]
        numbers = {one.number for one in kept if one.user == _USER}
        return LasWriter(
            path,
            point_format=self._new,
            dtype=self._dtype,
            minor=self._minor,
            scale=stored.header.scale,
            offset=stored.header.offset,
            records=[
                *(one.data for one in kept),
                self._extra_bytes,
                _legend_record(self.legend, next(k for k in range(1, 1 << 16) if k not in numbers)),
            ],
            head=stored.head,
            has_wkt=self._has_wkt and self._new not in _LEGACY,
        )

    def finish(self, file: LasWriter) -> None:
        """Complete the copy with the records that stand behind the points."""
        kept = [one for one in self._stored.long_records if not _is_rewritten(one.user, one.number)]
        file.finish(self._stored.path, [(one.start, one.size) for one in kept])

    def chunks(self) -> Iterator[NDArray[Any]]:
        """Yield the points with their colours."""
        colorer, scan, header = self._handed.point_colorer(), self._handed.scan, self._stored.header
        pose, scale = scan.world_from_scanner or Rigid.identity(), np.array(header.scale)
        moved = np.array(header.offset) - pose.translation  # small, and exact
        levels = dimmed_levels(scan)
        factor = 0  # of the file's colours; 0 as long as all are black
        for stored in self._stored.chunks(_CHUNK):
            old = stored.reshape(-1).view(self._as_read)
            made = self._converted(old)
            points = np.stack([old[axis] for axis in "XYZ"], axis=-1) * scale + moved
            if not np.array_equal(pose.rotation, np.eye(3)):
                points = points @ pose.rotation
            found = colorer.colors_of(points)
            shown = found.photo != NO_PHOTO
            if not self._has_color:
                gray = dimmed_gray(old["intensity"].astype(np.float32), levels) * _SIXTEEN_BITS
            elif not factor:
                brightest = max(int(old[name].max()) for name in _COLORS)
                # Many writers store 8 bits in the 16 of the standard: in one file they would be black beside ours.
                factor = 0 if brightest == 0 else int(_SIXTEEN_BITS) if brightest < 256 else 1
            for k, name in enumerate(_COLORS):
                before = old[name] * np.uint16(factor) if self._has_color else gray
                made[name] = np.where(shown, found.color[:, k] * _SIXTEEN_BITS, before)
            made[self._names["photo_id"]] = np.where(shown, found.photo + np.uint16(1), 0)
            made[self._names["label"]], made[self._names["sigma_px"]] = found.labels, found.sigma_px
            yield made

    def _converted(self, old: NDArray[Any]) -> NDArray[Any]:
        """Return points in the record of the copy, with all their values; those of equal names are equal in storage."""
        made = np.zeros(len(old), self._dtype)
        for name in set(old.dtype.names or ()) & set(made.dtype.names or ()):
            made[name] = old[name]
        if self._old in _LEGACY and self._new not in _LEGACY:
            bits, kind = old["bits"], old["class_bits"]
            made["returns"] = (bits & 7) | (bits >> 3 & 7) << 4
            made["flags"] = kind >> 5 | bits & 0xC0  # synthetic, key point, withheld; scan direction, edge
            made["classification"] = kind & 31
            made["scan_angle"] = np.rint(old["scan_angle_rank"] / _SCAN_ANGLE_STEP_DEG)
        return made

    def _notes(self, stays: bool) -> list[str]:
        notes = []
        if stays:
            notes.append(
                "the reference system is stated by GeoTIFF keys only, which LAS 1.4 does not allow for point formats "
                f"from 6 on: the file stays in LAS 1.{self._minor}, point format {self._new}"
            )
        renamed = [f"{new} ({name})" for name, new in self._names.items() if name != new]
        if renamed:
            notes.append(f"the source has extra bytes of the same names; the new ones are {', '.join(renamed)}")
        return notes


def _is_rewritten(user: str, number: int) -> bool:
    return (user, number) in (EXTRA_BYTES_RECORD, LASZIP_RECORD) or user in _BYTE_ORDER_RECORDS


def _free_name(name: str, taken: set[str]) -> str:
    candidate, number = name, 2
    while candidate in taken:
        candidate = f"ladarreg_{name}" if candidate == name else f"ladarreg_{name}_{number}"
        number += candidate != f"ladarreg_{name}"
    return candidate


class _Returns:
    """The returns of scans that were not read from LAS, or are written with layers."""

    def __init__(self, parts: Sequence[LayeredScan]) -> None:
        self._parts = parts
        scans = [part.handed.scan for part in parts]
        self.count = sum(int(np.count_nonzero(scan.valid)) for scan in scans)
        poses = [scan.world_from_scanner or Rigid.identity() for scan in scans]
        first = poses[0].translation
        large = np.abs(first).max() > _OFFSET_ROUNDED_TO_M
        self._offset = np.round(first / _OFFSET_ROUNDED_TO_M) * _OFFSET_ROUNDED_TO_M + 0.0 if large else np.zeros(3)
        self._placed = [Rigid(pose.rotation, pose.translation - self._offset) for pose in poses]  # small, and exact
        reach = max(
            float(np.nanmax(scan.ranges)) + float(np.abs(placed.translation).max())
            for scan, placed in zip(scans, self._placed, strict=True)
        )
        fits = (reach + _OFFSET_ROUNDED_TO_M) / _SCALE_M < _LARGEST_INTEGER
        self._scale_m = _SCALE_M if fits else _COARSER_SCALE_M
        self._intensity = SixteenBitIntensity(scans)
        scan, layers = scans[0], parts[0].values
        in_world = scan.world_from_scanner is not None
        self.legend = {
            **_legend(
                parts[0].handed,
                "world frame, as the scan's file states it; metres"
                if in_world
                else "scanner frame, X forward, Y left, Z up; metres",
                self._intensity.words,
                "the dimmed laser intensity" if scan.color is None else "that of the source file",
                [],
            ),
            **({"layers": {name: one.meaning for name, one in layers.items()}} if layers else {}),
        }
        self._fields = {
            **EXTRA_BYTES,
            **{name: (one.values.dtype.str, one.meaning) for name, one in layers.items()},
        }
        self._dtype = point_dtype(7, [(name, dtype) for name, (dtype, _) in self._fields.items()])

    def writer(self, path: Path) -> LasWriter:
        """Return the writer of the cloud."""
        entries = b"".join(extra_bytes_entry(name, *rest) for name, rest in self._fields.items())
        return LasWriter(
            path,
            point_format=7,
            dtype=self._dtype,
            minor=4,
            scale=[self._scale_m] * 3,
            offset=self._offset.tolist(),
            records=[extra_bytes_record(entries), _legend_record(self.legend, 1)],
            has_wkt=True,
        )

    def finish(self, file: LasWriter) -> None:
        """Complete the file."""
        file.finish()

    def chunks(self) -> Iterator[NDArray[Any]]:
        """Yield the points with their colours."""
        for part, placed in zip(self._parts, self._placed, strict=True):
            yield from self._chunks_of(part, placed)

    def _chunks_of(self, part: LayeredScan, placed: Rigid) -> Iterator[NDArray[Any]]:
        scan, colors = part.handed.scan, part.handed.colors
        levels = dimmed_levels(scan)
        rows_at_once = max(1, _CHUNK // scan.shape[1])
        for first in range(0, scan.shape[0], rows_at_once):
            rows = slice(first, first + rows_at_once)
            valid = scan.valid[rows]
            points = scan.points_at(rows, slice(None))[valid].astype(np.float64)
            made = np.zeros(len(points), self._dtype)
            points = (points @ placed.rotation.T + placed.translation) / self._scale_m
            for k, axis in enumerate("XYZ"):
                made[axis] = np.rint(points[:, k])
            intensity = scan.intensity[rows][valid]
            made["intensity"] = self._intensity.written(intensity)
            made["returns"] = 1 | 1 << 4  # the first of one
            photo, rgb = colors.photo[rows][valid], colors.image[rows][valid]
            shown = photo != NO_PHOTO
            if scan.color is None:
                before = np.broadcast_to(dimmed_gray(intensity, levels)[:, None], rgb.shape)
            else:
                before = scan.color[rows][valid]
            for k, name in enumerate(_COLORS):
                made[name] = np.where(shown, rgb[:, k], before[:, k]) * _SIXTEEN_BITS
            made["photo_id"] = np.where(shown, photo + np.uint16(1), 0)
            made["label"], made["sigma_px"] = colors.labels[rows][valid], colors.sigma_px[rows][valid]
            for name, one in part.values.items():
                made[name] = one.values[rows][valid]
            yield made
