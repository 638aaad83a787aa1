"""Headerless clouds of float32: read where their numbers leave no doubt, refused in a sentence otherwise."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ladarreg_core.errors import FormatError
from ladarreg_core.formats import describe, read_scan, recognise
from testing.scenes.simulated_clouds import brightness, in_street, spinning

POINTS = in_street(spinning(16, 360)) - [0, 0, 1.8]
INTENSITY = (brightness(POINTS) / 255).clip(0.01, 1)


def cloud(path: Path, *more: np.ndarray, points: np.ndarray = POINTS) -> Path:
    """Write a cloud as KITTI does, with further columns."""
    columns = [*points.T, INTENSITY[: len(points)], *more]
    path.write_bytes(np.stack(columns, axis=-1).astype("<f4").tobytes())
    return path


def seed_files(folder: Path) -> list[Path]:
    """Write valid files."""
    return [cloud(folder / "000000.bin"), cloud(folder / "few.bin", points=POINTS[::9])]


def test_a_kitti_cloud_is_read(tmp_path: Path) -> None:
    file = cloud(tmp_path / "000000.bin")
    scan = read_scan(file)
    assert int(scan.valid.sum()) > 0.99 * len(POINTS)
    assert scan.shape[0] == 16, "its rings are its rows"
    found = scan.points[scan.valid]
    distance, index = cKDTree(POINTS).query(found)
    assert distance.max() < 1e-4
    np.testing.assert_array_equal(scan.intensity[scan.valid], INTENSITY[index].astype(np.float32))
    assert np.median(cKDTree(POINTS).query(found * [1, -1, 1])[0]) > 0.01, "the control: an axis flipped"
    assert any("no header" in note for note in scan.notes)
    assert describe(file).kind == "scan"


def test_a_first_byte_of_a_brace_is_no_json(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[0, 0] = np.frombuffer(b"\x7b\x14\x46\x42", "<f4")[0]
    file = cloud(tmp_path / "000001.bin", points=points)
    assert file.read_bytes().startswith(b"{")
    assert recognise(file).name == "KITTI bin"
    assert describe(file).kind == "scan"


def test_a_fifth_column_of_whole_numbers_is_the_ring(tmp_path: Path) -> None:
    ring = np.tile(np.arange(16), len(POINTS) // 16 + 1)[: len(POINTS)]
    file = cloud(tmp_path / "five.bin", ring)
    scan = read_scan(file)
    assert int(scan.valid.sum()) > 0.99 * len(POINTS)
    assert cKDTree(POINTS).query(scan.points[scan.valid])[0].max() < 1e-4
    assert any("ring" in note and "no header" in note for note in scan.notes)
    times = cloud(tmp_path / "times.bin", np.linspace(0, 0.1, len(POINTS)))
    with pytest.raises(FormatError):
        read_scan(times)


def test_other_contents_are_refused(tmp_path: Path) -> None:
    doubles = tmp_path / "doubles.bin"
    doubles.write_bytes(np.column_stack([POINTS, INTENSITY]).astype("<f8").tobytes())
    integers = tmp_path / "integers.bin"
    integers.write_bytes(struct.pack("<4000i", *range(4000)))
    noise = tmp_path / "noise.bin"
    noise.write_bytes(np.random.default_rng(0).bytes(64_000))
    swapped = tmp_path / "swapped.bin"
    swapped.write_bytes(np.column_stack([POINTS, INTENSITY]).astype(">f4").tobytes())
    for other in (doubles, integers, noise, swapped):
        with pytest.raises(FormatError, match="unknown"):
            recognise(other)
    renamed = cloud(tmp_path / "cloud.dat")
    with pytest.raises(FormatError, match="unknown"):
        recognise(renamed)


def test_a_cloud_that_breaks_off_or_turns_into_something_else_is_refused(tmp_path: Path) -> None:
    file = cloud(tmp_path / "a.bin")
    data = file.read_bytes()
    file.write_bytes(data[:-3])
    with pytest.raises(FormatError):
        read_scan(file)
    broken = np.frombuffer(data, "<f4").copy()
    broken[-2] = np.nan
    file.write_bytes(broken.tobytes())
    with pytest.raises(FormatError, match=r"throughout|are neither"):
        read_scan(file)
