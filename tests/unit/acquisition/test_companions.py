"""Measurements of several files in a watched folder: a descriptor with its raw files, a recording with its JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.acquisition.devices.folder_source import FolderSource
from ladarreg_core.acquisition.interfaces import Arrival, PanTilt
from ladarreg_core.errors import DeviceError
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.scans.scan_files import ScanFiles, scan_files
from testing.devices.simulated_clock import SimulatedClock

ROWS, COLUMNS = 30, 40
FIELDS = {
    "kind": "counts", "rows": ROWS, "columns": COLUMNS, "dtype": "<u2", "r0_m": 1.0, "dr_m": 0.002,
    "d_azimuth_rad": 0.01, "d_elevation_rad": 0.01,
}  # fmt: skip
AT = Arrival(0, PanTilt(0.0, 0.0))


def goes_on() -> None:
    pass


def check(path: Path) -> None:
    read_scan(path)


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture
def watched(tmp_path: Path) -> Path:
    (tmp_path / "watched").mkdir()
    return tmp_path / "watched"


@pytest.fixture
def source(watched: Path, clock: SimulatedClock) -> FolderSource:
    return FolderSource(
        watched, is_readable=check, timeout_s=30, device="the scanner", files_of=scan_files, clock=clock
    )


def raw(level: int) -> bytes:
    return (level + np.arange(ROWS * COLUMNS)).astype("<u2").tobytes()


def described(name: str) -> bytes:
    return json.dumps({**FIELDS, "file": name}).encode()


def level_of(path: Path) -> int:
    """Return the first count of a scan that was copied."""
    return round((float(read_scan(path).ranges[0, 0]) - 1.0) / 0.002)


@pytest.mark.parametrize("order", [("raw", "json"), ("json", "raw")])
def test_a_descriptor_and_its_raw_file_travel_together(
    source: FolderSource, watched: Path, clock: SimulatedClock, tmp_path: Path, order: tuple[str, str]
) -> None:
    for number, level in enumerate((500, 700)):
        source.arrived(AT)
        content = {"raw": raw(level), "json": described(f"shot_{number}.raw")}
        for delay, kind in zip((1.0, 4.0), order, strict=True):
            path = watched / f"shot_{number}.{kind}"
            clock.after(delay, lambda path=path, data=content[kind]: path.write_bytes(data))
        landing = tmp_path / f"landing_{number}"
        landing.mkdir()
        assert level_of(source.next_file(landing, check=goes_on)) == level
        assert {path.name for path in landing.iterdir()} == {f"shot_{number}.raw", f"shot_{number}.json"}


def test_one_descriptor_serves_a_raw_file_that_is_written_anew(
    source: FolderSource, watched: Path, clock: SimulatedClock, tmp_path: Path
) -> None:
    (watched / "scan.json").write_bytes(described("scan.raw"))
    for level in (500, 700, 900):
        source.arrived(AT)
        clock.after(1.0, lambda level=level: (watched / "scan.raw").write_bytes(raw(level)))
        assert level_of(source.next_file(tmp_path, check=goes_on)) == level


def test_a_raw_file_of_an_earlier_place_makes_the_measurement_stray(
    source: FolderSource, watched: Path, clock: SimulatedClock, tmp_path: Path
) -> None:
    (watched / "early.raw").write_bytes(raw(500))
    source.arrived(AT)
    clock.after(1.0, lambda: (watched / "early.json").write_bytes(described("early.raw")))
    clock.after(5.0, lambda: (watched / "right.raw").write_bytes(raw(700)))
    clock.after(6.0, lambda: (watched / "right.json").write_bytes(described("right.raw")))
    assert level_of(source.next_file(tmp_path, check=goes_on)) == 700


def test_what_is_missing_is_said(source: FolderSource, watched: Path, clock: SimulatedClock, tmp_path: Path) -> None:
    source.arrived(AT)
    clock.after(1.0, lambda: (watched / "shot.json").write_bytes(described("shot.raw")))
    with pytest.raises(DeviceError, match=r"shot\.json came but is not complete"):
        source.next_file(tmp_path, check=goes_on)


def test_a_recording_has_the_json_of_its_sensor(tmp_path: Path) -> None:
    (tmp_path / "shot.pcap").write_bytes(b"\xd4\xc3\xb2\xa1")
    assert scan_files(tmp_path / "shot.pcap") == ScanFiles(tmp_path / "shot.pcap", (tmp_path / "shot.pcap",))
    (tmp_path / "shot.json").write_text("{}")
    found = scan_files(tmp_path / "shot.pcap")
    assert found.opened == tmp_path / "shot.pcap"
    assert found.all == (tmp_path / "shot.json", tmp_path / "shot.pcap")


def test_a_descriptor_names_nothing_outside_its_folder(tmp_path: Path) -> None:
    (tmp_path / "scan.json").write_bytes(described("../../etc/passwd"))
    assert scan_files(tmp_path / "scan.json") == ScanFiles(tmp_path / "scan.json", (tmp_path / "scan.json",))
