"""Recordings of an Ouster sensor with four beams, made by hand from the published layout."""

from __future__ import annotations

import json
import struct
from pathlib import Path

COLUMNS, _PER_PACKET = 32, 16
SHIFTS = [2, 0, -2, 0]
METADATA = {
    "prod_line": "OS-1-4", "prod_sn": "7", "beam_altitude_angles": [10.0, 3.0, -3.0, -10.0],
    "beam_azimuth_angles": [22.5, 0.0, -22.5, 0.0], "lidar_origin_to_beam_origin_mm": 20.0,
    "lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36, 0, 0, 0, 1],
}  # fmt: skip
PIXEL = {
    "LEGACY": lambda mm, r: struct.pack("<IHHHH", mm | 0xF << 28, r, 5, 9, 0),
    "RNG19_RFL8_SIG16_NIR16": lambda mm, r: struct.pack("<IBBHHH", mm | 0xF << 19, r, 0, 5, 9, 0),
    "RNG19_RFL8_SIG16_NIR16_DUAL": lambda mm, r: struct.pack("<IIHHHH", mm | r << 24, 7, 5, 6, 9, 0),
    "RNG15_RFL8_NIR8": lambda mm, r: struct.pack("<HBB", mm // 8 | 0x8000, r, 9),
}


def millimetres(row: int, column: int) -> int:
    return 0 if (row, column) == (1, 5) else 2000 + 400 * row + 8 * column


def _payload(profile: str, number: int, first: int) -> bytes:
    legacy = profile == "LEGACY"
    body = b"" if legacy else struct.pack("<HHI", 1, number, 0)[:7] + (7).to_bytes(5, "little") + bytes(20)
    for column in range(first, first + _PER_PACKET):
        pixels = b"".join(PIXEL[profile](millimetres(row, column), 10 * row + 1) for row in range(4))
        if legacy:
            body += struct.pack("<QHHI", 0, column, number, 0) + pixels + b"\xff" * 4
        else:
            body += struct.pack("<QHH", 0, column, 1) + pixels
    return body if legacy else body + bytes(32)


def ethernet_frames(payload: bytes, ident: int, *, vlan: bool, most: int) -> list[bytes]:
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


def write_ouster_recording(
    path: Path,
    profile: str,
    *,
    pcapng: bool = False,
    vlan: bool = False,
    most: int = 1 << 16,
    lost: int | None = None,
    window: tuple[int, int] = (0, COLUMNS - 1),
) -> Path:
    """A recording that starts within a frame, with two complete frames after it, and its JSON."""
    starts = [(4, 16), (5, 0), (5, 16), (6, 0), (6, 16)]
    packets = []
    for ident, (number, first) in enumerate(starts):
        if ident != lost and window[0] <= first <= window[1]:
            packets += ethernet_frames(_payload(profile, number, first), ident, vlan=vlan, most=most)
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
        "columns_per_frame": COLUMNS, "columns_per_packet": _PER_PACKET, "pixels_per_column": 4,
        "pixel_shift_by_row": SHIFTS, "column_window": list(window), "udp_profile_lidar": profile,
    }  # fmt: skip
    path.with_suffix(".json").write_text(json.dumps({**METADATA, "data_format": layout}), encoding="utf-8")
    return path
