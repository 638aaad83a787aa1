"""LAS and LAZ files written by laspy: coordinates, intensity, colour, and clean refusals."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree

from ladarreg_core.errors import Cancelled, FormatError, OptionError, UnderspecifiedError
from ladarreg_core.formats import describe, read_scan
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.scan import Scan
from testing.scenes.simulated_clouds import brightness, dome, in_room

UTM = np.array([691_234.0, 5_334_321.0, 519.0])
SCANNER = UTM + np.array([0.4, -0.6, 1.5])
ORIGIN = tuple(SCANNER.tolist())
POINTS = in_room(dome(2.0)) + UTM
INTENSITY = (200 * brightness(POINTS - UTM)).clip(0, 65535).astype(np.uint16)
COLOR = np.stack([INTENSITY >> 8, INTENSITY % 256, 255 - (INTENSITY >> 8)], axis=-1).astype(np.uint16)


def las(path: Path, point_format: int = 6, version: str = "1.4", *, points: np.ndarray = POINTS, **fields: Any) -> Path:
    """Write a file with laspy; further fields by name, `extra_` in front of those that are extra bytes."""
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [0.001] * 3, np.floor(points.min(axis=0))
    for name, values in fields.items():
        if name.startswith("extra_"):
            header.add_extra_dim(laspy.ExtraBytesParams(name=name[6:], type=values.dtype))
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    for name, values in {"intensity": INTENSITY[: len(points)], **fields}.items():
        data[name.removeprefix("extra_")] = values
    data.write(path)
    return path


def seed_files(folder: Path) -> list[Path]:
    """Write valid files."""
    few = in_room(dome(9.0)) - [0.4, -0.6, 1.5]
    plain = {"points": few, "intensity": INTENSITY[: len(few)]}
    rgb = dict(zip(("red", "green", "blue"), COLOR[: len(few)].T, strict=True))
    return [
        las(folder / "old.las", 1, "1.2", **plain),
        las(folder / "new.las", 7, "1.4", **plain, **rgb),
        las(folder / "old.laz", 3, "1.2", **plain, **rgb),
        las(folder / "new.laz", 6, "1.4", **plain, extra_reflectance=few[:, 0].astype(np.float32)),
    ]


def _written(scan: Scan) -> np.ndarray:
    """Return the scan's points (N, 3) in the file's coordinates."""
    assert scan.world_from_scanner is not None
    rays, ranges = scan.rays[scan.valid], scan.ranges[scan.valid].astype(np.float64)
    return rays * ranges[:, None] + scan.world_from_scanner.translation


@pytest.mark.parametrize(
    ("point_format", "version", "suffix"),
    [(0, "1.2", "las"), (1, "1.2", "laz"), (2, "1.3", "laz"), (3, "1.4", "las"), (6, "1.4", "las"), (7, "1.4", "laz"),
     (8, "1.4", "laz")],
)  # fmt: skip
def test_points_intensity_and_color_arrive(tmp_path: Path, point_format: int, version: str, suffix: str) -> None:
    colored = point_format in (2, 3, 7, 8)
    rgb = dict(zip(("red", "green", "blue"), COLOR.T * 256, strict=True)) if colored else {}
    file = las(tmp_path / f"cloud.{suffix}", point_format, version, **rgb)
    scan = read_scan(file, origin=ORIGIN)
    found = _written(scan)
    assert len(found) > 0.99 * len(POINTS)
    distance, index = cKDTree(POINTS).query(found)
    assert distance.max() < 0.001, "half a scale step along each axis, and float32 ranges"
    np.testing.assert_array_equal(scan.intensity[scan.valid], INTENSITY[index])
    assert (scan.color is not None) == colored
    if scan.color is not None:
        np.testing.assert_array_equal(scan.color[scan.valid], COLOR[index])
    mirrored = found * [1, -1, 1] + [0, 2 * SCANNER[1], 0]  # the control: an axis flipped
    assert np.percentile(cKDTree(POINTS).query(mirrored)[0], 90) > 0.1


@pytest.mark.slow
def test_the_scanner_is_found_and_said(tmp_path: Path) -> None:
    points = in_room(dome(1.0)) + UTM
    file = las(tmp_path / "cloud.laz", points=points, intensity=brightness(points - UTM).astype(np.uint16))
    scan = read_scan(file)
    assert scan.world_from_scanner is not None
    np.testing.assert_allclose(scan.world_from_scanner.translation, SCANNER, atol=0.05)
    assert any("was estimated" in note for note in scan.notes)
    assert read_scan(file, origin=ORIGIN).world_from_scanner.translation.tolist() == list(ORIGIN)  # type: ignore[union-attr]


def test_colors_of_eight_bits_in_sixteen_stay(tmp_path: Path) -> None:
    rgb = dict(zip(("red", "green", "blue"), COLOR.T, strict=True))
    scan = read_scan(las(tmp_path / "eight.las", 7, **rgb), origin=ORIGIN)
    assert scan.color is not None
    assert set(np.unique(scan.color[scan.valid])) <= set(np.unique(COLOR))
    assert scan.color.max() == COLOR.max()


def test_intensity_from_extra_bytes_or_from_color(tmp_path: Path) -> None:
    flat = np.zeros(len(POINTS), np.uint16)
    strength = brightness(POINTS - UTM) - 200
    scan = read_scan(las(tmp_path / "r.las", intensity=flat, extra_Reflectance=strength), origin=ORIGIN)
    assert any("'Reflectance'" in note for note in scan.notes)
    assert np.isclose(scan.intensity[scan.valid].min(), strength.min())

    rgb = dict(zip(("red", "green", "blue"), COLOR.T, strict=True))
    colored = las(tmp_path / "c.las", 7, intensity=flat, **rgb)
    with pytest.raises(UnderspecifiedError, match="`intensity='luma'`"):
        read_scan(colored, origin=ORIGIN)
    luma = read_scan(colored, origin=ORIGIN, intensity="luma")
    assert luma.color is not None
    r, g, b = luma.color[luma.valid].astype(np.float64).T
    np.testing.assert_allclose(luma.intensity[luma.valid], 0.2126 * r + 0.7152 * g + 0.0722 * b, atol=1e-3)
    with pytest.raises(FormatError, match="no colours"):
        read_scan(las(tmp_path / "n.las"), origin=ORIGIN, intensity="luma")


def test_withheld_points_are_left_out(tmp_path: Path) -> None:
    withheld = np.zeros(len(POINTS), np.uint8)
    withheld[::7] = 1
    scan = read_scan(las(tmp_path / "w.las", withheld=withheld), origin=ORIGIN)
    gone = cKDTree(POINTS[::7]).query(_written(scan))[0]
    assert np.mean(gone < 0.001) == 0, "other points are farther away than the coordinates are rounded"
    assert any(f"{int(withheld.sum()):,} points that are marked as withheld" in note for note in scan.notes)


def test_waveforms_and_other_refusals_say_how_to_convert(tmp_path: Path) -> None:
    data = las(tmp_path / "a.las", 1, "1.2").read_bytes()
    file = tmp_path / "b.las"
    for code in (4, 5, 9, 10):
        file.write_bytes(data[:104] + bytes([code]) + data[105:])
        with pytest.raises(FormatError, match="waveforms, which is not read: export the points alone"):
            read_scan(file)
    file.write_bytes(data[:25] + bytes([5]) + data[26:])
    with pytest.raises(FormatError, match=r"LAS 1\.5; 1\.0 to 1\.4 are read"):
        read_scan(file)
    with pytest.raises(OptionError, match="`origin`"):
        read_scan(tmp_path / "a.las", scan_index=1)


def test_claims_are_checked_before_anything_is_allocated(tmp_path: Path) -> None:
    plain = las(tmp_path / "a.las", 1, "1.2").read_bytes()
    file = tmp_path / "b.las"
    file.write_bytes(plain[:107] + struct.pack("<I", 4_000_000_000) + plain[111:])
    with pytest.raises(FormatError, match=r"4,000,000,000 points of 28 bytes, but only"):
        read_scan(file)
    packed = las(tmp_path / "a.laz", 6).read_bytes()
    file.write_bytes(packed[:247] + struct.pack("<Q", 1 << 40) + packed[255:])
    with pytest.raises(FormatError, match="contains at most"):
        read_scan(file)
    file.write_bytes(packed[: len(packed) // 2])
    with pytest.raises(FormatError, match="truncated"):
        read_scan(file)
    with pytest.raises(FormatError, match="of memory"):
        read_scan(tmp_path / "a.laz", memory_bytes=1_000_000)


@pytest.mark.slow
def test_info_of_a_cloud_that_needs_an_origin_comes_from_its_header(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    tile = np.column_stack([generator.uniform(0, 100, (5000, 2)), generator.normal(0, 0.01, 5000)]) + UTM
    info = describe(las(tmp_path / "tile.laz", points=tile, intensity=INTENSITY[:5000]))
    assert info.format == "LAZ 1.4, point format 6"
    assert info.scans[0].startswith("5,000 points, 99.9 x 100.0 x 0.1 m from X 691234.016, Y 5334321.010")
    assert "`origin`" in info.notes[0]


def test_progress_counts_points_and_can_be_cancelled(tmp_path: Path) -> None:
    file = las(tmp_path / "a.laz")
    seen: list[Progress] = []
    read_scan(file, origin=ORIGIN, report=seen.append)
    assert (seen[0].done, seen[0].total) == (0, len(POINTS))
    assert seen[-1].done == len(POINTS)

    def stop(_: Progress) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        read_scan(file, origin=ORIGIN, report=stop)
