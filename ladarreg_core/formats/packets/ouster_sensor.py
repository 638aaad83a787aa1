"""What an Ouster sensor says of itself: its metadata JSON, and the layout of the packets that it sends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.formats.parsing.json_file import number, read_json_object, whole_number
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.foundations.arrays import IntArray
from ladarreg_core.frames import Rigid

_MAX_COLUMNS, _MAX_BEAMS = 4096, 256
_GROUPS = (
    "beam_intrinsics", "lidar_intrinsics", "lidar_data_format", "data_format", "sensor_info", "config_params",
)  # fmt: skip
_MAX_FILES, _LARGEST_JSON = 200, 4 << 20


@dataclass(frozen=True, slots=True)
class PacketField:
    """Where a quantity stands in the data of one pixel."""

    offset: int
    """Bytes from the start of the pixel."""
    dtype: str
    """NumPy code of the word that contains it."""
    mask: int = 0
    """Bits that belong to it; 0: all."""
    unit: int = 1
    """Factor; ranges are in mm."""


@dataclass(frozen=True, slots=True)
class Profile:
    """Layout of the lidar packets of one profile."""

    pixel_bytes: int
    """Bytes per pixel."""
    fields: Mapping[str, PacketField]
    """Its quantities by their names in Ouster's documents."""
    is_legacy: bool = False
    """Whether every column has its own header of the first firmwares, and the packet none."""


PROFILES: Mapping[str, Profile] = {
    "LEGACY": Profile(
        12,
        {
            "RANGE": PacketField(0, "<u4", 0xFFFFF),
            "REFLECTIVITY": PacketField(4, "<u2"),
            "SIGNAL": PacketField(6, "<u2"),
            "NEAR_IR": PacketField(8, "<u2"),
        },
        is_legacy=True,
    ),
    "RNG19_RFL8_SIG16_NIR16": Profile(
        12,
        {
            "RANGE": PacketField(0, "<u4", 0x7FFFF),
            "REFLECTIVITY": PacketField(4, "u1"),
            "SIGNAL": PacketField(6, "<u2"),
            "NEAR_IR": PacketField(8, "<u2"),
        },
    ),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Profile(
        16,
        {
            "RANGE": PacketField(0, "<u4", 0x7FFFF),
            "REFLECTIVITY": PacketField(3, "u1"),
            "SIGNAL": PacketField(8, "<u2"),
            "NEAR_IR": PacketField(12, "<u2"),
        },
    ),
    "RNG15_RFL8_NIR8": Profile(
        4,
        {
            "RANGE": PacketField(0, "<u2", 0x7FFF, unit=8),
            "REFLECTIVITY": PacketField(2, "u1"),
            "NEAR_IR": PacketField(3, "u1", unit=16),
        },
    ),
}
"""The profiles that are read; of two returns the first, which is the stronger. Source: Ouster's firmware manual."""


@dataclass(frozen=True, slots=True)
class OusterSensor:
    """A sensor's calibration and data format."""

    file: str
    """Name of its file."""
    product: str
    """Product line and serial number, for users."""
    serial: int | None
    """Serial number; None where it is not stated."""
    port: int | None
    """UDP port that the lidar packets are sent to; None where it is not stated."""
    profile_name: str
    """Name of the packets' profile."""
    columns: int
    """Columns per revolution."""
    columns_per_packet: int
    """Columns per packet."""
    window: tuple[int, int]
    """First and last column that are sent; the first may be the larger."""
    shifts: IntArray
    """(H,) columns by which each row is shifted to align the rows' azimuths."""
    altitude: NDArray[np.float64]
    """(H,) altitude of each beam, rad."""
    azimuth: NDArray[np.float64]
    """(H,) azimuth of each beam relative to the encoder, rad."""
    beam_origin_m: tuple[float, float]
    """Distance of the beams' origin from the axis, and its height over the lidar's origin, m."""
    sensor_from_lidar: Rigid
    """From the lidar frame to the sensor frame."""

    @property
    def profile(self) -> Profile:
        """Layout of its packets."""
        return PROFILES[self.profile_name]

    @property
    def rows(self) -> int:
        """Number of beams."""
        return len(self.altitude)

    @property
    def sent_columns(self) -> IntArray:
        """The columns of the window, in the order in which they are measured."""
        first, last = self.window
        count = (last - first) % self.columns + 1
        return (first + np.arange(count)) % self.columns

    @property
    def seen_columns(self) -> IntArray:
        """The columns that the window covers in some row after the rows are shifted; more than are sent."""
        half = self.columns // 2
        shifts = (self.shifts + half) % self.columns - half
        first, count = self.window[0] + int(shifts.min()), len(self.sent_columns) + int(np.ptp(shifts))
        if count >= self.columns:
            return self.sent_columns if len(self.sent_columns) == self.columns else np.arange(self.columns)
        return (first + np.arange(count)) % self.columns


def is_ouster_metadata(fields: Mapping[str, Any]) -> bool:
    """Return whether the fields of a JSON file are those of an Ouster sensor's metadata."""
    beams = fields.get("beam_intrinsics", fields)
    return isinstance(beams, Mapping) and "beam_altitude_angles" in beams


