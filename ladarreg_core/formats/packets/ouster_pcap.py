"""Reader of Ouster lidar recordings: packets in a pcap or pcapng file, with the sensor's metadata JSON beside it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.formats.packets.capture import Datagram, datagrams
from ladarreg_core.formats.packets.ouster_sensor import OusterSensor, find_sensor_file, read_sensor
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import PathLike, as_float32, reading
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grid_order import order_of
from ladarreg_core.scanner.grids import TabulatedGrid

_PACKET_HEADER, _PACKET_FOOTER, _COLUMN_HEADER = 32, 32, 12
_LEGACY_COLUMN_HEADER, _LEGACY_COLUMN_FOOTER = 16, 4
_LIDAR_PACKET = 1
_OPEN_FRAMES = 2  # packets of neighbouring frames may arrive in disorder
_MIN_SHARE = 0.5
_CELL_BYTES = 400
_OLDEST_PACKETS = 4  # accepted copies of a packet; the network may deliver it twice


@dataclass(frozen=True, slots=True)
class OusterFrame:
    """One revolution, its rows aligned by azimuth."""

    sensor: OusterSensor
    """The sensor."""
    values: dict[str, NDArray[np.uint32]]
    """(H, W) quantities by name; ranges in mm, 0 = no return."""
    encoder: FloatArray
    """(H, W) encoder angle of each cell, rad."""
    missing: int
    """Number of columns that did not arrive."""
    number: int
    """Frame number that the sensor gave it."""


@dataclass(slots=True)
class _Open:
    """A frame whose packets arrive."""

    payloads: list[bytes] = field(default_factory=list)
    columns: set[int] = field(default_factory=set)


def read_ouster_pcap(
    path: PathLike, *, scan_index: int = 0, memory_bytes: int | None = None, report: Report | None = None
) -> Scan:
    """Read one frame of an Ouster recording as a scan.

    Args:
        path: the recording; the sensor's JSON lies beside it.
        scan_index: index among the complete frames, from 0. If no frame is complete, the fullest one is read.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress, in bytes.

    Returns:
        The scan. Its frame has the axes of the Ouster sensor frame and its origin where the beams meet the axis of
        rotation; `world_from_scanner` leads to the Ouster sensor frame. The intensity is the calibrated reflectivity.
        Cells without return have the ray of their beam at infinity.

    Raises:
        FormatError: if the recording or the JSON is damaged, there is no JSON, the profile is not read, or the packets
            are another maker's.
        ShapeError: if there are no returns.
        OptionError: if there is no frame of that index.
    """
    with reading(path) as file:
        frame = read_frame(file, scan_index=scan_index, memory_bytes=memory_bytes, report=report)
        return _to_scan(file.stem, frame)


def read_frame(
    file: Path, *, scan_index: int = 0, memory_bytes: int | None = None, report: Report | None = None
) -> OusterFrame:
    """Read one frame with all quantities of its profile; arguments and errors as `read_ouster_pcap`."""
    budget = ReadBudget.of(file.stat().st_size, memory_bytes)
    sensor = _sensor_of(file)
    budget.require_cells(sensor.rows, sensor.columns, _CELL_BYTES)
    if isinstance(scan_index, bool) or not isinstance(scan_index, int) or scan_index < 0:
        raise OptionError(f"there is no frame {scan_index!r}; frames are counted from 0")
    needed = {*sensor.sent_columns.tolist()}
    complete, fullest, fullest_number = 0, _Open(), 0
    for number, frame in _frames(file, sensor, report):
        if needed <= frame.columns:
            if complete == scan_index:
                return _assembled(sensor, frame, number, 0)
            complete += 1
        elif len(frame.columns & needed) > len(fullest.columns & needed):
            fullest, fullest_number = frame, number
    missing = len(needed - fullest.columns)
    if complete == 0 and scan_index == 0 and missing <= _MIN_SHARE * len(needed):
        return _assembled(sensor, fullest, fullest_number, missing)
    if complete == 0:
        least = f"the fullest lacks {missing:,} of {len(needed):,} columns"
        raise FormatError(f"it contains no complete frame; {least}: record for at least a second")
    raise OptionError(f"there is no frame {scan_index}; the recording contains {complete} complete frames, from 0")


def _sensor_of(file: Path) -> OusterSensor:
    """Return the sensor of a recording; recordings without Ouster packets are refused before a JSON is asked for."""
    try:
        beside = find_sensor_file(file)
    except FormatError:
        _require_ouster(file)
        raise
    return read_sensor(beside)


def _require_ouster(file: Path) -> None:
    """Refuse a recording whose packets are not an Ouster sensor's.

    Raises:
        FormatError: saying what it contains instead.
    """
    sizes: dict[tuple[int, int], int] = {}
    with open(file, "rb") as stream:
        for count, datagram in enumerate(datagrams(stream)):
            key = (datagram.port, len(datagram.payload))
            if key in sizes or len(sizes) < 64:
                sizes[key] = sizes.get(key, 0) + 1
            if count > 2000:
                break
    if not sizes:
        raise FormatError(
            "it contains no UDP packets over IPv4; record the sensor's own packets, or export the cloud as PCD or E57"
        )
    if not any(size > 1500 for _, size in sizes):
        port, size = max(sizes, key=lambda key: sizes[key])
        raise FormatError(
            f"most of its packets have {size:,} bytes and go to port {port}, which neither Ouster nor Velodyne sensors "
            "send; only their recordings are read: export the frame as PCD, PLY or E57 with the maker's software"
        )


def _packet_bytes(sensor: OusterSensor) -> int:
    pixels = sensor.rows * sensor.profile.pixel_bytes
    if sensor.profile.is_legacy:
        return sensor.columns_per_packet * (_LEGACY_COLUMN_HEADER + pixels + _LEGACY_COLUMN_FOOTER)
    return _PACKET_HEADER + sensor.columns_per_packet * (_COLUMN_HEADER + pixels) + _PACKET_FOOTER


def _frames(file: Path, sensor: OusterSensor, report: Report | None) -> Iterator[tuple[int, _Open]]:
    """Yield number and packets of each frame, in the order in which the frames began.

    Raises:
        FormatError: if there are no packets of the sensor.
    """
    most = _OLDEST_PACKETS * -(-sensor.columns // sensor.columns_per_packet)
    total = file.stat().st_size
    frames: dict[int, _Open] = {}
    stream_key: tuple[bytes, int] | None = None
    closed: int | None = None
    seen = False
    with open(file, "rb") as stream:
        for count, datagram in enumerate(datagrams(stream)):
            if report is not None and count % 64 == 0:
                report(Progress(stream.tell(), total, "reading the packets"))
            if not _is_of(datagram, sensor):
                continue
            key = (datagram.source, datagram.port)
            if stream_key is None:
                stream_key = key
            if key != stream_key:  # another sensor of the same kind
                continue
            seen = True
            number, columns = _columns_of(datagram.payload, sensor)
            if number == closed:
                continue
            if number not in frames and len(frames) == _OPEN_FRAMES:
                closed = next(iter(frames))
                yield closed, frames.pop(closed)
            frame = frames.setdefault(number, _Open())
            if len(frame.payloads) < most:
                frame.payloads.append(datagram.payload)
                frame.columns |= columns
    if not seen:
        _require_ouster(file)
        raise FormatError(
            f"it contains no lidar packets of {sensor.product} in the profile {sensor.profile_name} "
            f"({_packet_bytes(sensor):,} bytes), as {sensor.file} beside it says; put the JSON of this recording there"
        )
    yield from frames.items()


def _is_of(datagram: Datagram, sensor: OusterSensor) -> bool:
    """Return whether a datagram is a lidar packet of the sensor; recordings may be replayed to other ports."""
    payload = datagram.payload
    if len(payload) != _packet_bytes(sensor):
        return False
    if sensor.profile.is_legacy:
        return True
    serial = int.from_bytes(payload[7:12], "little")
    is_its_own = sensor.serial is None or serial in (0, sensor.serial)
    return int.from_bytes(payload[:2], "little") == _LIDAR_PACKET and is_its_own


def _column_records(payload: bytes, sensor: OusterSensor) -> NDArray[np.uint8]:
    """Return (columns, bytes) of a packet."""
    data = np.frombuffer(payload, np.uint8)
    if not sensor.profile.is_legacy:
        data = data[_PACKET_HEADER : len(data) - _PACKET_FOOTER]
    return data.reshape(sensor.columns_per_packet, -1)


def _columns_of(payload: bytes, sensor: OusterSensor) -> tuple[int, set[int]]:
    """Return the frame's number and the valid columns of a packet."""
    records = _column_records(payload, sensor)
    columns = _ids(records)
    valid = _are_valid(records, sensor) & (columns < sensor.columns)
    at = 10 if sensor.profile.is_legacy else 2
    return int.from_bytes(payload[at : at + 2], "little"), {*columns[valid].tolist()}


