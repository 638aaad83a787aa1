"""Raw files of counts: a Perceptron's, those without intensity, and those in the wrong byte order."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.errors import FormatError
from ladarreg_core.formats import read_scan
from ladarreg_core.scan import NO_INTENSITY_NOTE
from ladarreg_core.scanner.grids import AzimuthElevation

ROWS, COLUMNS = 60, 90


def room_counts(seed: int) -> np.ndarray:
    """Return the counts of two walls and a pillar, with noise and drop-outs."""
    rng = np.random.default_rng(seed)
    across = np.arange(COLUMNS) / COLUMNS
    counts = np.tile(900 + 1700 * np.abs(across - 0.4), (ROWS, 1)) + rng.normal(0, 2.0, (ROWS, COLUMNS))
    counts[20:, 50:60] = 400 + rng.normal(0, 2.0, (ROWS - 20, 10))
    counts[rng.random(counts.shape) < 0.02] = 0
    return counts.round().astype(np.uint32)


def written(folder: Path, counts: np.ndarray, *, code: str, **changes: Any) -> Path:
    (folder / "scan.raw").write_bytes(counts.astype(code).tobytes())
    fields = {
        "kind": "counts", "file": "scan.raw", "rows": ROWS, "columns": COLUMNS, "dtype": code, "r0_m": 1.0,
        "dr_m": 0.002, "d_azimuth_rad": 0.01, "d_elevation_rad": 0.01, **changes,
    }  # fmt: skip
    (folder / "scan.json").write_text(json.dumps(fields))
    return folder / "scan.json"


def test_counts_without_intensity_are_a_shape(tmp_path: Path) -> None:
    counts = room_counts(0)
    scan = read_scan(written(tmp_path, counts, code=">u2"))
    np.testing.assert_array_equal(scan.valid, counts > 0)
    assert not scan.has_intensity
    assert scan.notes == (NO_INTENSITY_NOTE,)
    scalars = {"r0_m": 1.0, "dr_m": 0.002, "d_azimuth_rad": 0.01, "d_elevation_rad": 0.01}
    np.savez(tmp_path / "alone.npz", counts=counts.astype(np.uint16), **scalars)
    alone = read_scan(tmp_path / "alone.npz")
    np.testing.assert_allclose(alone.ranges, scan.ranges)
    assert alone.notes == (NO_INTENSITY_NOTE,)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("right", "wrong"), [(">u2", "<u2"), ("<u2", ">u2"), (">u4", "<u4"), ("<u4", ">u4")])
def test_the_wrong_byte_order_is_noticed(tmp_path: Path, seed: int, right: str, wrong: str) -> None:
    counts = room_counts(seed)
    assert read_scan(written(tmp_path, counts, code=right)).valid.sum() == (counts > 0).sum()
    with pytest.raises(FormatError, match=f"'dtype' should be '{right}', not '{wrong}'"):
        read_scan(written(tmp_path, counts, code=right, dtype=wrong))


def test_the_wrong_byte_order_of_packed_words_is_noticed(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    words = room_counts(1) | rng.integers(0, 4096, (ROWS, COLUMNS)).astype(np.uint32) << 12
    packed = {"count_mask": 4095, "intensity_mask": 4095, "intensity_shift": 12}
    assert read_scan(written(tmp_path, words, code=">u4", **packed)).has_intensity
    with pytest.raises(FormatError, match="should be '>u4'"):
        read_scan(written(tmp_path, words, code=">u4", dtype="<u4", **packed))


def test_fine_counts_and_pure_noise_are_read_as_they_are(tmp_path: Path) -> None:
    """Counts of a tenth of a millimetre fill 16 bits; noise looks alike in both orders."""
    fine = (room_counts(2) * 20).astype(np.uint32)
    assert read_scan(written(tmp_path, fine, code="<u2")).valid.any()
    noise = np.random.default_rng(3).integers(1, 1 << 16, (ROWS, COLUMNS))
    assert read_scan(written(tmp_path, noise, code="<u2")).valid.all()


@pytest.mark.slow
def test_a_perceptron_file_is_simulated_and_read(tmp_path: Path) -> None:
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    from ladarreg.cli import main

    assert main(["simulate", "boxes", "--perceptron", "-o", str(tmp_path / "case")]) == 0
    raw = (tmp_path / "case" / "scan.raw").read_bytes()
    fields = json.loads((tmp_path / "case" / "scan.json").read_text())
    header = raw[: fields["header_bytes"]]
    assert header.count(b"\n") == 11, "ten lines and two bytes more"
    assert header.startswith(b"rows : 512\ncolumns : 512\n")
    scan = read_scan(tmp_path / "case" / "scan.json")
    assert scan.geometry == AzimuthElevation(512, 512, np.radians(51.65 / 512), np.radians(36.73 / 512))
    word = int.from_bytes(raw[len(header) + 4 * (100 * 512 + 200) :][:4], "big")
    assert scan.ranges[100, 200] == pytest.approx((830.3 + (word & 4095)) * 0.0020236, abs=1e-4)
    assert scan.intensity[100, 200] == word >> 12 & 4095
    assert main(["simulate", "boxes", "--perceptron", "--set", "fisheye", "-o", str(tmp_path / "wide")]) == 2
