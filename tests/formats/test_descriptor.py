"""Descriptors: depth images and raw counts."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.errors import LadarregError
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.scans.descriptor import read_descriptor
from ladarreg_core.scanner.grids import AzimuthElevation, PinholeGrid


def test_z_depth_becomes_a_plane_through_the_lens(tmp_path: Path, make: Any) -> None:
    scan = read_scan(make.depth_image(tmp_path))
    assert isinstance(scan.geometry, PinholeGrid)
    assert scan.geometry.camera.distortion == (0.1, 0, 0, 0)
    np.testing.assert_allclose(scan.points[scan.valid][:, 0], 2.0, rtol=1e-6)
    assert not scan.valid[3, 5]
    assert scan.valid.sum() == 30 * 40 - 1
    assert scan.intensity[0, 7] == 3500
    assert scan.points[15, 0, 1] > 0.9, "column 0 is left"
    assert scan.points[0, 19, 2] > 0.7, "row 0 is the top"


def test_range_depth_is_taken_along_the_ray(tmp_path: Path, make: Any) -> None:
    scan = read_descriptor(
        make.depth_image(tmp_path, depth_is="range", depth_unit_m=0.002, intensity_is="range_normalised")
    )
    np.testing.assert_allclose(scan.ranges[scan.valid], 4.0)
    assert scan.intensity_is == "range_normalised"


def test_centimetres_called_metres_are_suspected(tmp_path: Path, make: Any) -> None:
    assert any("millimetres" in note for note in read_descriptor(make.depth_image(tmp_path, depth_unit_m=1.0)).notes)


CAMERA = {"width": 40, "height": 30, "fx": 38.0, "fy": 37.0, "cx": 19.0, "cy": 15.0}


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"kind": "hologram"}, "'kind'"),
        ({"kind": None}, "not a scan"),
        ({"depth": None}, "'depth' is None"),
        ({"depth": "/etc/passwd"}, "leads out"),
        ({"depth": "../secret.png"}, "leads out"),
        ({"depth": "link.png"}, "leads out"),
        ({"depth": "gone.png"}, "no such file"),
        ({"depth": "."}, "folder"),
        ({"depth": ["depth.png"]}, "must be the name"),
        ({"depth": "depth\0.png"}, "must be the name"),
        ({"depth": "scan.json"}, "not an image"),
        ({"depth": "rgb.png"}, "one channel"),
        ({"depth": "empty.png"}, "empty"),
        ({"intensity": None}, "'intensity' is missing"),
        ({"depth_unit_m": 0}, "depth_unit_m"),
        ({"depth_unit_m": -1}, "depth_unit_m"),
        ({"depth_unit_m": "0.001"}, "depth_unit_m"),
        ({"depth_unit_m": True}, "depth_unit_m"),
        ({"depth_is": "height"}, "depth_is"),
        ({"camera": None}, "'camera' is missing"),
        ({"camera": CAMERA | {"fx": 0}}, "fx is 0"),
        ({"camera": CAMERA | {"fy": -5.0}}, "fy is -5"),
        ({"camera": CAMERA | {"width": 41}}, "must agree"),
        ({"camera": CAMERA | {"width": 40.5}}, "whole number"),
        ({"camera": CAMERA | {"distortion": [0.1, 0.2]}}, "12 finite terms"),
        ({"intensity_is": "cooked"}, "intensity_is"),
    ],
)
def test_a_bad_depth_descriptor_is_one_clear_error(
    tmp_path: Path, make: Any, changes: dict[str, Any], word: str
) -> None:
    from PIL import Image

    home = tmp_path / "home"
    home.mkdir()
    Image.new("L", (40, 30)).save(tmp_path / "secret.png")
    os.symlink(tmp_path / "secret.png", home / "link.png")
    Image.new("RGB", (40, 30)).save(home / "rgb.png")
    (home / "empty.png").touch()
    with pytest.raises(LadarregError) as caught:
        read_scan(make.depth_image(home, **changes))
    assert word in str(caught.value), str(caught.value)


def counts_descriptor(folder: Path, raw: bytes, **changes: Any) -> Path:
    (folder / "scan.raw").write_bytes(raw)
    fields: dict[str, Any] = {
        "kind": "counts", "file": "scan.raw", "rows": 3, "columns": 4, "dtype": "<u2", "r0_m": 1.0, "dr_m": 0.002,
        "d_azimuth_rad": 0.01, "d_elevation_rad": 0.01, "intensity_file": "scan.raw",
    }  # fmt: skip
    path = folder / "scan.json"
    path.write_text(json.dumps({k: v for k, v in (fields | changes).items() if v is not None}))
    return path


@given(
    counts=st.lists(st.integers(0, 4095), min_size=12, max_size=12).filter(any),
    strength=st.lists(st.integers(0, 4095), min_size=12, max_size=12),
    dtype=st.sampled_from(["<u4", ">u4", ">i4", "<u8", "uint32"]),
    header=st.integers(0, 40),
)
def test_packed_words_are_unpacked(
    tmp_path_factory: pytest.TempPathFactory, counts: list[int], strength: list[int], dtype: str, header: int
) -> None:
    folder = tmp_path_factory.mktemp("counts")
    words = (np.array(counts) | np.array(strength) << 12 | 0xA << 28).astype(np.uint64)
    code = "<u4" if dtype == "uint32" else dtype.replace("i", "u")
    path = counts_descriptor(
        folder, b"h" * header + words.astype(code).tobytes(), dtype=dtype, header_bytes=header, intensity_file=None,
        count_mask=4095, intensity_mask=4095, intensity_shift=12, azimuth_offset_rad=0.005,
    )  # fmt: skip
    scan = read_scan(path)
    grid = np.array(counts).reshape(3, 4)
    np.testing.assert_array_equal(scan.valid, grid > 0)
    np.testing.assert_allclose(scan.ranges[scan.valid], (1 + grid * 0.002)[grid > 0], rtol=1e-6)
    np.testing.assert_array_equal(scan.intensity, np.array(strength).reshape(3, 4))
    assert scan.geometry == AzimuthElevation(3, 4, 0.01, 0.01, 0.005, 0.0)


def test_intensity_from_a_separate_file(tmp_path: Path) -> None:
    (tmp_path / "ir.raw").write_bytes(np.arange(12, dtype=">f4").tobytes())
    raw = np.arange(1, 13, dtype=">u2").tobytes() + b"tail"
    scan = read_scan(counts_descriptor(tmp_path, raw, dtype=">u2", intensity_file="ir.raw", intensity_dtype=">f4"))
    np.testing.assert_array_equal(scan.intensity, np.arange(12).reshape(3, 4))
    assert scan.ranges[0, 1] == pytest.approx(1.004)
    assert "4 bytes more" in scan.notes[0]


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"rows": 200_000, "columns": 1000}, "at most 100,000,000"),
        ({"rows": 5000}, "need 40,000"),
        ({"rows": 0}, "'rows'"),
        ({"rows": 2.5}, "'rows'"),
        ({"rows": 10**400}, "'rows'"),
        ({"columns": None}, "'columns' is missing"),
        ({"dtype": "O"}, "'dtype'"),
        ({"dtype": "V9999999"}, "'dtype'"),
        ({"dtype": "<f4"}, "counts are integers"),
        ({"dtype": 16}, "'dtype'"),
        ({"header_bytes": 5}, "need 29"),
        ({"header_bytes": -1}, "header_bytes"),
        ({"r0_m": None}, "'r0_m' is missing"),
        ({"dr_m": 0}, "dr_m"),
        ({"d_azimuth_rad": 3.0}, "d_azimuth_rad"),
        ({"d_elevation_rad": -0.1}, "d_elevation_rad"),
        ({"intensity_mask": 255}, "both"),
        ({"intensity_file": "../x.raw"}, "leads out"),
        ({"count_mask": 1 << 20}, "do not fit"),
        ({"count_shift": 16}, "do not fit"),
        ({"file": None}, "'file' is None"),
    ],
)
def test_a_bad_counts_descriptor_is_one_clear_error(tmp_path: Path, changes: dict[str, Any], word: str) -> None:
    raw = np.arange(1, 13, dtype="<u2").tobytes()
    with pytest.raises(LadarregError) as caught:
        read_scan(counts_descriptor(tmp_path, raw, **changes))
    assert word in str(caught.value), str(caught.value)
