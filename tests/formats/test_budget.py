"""Memory limits of reading: the readers' estimates match their needs, and large valid files still open."""

from __future__ import annotations

import io
import json
import re
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.formats import describe, read_photo, read_scan
from ladarreg_core.formats.documents.matches_file import read_matches
from ladarreg_core.formats.parsing import json_file
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.yaml_file import parse_yaml
from ladarreg_core.formats.photos.image_file import read_image
from ladarreg_core.formats.scans.npz import read_npz, write_npz_counts, write_npz_xyz
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from testing.attacks import bombs

ROWS, COLUMNS = 400, 600
_LIBRARIES = 25_000_000  # loaded by the first use of some functions


def _large_files(folder: Path, make: Any) -> dict[str, Path]:
    """Write one scan in every form, large enough that its arrays outweigh everything else."""
    generator = np.random.default_rng(0)
    row, column = np.mgrid[:ROWS, :COLUMNS]
    counts = (1000 + 2 * column + row + generator.integers(0, 5, (ROWS, COLUMNS))).astype(np.uint16)
    counts[generator.random((ROWS, COLUMNS)) < 0.1] = 0
    intensity = generator.integers(0, 200, (ROWS, COLUMNS)).astype(np.uint16)
    geometry = AzimuthElevation(ROWS, COLUMNS, 0.002, 0.002)
    scan = Scan(geometry, np.where(counts == 0, np.nan, 1 + counts * 0.002), intensity.astype(np.float32))
    points, strength = scan.points.reshape(-1, 3), scan.intensity.ravel()
    write_npz_counts(folder / "counts.npz", counts=counts, intensity=intensity, geometry=geometry, r0_m=1, dr_m=0.002)
    write_npz_xyz(folder / "xyz.npz", scan)
    (folder / "grid.pcd").write_bytes(make.pcd(points, strength, width=COLUMNS, height=ROWS))
    (folder / "cloud.pcd").write_bytes(make.pcd(points, strength))
    make.e57(folder / "grid.e57", make.e57_fields(scan, color=True))
    make.e57(folder / "cloud.e57", make.e57_fields(scan, grid=False))
    depth = bombs.depth_image(folder / "depth", COLUMNS, ROWS)
    Image.fromarray(np.nan_to_num(scan.ranges * 1000).astype(np.uint16)).save(folder / "depth" / "depth.png")
    return {path.name: path for path in (*folder.glob("*.*"), depth)}


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="needs os.fork and the resource module")
def test_readers_use_the_memory_they_estimate(tmp_path: Path, make: Any) -> None:
    files = _large_files(tmp_path, make)
    assert len(files) == 7
    costs = bombs.costs_of([("scan", path) for path in files.values()])
    for (name, path), cost in zip(files.items(), costs, strict=True):
        with pytest.raises(FormatError, match="of memory, and a read of") as caught:
            read_scan(path, memory_bytes=1)
        found = re.search(r"would need ([0-9.]+) GB", str(caught.value))
        assert found is not None
        reckoned = 1e9 * float(found[1])
        assert cost.outcome == "read", (name, cost)
        assert cost.peak_bytes < reckoned + _LIBRARIES, (name, reckoned, cost)
        assert cost.peak_bytes > 0.4 * reckoned, (name, reckoned, cost)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs os.fork and the resource module")
def test_photographs_use_the_memory_they_estimate(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (1500, 2000, 3), dtype=np.uint8)
    image = Image.fromarray(pixels)
    image.save(tmp_path / "a.jpg")
    image.save(tmp_path / "progressive.jpg", progressive=True, subsampling=0)
    image.convert("L").save(tmp_path / "gray.png")
    image.convert("RGBA").save(tmp_path / "alpha.png")
    Image.fromarray(pixels[..., 0].astype(np.uint16) + 29_000).save(tmp_path / "deep.png")  # centikelvin
    Image.fromarray(pixels[..., 0].astype(np.float32) / 255).save(tmp_path / "float.tif")
    files = sorted(tmp_path.iterdir())
    for path, cost in zip(files, bombs.costs_of([("photo", path) for path in files]), strict=True):
        with pytest.raises(FormatError, match="the image of 2,000 x 1,500 pixels would need") as caught:
            read_photo(path, focal_px=2000, memory_bytes=1)
        found = re.search(r"would need ([0-9.]+) GB", str(caught.value))
        assert found is not None
        assert cost.outcome == "read", (path.name, cost)
        assert cost.peak_bytes < 1e9 * float(found[1]) + _LIBRARIES, (path.name, found[1], cost)


