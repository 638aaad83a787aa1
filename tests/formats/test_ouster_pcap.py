"""Ouster recordings: packets made by hand from the published layout, and a real one."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.packets.ouster_pcap import read_frame

_COLUMNS, _PER_PACKET = 32, 16
_SHIFTS = [2, 0, -2, 0]
_METADATA = {
    "prod_line": "OS-1-4", "prod_sn": "7", "beam_altitude_angles": [10.0, 3.0, -3.0, -10.0],
    "beam_azimuth_angles": [22.5, 0.0, -22.5, 0.0], "lidar_origin_to_beam_origin_mm": 20.0,
    "lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36, 0, 0, 0, 1],
}  # fmt: skip
_PIXEL = {
    "LEGACY": lambda mm, r: struct.pack("<IHHHH", mm | 0xF << 28, r, 5, 9, 0),
    "RNG19_RFL8_SIG16_NIR16": lambda mm, r: struct.pack("<IBBHHH", mm | 0xF << 19, r, 0, 5, 9, 0),
    "RNG19_RFL8_SIG16_NIR16_DUAL": lambda mm, r: struct.pack("<IIHHHH", mm | r << 24, 7, 5, 6, 9, 0),
    "RNG15_RFL8_NIR8": lambda mm, r: struct.pack("<HBB", mm // 8 | 0x8000, r, 9),
}


def _millimetres(row: int, column: int) -> int:
    return 0 if (row, column) == (1, 5) else 2000 + 400 * row + 8 * column


def _payload(profile: str, number: int, first: int) -> bytes:
    legacy = profile == "LEGACY"
    body = b"" if legacy else struct.pack("<HHI", 1, number, 0)[:7] + (7).to_bytes(5, "little") + bytes(20)
    for column in range(first, first + _PER_PACKET):
        pixels = b"".join(_PIXEL[profile](_millimetres(row, column), 10 * row + 1) for row in range(4))
        if legacy:
            body += struct.pack("<QHHI", 0, column, number, 0) + pixels + b"\xff" * 4
        else:
            body += struct.pack("<QHH", 0, column, 1) + pixels
    return body if legacy else body + bytes(32)


def _frames(payload: bytes, ident: int, *, vlan: bool, most: int) -> list[bytes]:
    """Ethernet frames of a datagram, cut into fragments of at most `most` bytes."""
    udp = struct.pack(">HHHH", 7502, 7502, 8 + len(payload), 0) + payload
    made = []
    for at in range(0, len(udp), most):
        piece = udp[at : at + most]
        flags = at // 8 | (0x2000 if at + most < len(udp) else 0)
        ip = struct.pack(
            ">BBHHHBBH4s4s", 0x45, 0, 20 + len(piece), ident, flags, 64, 17, 0, b"\x0a\0\0\1", b"\x0a\0\0\2"
        )
        made.append(bytes(12) + (b"\x81\x00\x00\x05" if vlan else b"") + b"\x08\x00" + ip + piece)
    return made[::-1]  # fragments in disorder


def write_recording(
    path: Path,
    profile: str,
    *,
    pcapng: bool = False,
    vlan: bool = False,
    most: int = 1 << 16,
    lost: int | None = None,
    window: tuple[int, int] = (0, _COLUMNS - 1),
) -> Path:
    """A recording that starts within a frame, with two complete frames after it, and its JSON."""
    starts = [(4, 16), (5, 0), (5, 16), (6, 0), (6, 16)]
    packets = []
    for ident, (number, first) in enumerate(starts):
        if ident != lost and window[0] <= first <= window[1]:
            packets += _frames(_payload(profile, number, first), ident, vlan=vlan, most=most)
    if pcapng:

        def block(kind: int, body: bytes) -> bytes:
            body += bytes(-len(body) % 4)
            return struct.pack("<II", kind, len(body) + 12) + body + struct.pack("<I", len(body) + 12)

        data = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)) + block(1, struct.pack("<HHI", 1, 0, 0))
        data += b"".join(block(6, struct.pack("<IIIII", 0, 0, 0, len(p), len(p)) + p) for p in packets)
    else:
        data = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
        data += b"".join(struct.pack("<IIII", 0, 0, len(p), len(p)) + p for p in packets)
    path.write_bytes(data)
    layout = {
        "columns_per_frame": _COLUMNS, "columns_per_packet": _PER_PACKET, "pixels_per_column": 4,
        "pixel_shift_by_row": _SHIFTS, "column_window": list(window), "udp_profile_lidar": profile,
    }  # fmt: skip
    path.with_suffix(".json").write_text(json.dumps({**_METADATA, "data_format": layout}), encoding="utf-8")
    return path


def seed_files(folder: Path) -> list[Path]:
    return [
        write_recording(folder / "single.pcap", "RNG19_RFL8_SIG16_NIR16", most=400),
        write_recording(folder / "old.pcapng", "LEGACY", pcapng=True, vlan=True),
    ]


@pytest.mark.parametrize("profile", list(_PIXEL))
@pytest.mark.parametrize("way", [{}, {"pcapng": True, "vlan": True}, {"most": 400}])
def test_points_follow_the_makers_formula(tmp_path: Path, profile: str, way: dict[str, object]) -> None:
    scan = read_scan(write_recording(tmp_path / "a.pcap", profile, **way))  # type: ignore[arg-type]
    assert scan.shape == (4, _COLUMNS)
    assert scan.valid.sum() == 4 * _COLUMNS - 1
    assert scan.world_from_scanner is not None
    for row, column in ((0, 0), (0, 31), (1, 7), (2, 3), (3, 20)):
        encoder = 2 * np.pi * (1 - column / _COLUMNS)
        azimuth = encoder - np.radians(_METADATA["beam_azimuth_angles"][row])  # type: ignore[index]
        altitude = np.radians(_METADATA["beam_altitude_angles"][row])  # type: ignore[index]
        mm = _millimetres(row, column)
        lidar = (mm - 20) * np.array(
            [np.cos(azimuth) * np.cos(altitude), np.sin(azimuth) * np.cos(altitude), np.sin(altitude)]
        ) + 20 * np.array([np.cos(encoder), np.sin(encoder), 0])
        wanted = np.array([-lidar[0], -lidar[1], lidar[2] + 36]) / 1000
        cell = (row, (column + _SHIFTS[row]) % _COLUMNS)
        assert scan.world_from_scanner @ scan.points[cell].astype(float) == pytest.approx(wanted, abs=1e-6)
        assert scan.intensity[cell] == 10 * row + 1
    assert np.linalg.norm(scan.rays, axis=-1) == pytest.approx(np.ones(scan.shape))


def test_a_window_keeps_its_edges(tmp_path: Path) -> None:
    whole = read_scan(write_recording(tmp_path / "a.pcap", "LEGACY"))
    scan = read_scan(write_recording(tmp_path / "b.pcap", "LEGACY", window=(0, 15)))
    assert scan.valid.sum() == 4 * 16 - 1
    assert scan.shape == (4, 20), "the shifts of -2 to 2 columns reach over both ends"
    found, expected = scan.points[scan.valid], whole.points[whole.valid]
    nearest = np.linalg.norm(found[:, None] - expected[None], axis=-1).min(axis=1)
    assert nearest.max() < 1e-6
    nearly = read_scan(write_recording(tmp_path / "c.pcap", "LEGACY", window=(0, 30)))  # no room for the edges
    assert nearly.shape == (4, _COLUMNS)


def test_frames_are_counted_among_the_complete_ones(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.pcap", "LEGACY")
    assert [read_frame(path, scan_index=k).number for k in (0, 1)] == [5, 6]
    with pytest.raises(OptionError, match="2 complete frames"):
        read_scan(path, scan_index=2)
    broken = write_recording(tmp_path / "b.pcap", "LEGACY", lost=2)
    assert read_frame(broken).number == 6


def test_refusals_say_what_to_do(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.pcap", "LEGACY")
    beside = path.with_suffix(".json")
    beside.write_text(beside.read_text().replace("LEGACY", "FUSA_RNG15_RFL8_NIR8_DUAL"))
    with pytest.raises(FormatError, match="FUSA_RNG15_RFL8_NIR8_DUAL, which is not read"):
        read_scan(path)
    beside.unlink()
    large = _frames(bytes(2304), 9, vlan=False, most=1 << 16)[0]
    path.write_bytes(path.read_bytes() + struct.pack("<IIII", 0, 0, len(large), len(large)) + large)
    with pytest.raises(FormatError, match=r"put that file beside it as a\.json"):
        read_scan(path)
    velodyne = _frames(bytes(1206), 0, vlan=False, most=1 << 16)[0]
    path.write_bytes(path.read_bytes()[:24] + struct.pack("<IIII", 0, 0, len(velodyne), len(velodyne)) + velodyne)
    with pytest.raises(FormatError, match=r"neither Ouster nor Velodyne sensors send"):
        read_scan(path)


def _best_shifts(path: Path) -> list[int]:
    """Return for each pair of neighbouring rows the shift at which their reflectivities agree best."""
    rows = np.log1p(read_scan(path).intensity)
    return [
        max(range(-4, 5), key=lambda by: float(np.corrcoef(np.roll(rows[row], by), rows[row + 1])[0, 1]))
        for row in range(40, 100)
    ]


@pytest.mark.slow
def test_a_street(real_data: Path, tmp_path: Path) -> None:
    path = real_data / "ouster_street" / "OS-0-128-U1_v2.3.0_1024x10.pcap"
    scan = read_scan(path)
    assert scan.shape == (128, 1024)
    assert scan.valid.mean() > 0.7
    assert np.mean(np.equal(_best_shifts(path), 0)) > 0.6
    control = tmp_path / path.name  # every second row one column off
    control.write_bytes(path.read_bytes())
    fields = json.loads(path.with_suffix(".json").read_text())
    shifts = fields["data_format"]["pixel_shift_by_row"]
    fields["data_format"]["pixel_shift_by_row"] = [shift + k % 2 for k, shift in enumerate(shifts)]
    control.with_suffix(".json").write_text(json.dumps(fields))
    assert np.mean(np.equal(_best_shifts(control), 0)) < 0.3
