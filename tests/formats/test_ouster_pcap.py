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
from testing.files.ouster_recordings import (
    COLUMNS,
    METADATA,
    PIXEL,
    SHIFTS,
    ethernet_frames,
    millimetres,
    write_ouster_recording,
)


def seed_files(folder: Path) -> list[Path]:
    return [
        write_ouster_recording(folder / "single.pcap", "RNG19_RFL8_SIG16_NIR16", most=400),
        write_ouster_recording(folder / "old.pcapng", "LEGACY", pcapng=True, vlan=True),
    ]


@pytest.mark.parametrize("profile", list(PIXEL))
@pytest.mark.parametrize("way", [{}, {"pcapng": True, "vlan": True}, {"most": 400}])
def test_points_follow_the_makers_formula(tmp_path: Path, profile: str, way: dict[str, object]) -> None:
    scan = read_scan(write_ouster_recording(tmp_path / "a.pcap", profile, **way))  # type: ignore[arg-type]
    assert scan.shape == (4, COLUMNS)
    assert scan.valid.sum() == 4 * COLUMNS - 1
    assert scan.world_from_scanner is not None
    for row, column in ((0, 0), (0, 31), (1, 7), (2, 3), (3, 20)):
        encoder = 2 * np.pi * (1 - column / COLUMNS)
        azimuth = encoder - np.radians(METADATA["beam_azimuth_angles"][row])  # type: ignore[index]
        altitude = np.radians(METADATA["beam_altitude_angles"][row])  # type: ignore[index]
        mm = millimetres(row, column)
        lidar = (mm - 20) * np.array(
            [np.cos(azimuth) * np.cos(altitude), np.sin(azimuth) * np.cos(altitude), np.sin(altitude)]
        ) + 20 * np.array([np.cos(encoder), np.sin(encoder), 0])
        wanted = np.array([-lidar[0], -lidar[1], lidar[2] + 36]) / 1000
        cell = (row, (column + SHIFTS[row]) % COLUMNS)
        assert scan.world_from_scanner @ scan.points[cell].astype(float) == pytest.approx(wanted, abs=1e-6)
        assert scan.intensity[cell] == 10 * row + 1
    assert np.linalg.norm(scan.rays, axis=-1) == pytest.approx(np.ones(scan.shape))


def test_a_window_keeps_its_edges(tmp_path: Path) -> None:
    whole = read_scan(write_ouster_recording(tmp_path / "a.pcap", "LEGACY"))
    scan = read_scan(write_ouster_recording(tmp_path / "b.pcap", "LEGACY", window=(0, 15)))
    assert scan.valid.sum() == 4 * 16 - 1
    assert scan.shape == (4, 20), "the shifts of -2 to 2 columns reach over both ends"
    found, expected = scan.points[scan.valid], whole.points[whole.valid]
    nearest = np.linalg.norm(found[:, None] - expected[None], axis=-1).min(axis=1)
    assert nearest.max() < 1e-6
    nearly = read_scan(write_ouster_recording(tmp_path / "c.pcap", "LEGACY", window=(0, 30)))  # no room for the edges
    assert nearly.shape == (4, COLUMNS)


def test_frames_are_counted_among_the_complete_ones(tmp_path: Path) -> None:
    path = write_ouster_recording(tmp_path / "a.pcap", "LEGACY")
    assert [read_frame(path, scan_index=k).number for k in (0, 1)] == [5, 6]
    with pytest.raises(OptionError, match="2 complete frames"):
        read_scan(path, scan_index=2)
    broken = write_ouster_recording(tmp_path / "b.pcap", "LEGACY", lost=2)
    assert read_frame(broken).number == 6


def test_refusals_say_what_to_do(tmp_path: Path) -> None:
    path = write_ouster_recording(tmp_path / "a.pcap", "LEGACY")
    beside = path.with_suffix(".json")
    beside.write_text(beside.read_text().replace("LEGACY", "FUSA_RNG15_RFL8_NIR8_DUAL"))
    with pytest.raises(FormatError, match="FUSA_RNG15_RFL8_NIR8_DUAL, which is not read"):
        read_scan(path)
    beside.unlink()
    large = ethernet_frames(bytes(2304), 9, vlan=False, most=1 << 16)[0]
    path.write_bytes(path.read_bytes() + struct.pack("<IIII", 0, 0, len(large), len(large)) + large)
    with pytest.raises(FormatError, match=r"put that file beside it as a\.json"):
        read_scan(path)
    velodyne = ethernet_frames(bytes(1206), 0, vlan=False, most=1 << 16)[0]
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