def _ids(records: NDArray[np.uint8]) -> IntArray:
    return records[:, 8].astype(np.int64) | records[:, 9].astype(np.int64) << 8


def _are_valid(records: NDArray[np.uint8], sensor: OusterSensor) -> NDArray[np.bool_]:
    status = records[:, -_LEGACY_COLUMN_FOOTER] if sensor.profile.is_legacy else records[:, 10]
    return (status & 1).astype(bool)


def _assembled(sensor: OusterSensor, frame: _Open, number: int, missing: int) -> OusterFrame:
    """Return the frame with its rows shifted so that a column has one azimuth, cut to what the window covers."""
    profile, rows = sensor.profile, sensor.rows
    head = _LEGACY_COLUMN_HEADER if profile.is_legacy else _COLUMN_HEADER
    raw = {name: np.zeros((rows, sensor.columns), np.uint32) for name in profile.fields}
    for payload in frame.payloads:
        records = _column_records(payload, sensor)
        columns = _ids(records)
        use = _are_valid(records, sensor) & (columns < sensor.columns)
        pixels = records[use, head : head + rows * profile.pixel_bytes].reshape(-1, rows, profile.pixel_bytes)
        for name, place in profile.fields.items():
            width = np.dtype(place.dtype).itemsize
            words = np.ascontiguousarray(pixels[..., place.offset : place.offset + width]).view(place.dtype)[..., 0]
            numbers = words.astype(np.uint32) & (place.mask or 0xFFFFFFFF)
            raw[name][:, columns[use]] = (numbers * np.uint32(place.unit)).T
    source = (sensor.seen_columns[None, :] - sensor.shifts[:, None]) % sensor.columns  # measured column of each cell
    values = {name: np.take_along_axis(grid, source, 1) for name, grid in raw.items()}
    return OusterFrame(sensor, values, 2 * np.pi * (1 - source / sensor.columns), missing, number)