def test_large_valid_files_are_within_the_budget() -> None:
    ReadBudget.of(98_000_000).require(10_000_000 * 432, "10 million points of an E57")
    ReadBudget.of(8_000_000).require_pixels(12_240, 8_160, 10.3)  # 100 Mpixel, progressive
    ReadBudget.of(40_000_000).require_cells(2500, 4000, 218)
    ReadBudget.of(12_000_000).require_pixels(16_320, 12_240, 9.5)  # 200 Mpixel of a phone
    assert ReadBudget.of(0).limit_bytes == 1 << 30
    assert ReadBudget.of(1 << 30).limit_bytes == 97 << 30


def test_the_budget_is_an_option_and_named(tmp_path: Path, wall: Scan) -> None:
    write_npz_xyz(tmp_path / "a.npz", wall)
    with pytest.raises(FormatError, match=r"its grid of 24 x 36 cells would need 0\.000309 GB .* may use 0\.0001 GB"):
        read_scan(tmp_path / "a.npz", memory_bytes=100_000)
    assert read_scan(tmp_path / "a.npz", memory_bytes=1_000_000).shape == (24, 36)
    for wrong in (0, -1, 1.5, True):
        with pytest.raises(OptionError, match="memory_bytes"):
            read_scan(tmp_path / "a.npz", memory_bytes=wrong)  # type: ignore[arg-type]


def test_claimed_header_lengths_are_not_trusted(tmp_path: Path) -> None:
    path = bombs.npz_of_long_header(tmp_path / "a.npz", header_bytes=30 << 20)
    with pytest.raises(FormatError, match="damaged header"):
        read_npz(path)
    np.savez(tmp_path / "b.npz", intensity=np.ones((3, 3)), counts=np.ones((3, 3), int), intensity_is="raw" * 2000)
    with pytest.raises(FormatError, match="must be one short string"):
        read_npz(tmp_path / "b.npz")
    with zipfile.ZipFile(tmp_path / "c.npz", "w", zipfile.ZIP_LZMA) as archive:
        buffer = io.BytesIO()
        np.save(buffer, np.ones((3, 3)))
        archive.writestr("intensity.npy", buffer.getvalue())
    with pytest.raises(FormatError, match=r"numpy\.savez"):
        read_npz(tmp_path / "c.npz")


def test_jpeg_2000_data_of_another_size_than_the_header(tmp_path: Path) -> None:
    path = tmp_path / "a.jp2"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 80), dtype=np.uint8)).save(path)
    assert read_image(path).values.shape == (64, 80)
    data = bytearray(path.read_bytes())
    at = data.index(b"ihdr") + 4
    data[at : at + 8] = (8).to_bytes(4, "big") + (9).to_bytes(4, "big")
    path.write_bytes(data)
    with pytest.raises(FormatError, match="header says 9 x 8 pixels, its data 80 x 64"):
        read_image(path)


def test_long_lines_of_yaml_take_time_in_proportion() -> None:
    took = []
    for size in (10_000, 90_000):
        started = time.process_time()
        for text in ("image_width" + " " * size + "x", "image_width: " + "a:" * (size // 2), "a" * size):
            try:
                parse_yaml(text)
            except FormatError:
                continue
        took.append(time.process_time() - started)
    assert took[1] < 0.5 + 20 * took[0]
    with pytest.raises(FormatError, match="a line of 100,013 characters"):
        parse_yaml("image_width: " + "1" * 100_000)


def test_json_is_parsed_once(tmp_path: Path, wall: Scan, make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    parsed = []
    loads = json.loads
    monkeypatch.setattr(json_file.json, "loads", lambda *a, **k: parsed.append(1) or loads(*a, **k))
    descriptor = make.depth_image(tmp_path)
    matches = bombs.matches_json(tmp_path / "matches.json", count=3)
    for read, path in ((read_scan, descriptor), (describe, descriptor), (describe, matches)):
        parsed.clear()
        read(path)
        assert len(parsed) == 1, (read, path)
    (tmp_path / "bad.json").write_text('{"matches": [')
    parsed.clear()
    with pytest.raises(FormatError, match="a matches file is JSON"):
        describe(tmp_path / "bad.json")
    assert len(parsed) == 1
    (tmp_path / "bad.json").write_text('{"matches": []}')
    with pytest.raises(FormatError, match="scan_coordinates"):  # earlier parses are not cached
        read_matches(tmp_path / "bad.json", wall)


@pytest.mark.slow
def test_the_most_matches(tmp_path: Path, wall: Scan) -> None:
    for write in (bombs.matches_json, bombs.matches_csv):
        assert len(read_matches(write(tmp_path / "a", count=5000), wall)) == 5000
        assert "5000 points" in str(describe(tmp_path / "a").matches)
        with pytest.raises(FormatError, match="at most 5,000 are read"):
            read_matches(write(tmp_path / "a", count=5001), wall)
