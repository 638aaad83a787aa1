"""Small files that claim, or expand to, very large ones: none may take more than a gigabyte or five seconds."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from testing.attacks import bombs

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs os.fork and the resource module")
_MAX_BYTES, _MAX_SECONDS = 1_000_000_000, 5.0
_QUICKLY_BYTES, _QUICKLY_SECONDS = 150_000_000, 1.0


@pytest.mark.slow
def test_claims_are_refused_before_anything_is_allocated(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    refused = {
        "e57 of constants": ("scan", bombs.e57_of_constants(tmp_path / "a.e57", points=14_000_000, padding=18_000)),
        "e57 described": ("describe", tmp_path / "a.e57"),
        "e57 of many elements": ("scan", bombs.e57_of_many_elements(tmp_path / "b.e57", children=20_000)),
        "e57 of one picture": ("extract", bombs.e57_of_one_picture(tmp_path / "c.e57", times=2000, length=200_000)),
        "png of bits": ("photo", bombs.blank_png(tmp_path / "a.png", 13_000, 13_000, bits=1)),
        "png of 16 bits": ("photo", bombs.blank_png(tmp_path / "b.png", 9_000, 9_000, bits=16)),
        "jpeg of many passes": ("photo", bombs.jpeg_of_many_passes(tmp_path / "a.jpg", side=3000, passes=3000)),
        "counts npz": ("scan", bombs.counts_npz(tmp_path / "a.npz", 6000, 6000)),
        "xyz npz": ("scan", bombs.xyz_npz(tmp_path / "b.npz", 3000, 4000)),
        "npz of a long header": ("scan", bombs.npz_of_long_header(tmp_path / "c.npz", header_bytes=200 << 20)),
        "pcd cloud": ("scan", bombs.compressed_pcd(tmp_path / "a.pcd", width=4_000_000, height=1)),
        "pcd grid": ("scan", bombs.compressed_pcd(tmp_path / "b.pcd", width=2000, height=2000)),
        "depth picture": ("scan", bombs.depth_image(tmp_path / "depth", 4000, 4000)),
        "camera of one line": ("camera", bombs.long_camera_yaml(tmp_path / "a.yml", size=90_000)),
        "camera of a longer line": ("camera", bombs.long_camera_yaml(tmp_path / "b.yml", size=900_000)),
        "matches json": ("matches", bombs.matches_json(tmp_path / "a.json", count=18_000)),
        "matches csv": ("matches", bombs.matches_csv(tmp_path / "a.csv", count=39_000)),
    }
    costs = bombs.costs_of(list(refused.values()), most_bytes=6 << 30, most_seconds=30)
    for (name, (_, path)), cost in zip(refused.items(), costs, strict=True):
        assert path.stat().st_size < 1_000_000, name
        assert "Error: " in cost.outcome, (name, cost)
        assert cost.peak_bytes < _QUICKLY_BYTES, (name, cost)
        assert cost.seconds < _QUICKLY_SECONDS, (name, cost)


@pytest.mark.long
def test_the_largest_permitted_expansion_of_small_files(tmp_path: Path) -> None:
    largest = [
        ("scan", bombs.compressed_pcd(tmp_path / "a.pcd", width=1_900_000, height=1)),
        ("scan", bombs.xyz_npz(tmp_path / "a.npz", 1000, 2000)),
        ("scan", bombs.depth_image(tmp_path / "depth", 2000, 1000)),
        ("photo", bombs.blank_png(tmp_path / "a.png", 4000, 4000, bits=16)),
        ("photo", bombs.blank_png(tmp_path / "b.png", 4000, 4000, colors=3)),
    ]
    for (_, path), cost in zip(largest, bombs.costs_of(largest, most_seconds=30), strict=True):
        assert cost.peak_bytes < _MAX_BYTES, (path.name, cost)
        assert cost.seconds < _MAX_SECONDS, (path.name, cost)


@pytest.mark.slow
def test_large_text_files_are_refused_by_their_size(tmp_path: Path) -> None:
    jobs = [
        ("matches", bombs.matches_json(tmp_path / "a.json", count=400_000)),
        ("describe", tmp_path / "a.json"),
        ("matches", bombs.matches_csv(tmp_path / "a.csv", count=800_000)),
        ("describe", tmp_path / "a.csv"),
    ]
    for (_, path), cost in zip(jobs, bombs.costs_of(jobs, most_seconds=30), strict=True):
        assert "at most 8,000,000" in cost.outcome, (path.name, cost)
        assert cost.seconds < _QUICKLY_SECONDS, (path.name, cost)