def find_sensor_file(recording: Path) -> Path:
    """Return the sensor's JSON beside a recording.

    That of the recording's name is taken, with or without suffixes such as `_0`; else the only one of the folder whose
    content is an Ouster sensor's.

    Raises:
        FormatError: if there is none, or it is not clear which.
    """
    named = recording.with_suffix(".json")
    if named.is_file():
        return named
    try:
        files = sorted(file for file in recording.parent.iterdir() if file.suffix.lower() == ".json" and file.is_file())
    except OSError:
        files = []
    found = [file for file in files[:_MAX_FILES] if _is_sensor_file(file)]
    alike = [file for file in found if file.stem.startswith(recording.stem) or recording.stem.startswith(file.stem)]
    for some in (alike, found):
        if len(some) == 1:
            return some[0]
    if found:
        names = one_line(", ".join(file.name for file in found[:4]), 120)
        raise FormatError(
            f"{len(found)} sensor files lie beside it ({names}); name the one that belongs to it {named.name}"
        )
    raise FormatError(
        "the beam angles of an Ouster sensor stand in its metadata JSON, which is missing; put that file "
        f"beside it as {one_line(named.name, 80)}"
    )


def _is_sensor_file(file: Path) -> bool:
    try:
        return file.stat().st_size <= _LARGEST_JSON and is_ouster_metadata(read_json_object(file, "sensor metadata"))
    except (LadarregError, OSError):
        return False


def read_sensor(path: Path) -> OusterSensor:
    """Read an Ouster sensor's metadata, of firmware 2.0 or later; flat, or in groups as since firmware 3.

    Raises:
        FormatError: if it is damaged, lacks what is needed, or the packets' profile is not read.
    """
    fields = read_json_object(path, "an Ouster sensor's metadata")
    if not is_ouster_metadata(fields):
        raise FormatError(
            f"{one_line(path.name, 60)} beside it is not an Ouster sensor's metadata; save it from the sensor"
        )
    groups = [group for name in _GROUPS if isinstance(group := fields.get(name), Mapping)]
    flat: dict[str, Any] = {}
    for group in (*reversed(groups), fields):
        flat |= group
    profile = str(flat.get("udp_profile_lidar") or "LEGACY").upper().removeprefix("PROFILE_")
    if profile not in PROFILES:
        raise FormatError(
            f"its packets have the profile {one_line(profile, 60)}, which is not read; set the sensor to one of "
            f"{', '.join(PROFILES)}, or export the frame as PCD or E57 with Ouster's software"
        )
    if "pixel_shift_by_row" not in flat:
        raise FormatError(
            f"{one_line(path.name, 60)} has no data format (firmware before 2.0); save it with newer software"
        )
    altitude, azimuth = _floats(flat, "beam_altitude_angles"), _floats(flat, "beam_azimuth_angles")
    shifts = _floats(flat, "pixel_shift_by_row", len(altitude))
    if not 2 <= len(altitude) <= _MAX_BEAMS or len(azimuth) != len(altitude):
        raise FormatError(
            f"it has {len(altitude)} altitude and {len(azimuth)} azimuth angles; both must be 2 to {_MAX_BEAMS}"
        )
    columns, per_packet = (whole_number(flat, name, least=1) for name in ("columns_per_frame", "columns_per_packet"))
    if columns > _MAX_COLUMNS or per_packet > columns:
        raise FormatError(
            f"it claims {columns} columns in packets of {per_packet}; at most {_MAX_COLUMNS} are possible"
        )
    if whole_number(flat, "pixels_per_column", len(altitude)) != len(altitude) or np.abs(shifts).max() > columns:
        raise FormatError("its pixels per column or their shifts do not fit its beams; the file is damaged")
    window = _floats(flat, "column_window", 2) if "column_window" in flat else np.array([0, columns - 1])
    if not ((window >= 0) & (window < columns)).all():
        raise FormatError(f"its column window is {window.tolist()}; it must lie in 0 to {columns - 1}")
    serial, port = str(flat.get("prod_sn") or ""), flat.get("udp_port_lidar")
    return OusterSensor(
        file=path.name,
        product=one_line(f"{flat.get('prod_line') or 'Ouster sensor'} {serial}", 60).strip(),
        serial=int(serial) if serial.isascii() and serial.isdigit() and len(serial) < 19 else None,
        port=port if isinstance(port, int) and not isinstance(port, bool) else None,
        profile_name=profile,
        columns=columns,
        columns_per_packet=per_packet,
        window=(int(window[0]), int(window[1])),
        shifts=shifts.astype(np.int64),
        altitude=np.radians(altitude),
        azimuth=np.radians(azimuth),
        beam_origin_m=_beam_origin(flat),
        sensor_from_lidar=_transform(flat, "lidar_to_sensor_transform"),
    )


def _beam_origin(flat: Mapping[str, Any]) -> tuple[float, float]:
    if "beam_to_lidar_transform" in flat:
        matrix = _floats(flat, "beam_to_lidar_transform", 16).reshape(4, 4)
        return float(matrix[0, 3]) / 1000, float(matrix[2, 3]) / 1000
    return number(flat, "lidar_origin_to_beam_origin_mm") / 1000, 0.0


def _transform(flat: Mapping[str, Any], name: str) -> Rigid:
    matrix = _floats(flat, name, 16).reshape(4, 4)
    return Rigid(matrix[:3, :3], matrix[:3, 3] / 1000)


def _floats(flat: Mapping[str, Any], name: str, count: int | None = None) -> NDArray[np.float64]:
    values = flat.get(name)
    if isinstance(values, list) and values and all(isinstance(row, list) for row in values):
        values = [value for row in values for value in row]
    if not isinstance(values, list) or not values or len(values) > 1 << 16:
        raise FormatError(f"the field {name!r} is {one_line(repr(values), 60)}; it must be a list of numbers")
    if count is not None and len(values) != count:
        raise FormatError(f"the field {name!r} has {len(values)} numbers; it must have {count}")
    numbers = np.array([number({name: value}, name) for value in values])
    if np.abs(numbers).max() > 1e6:
        raise FormatError(f"the field {name!r} contains {numbers[np.abs(numbers).argmax()]:g}; it is damaged")
    return numbers