def _to_scan(name: str, frame: OusterFrame) -> Scan:
    sensor = frame.sensor
    range_m = frame.values["RANGE"] * 1e-3
    points, beams = _points(frame, range_m)
    has = range_m > 0
    length = np.linalg.norm(points, axis=-1)
    has &= length > 0
    rays = np.where(has[..., None], points / np.where(has, length, 1)[..., None], beams)
    order = order_of(beams)
    ranges = order.apply(np.where(has, length, np.nan))
    axes, height = sensor.sensor_from_lidar.rotation, sensor.beam_origin_m[1]
    centre = sensor.sensor_from_lidar @ np.array([0.0, 0.0, height])
    lost = f"; {frame.missing:,} of {len(sensor.sent_columns):,} columns are missing" if frame.missing else ""
    first = ", the first of two returns" if sensor.profile_name.endswith("DUAL") else ""
    return Scan(
        TabulatedGrid(order.apply(rays @ axes.T)),
        as_float32(ranges),
        as_float32(order.apply(frame.values["REFLECTIVITY"])),
        intensity_is="range_normalised",
        world_from_scanner=Rigid(np.eye(3), centre),
        name=name,
        notes=(
            f"frame {frame.number} of {sensor.product}, profile {sensor.profile_name}{first}, beam angles from "
            f"{sensor.file}{lost}",
            "the scanner frame has the axes of the Ouster sensor frame and its origin on the axis of rotation at the "
            f"height of the beams; the world is the Ouster sensor frame, {np.linalg.norm(centre) * 1000:.1f} mm away",
        ),
    )


def _points(frame: OusterFrame, range_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points (H, W, 3), m, and the beams' directions, in the axes of the lidar frame, from the scan's centre.

    The range counts from the axis of rotation: it includes the way from there to the beam's origin.
    Source: Ouster's firmware user manual, 'Lidar range to XYZ'.
    """
    sensor = frame.sensor
    radius, height = sensor.beam_origin_m
    azimuth = frame.encoder - sensor.azimuth[:, None]
    altitude = sensor.altitude[:, None]
    beams = np.stack(
        [np.cos(azimuth) * np.cos(altitude), np.sin(azimuth) * np.cos(altitude),
         np.broadcast_to(np.sin(altitude), azimuth.shape)], axis=-1,
    )  # fmt: skip
    outward = np.stack([np.cos(frame.encoder), np.sin(frame.encoder), np.zeros_like(frame.encoder)], axis=-1)
    return (range_m - np.hypot(radius, height))[..., None] * beams + radius * outward, beams
