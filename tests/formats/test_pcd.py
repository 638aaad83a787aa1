"""PCD clouds: three encodings, one scan; headers are checked before they are used."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.errors import FormatError, LadarregError, ShapeError, UnderspecifiedError
from ladarreg_core.formats.scans.pcd import lzf_decompress, read_pcd
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grid_order import is_scan_grid, order_of, unit_rays
from testing.files.small_scans import make_scan, pcd_bytes

ENCODINGS = ("ascii", "binary", "binary_compressed")


def seed_files(folder: Path) -> list[Path]:
    """Write a valid file of each encoding; `tests/abuse` reads damaged copies of them."""
    wall = make_scan()
    width, height = wall.shape[1], wall.shape[0]
    return [
        write(folder / f"{encoding}.pcd", pcd_bytes(*cloud_of(wall), encoding=encoding, width=width, height=height))
        for encoding in ENCODINGS
    ]


def cloud_of(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    return scan.points.reshape(-1, 3), scan.intensity.ravel()


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.mark.slow
@given(st.binary(max_size=3000) | st.lists(st.sampled_from([b"ab", b"\0" * 40, b"xyz"]), max_size=200).map(b"".join))
def test_lzf_gives_back_what_was_compressed(make: Any, data: bytes) -> None:
    assert lzf_decompress(make.lzf(data), len(data)) == data


@given(st.binary(min_size=1, max_size=400), st.integers(0, 2000))
def test_random_lzf_is_an_error_or_has_the_requested_size(data: bytes, size: int) -> None:
    with contextlib.suppress(FormatError):
        assert len(lzf_decompress(data, size)) == size


def test_three_encodings_give_the_same_organised_scan(tmp_path: Path, make: Any, wall: Scan) -> None:
    points, intensity = cloud_of(wall)
    for encoding in ENCODINGS:
        data = make.pcd(points, intensity, encoding=encoding, width=wall.shape[1], height=wall.shape[0])
        scan = read_pcd(write(tmp_path / f"{encoding}.pcd", data))
        np.testing.assert_allclose(scan.points, wall.points, atol=2e-6)
        np.testing.assert_array_equal(scan.intensity, wall.intensity)
        assert scan.notes == ()


@pytest.mark.parametrize("flip_rows", [False, True])
@pytest.mark.parametrize("flip_columns", [False, True])
@pytest.mark.parametrize("transpose", [False, True])
def test_organised_clouds_are_put_upright(
    tmp_path: Path, make: Any, wall: Scan, flip_rows: bool, flip_columns: bool, transpose: bool
) -> None:
    def changed(grid: np.ndarray) -> np.ndarray:
        grid = grid[:: -1 if flip_rows else 1, :: -1 if flip_columns else 1]
        return np.ascontiguousarray(grid.swapaxes(0, 1) if transpose else grid)

    points, intensity = changed(np.asarray(wall.points)), changed(np.asarray(wall.intensity))
    height, width = intensity.shape
    data = make.pcd(points.reshape(-1, 3), intensity.ravel(), width=width, height=height)
    scan = read_pcd(write(tmp_path / "a.pcd", data))
    np.testing.assert_allclose(scan.points, wall.points, atol=1e-6)
    assert bool(scan.notes) == (flip_rows or flip_columns or transpose)


@given(seed=st.integers(0, 1000), holes=st.floats(0, 0.6))
def test_any_order_of_a_grid_is_undone(make: Any, seed: int, holes: float) -> None:
    scan = make.scan(12, 17, seed=seed)
    rays = np.array(scan.rays)
    rays[np.random.default_rng(seed).random(scan.shape) < holes] = np.nan
    shuffled = rays[::-1, ::-1] if seed % 2 else rays[:, ::-1]
    shuffled = shuffled.swapaxes(0, 1) if seed % 3 == 0 else shuffled
    np.testing.assert_array_equal(order_of(shuffled).apply(shuffled), rays)


def test_a_depth_cameras_optical_frame_keeps_its_grid(tmp_path: Path, make: Any, wall: Scan) -> None:
    optical = wall.points.reshape(-1, 3) @ CAMERA_AXES_FROM_SCANNER.T.astype(np.float32)
    data = make.pcd(optical, wall.intensity.ravel(), width=wall.shape[1], height=wall.shape[0])
    scan = read_pcd(write(tmp_path / "a.pcd", data))
    np.testing.assert_allclose(scan.points.reshape(-1, 3), optical, atol=1e-6)


def test_a_header_with_a_wrong_order_is_detected(tmp_path: Path, make: Any, wall: Scan) -> None:
    stored_by_column = wall.points.swapaxes(0, 1).reshape(-1, 3)
    intensity = wall.intensity.swapaxes(0, 1).ravel()
    data = make.pcd(stored_by_column, intensity, width=wall.shape[1], height=wall.shape[0])
    scan = read_pcd(write(tmp_path / "a.pcd", data))
    assert not is_scan_grid(unit_rays(stored_by_column.reshape(*wall.shape, 3)))
    assert "not in this order" in scan.notes[0]
    kept = scan.points[scan.valid]
    assert len(kept) > 0.8 * wall.valid.sum()
    distance = np.linalg.norm(kept[:, None] - wall.points[wall.valid][None], axis=-1)
    assert distance.min(axis=1).max() < 1e-6


def test_fields_are_found_by_name(tmp_path: Path, make: Any) -> None:
    points, intensity, ring = make.spinning(np.arange(-8, 8, 1.5), 200)
    packed = (np.arange(len(points)) * 7919 % 2**24).astype("<u4")
    extra = {"Ring": ring.astype("<u2"), "rgb": packed.view("<f4"), "timestamp": np.zeros(len(points), "<f8")}
    for encoding in ("binary", "binary_compressed"):
        scan = read_pcd(write(tmp_path / "a.pcd", make.pcd(points, intensity, encoding=encoding, extra=extra)))
        assert scan.shape[0] == 11
        assert scan.color is not None
        first = np.argmin(np.linalg.norm(scan.points.reshape(-1, 3)[:, None] - points[None, :1], axis=-1).ravel())
        rgb = [(int(packed[0]) >> shift) & 255 for shift in (16, 8, 0)]
        assert scan.color.reshape(-1, 3)[first].tolist() == rgb


def test_viewpoint_is_the_pose_and_millimetres_are_suspected(tmp_path: Path, make: Any, wall: Scan) -> None:
    points, intensity = cloud_of(wall)
    half = np.sqrt(0.5)
    data = make.pcd(points * 1000, intensity, viewpoint=f"1 2 3 {half} 0 0 {half}")
    with pytest.raises(UnderspecifiedError, match="millimetres"):  # zero is kilometres away
        read_pcd(write(tmp_path / "a.pcd", data))
    scan = read_pcd(write(tmp_path / "a.pcd", data), origin=(0, 0, 0))
    assert scan.world_from_scanner is not None
    expected = Rigid.from_rotvec([0, 0, np.pi / 2], (1, 2, 3)).matrix
    np.testing.assert_allclose(scan.world_from_scanner.matrix, expected, atol=1e-12)
    assert any("millimetres" in note for note in scan.notes)


def bad_headers(make: Any, wall: Scan) -> dict[str, bytes]:
    points, intensity = cloud_of(wall)
    good = make.pcd(points, intensity)
    size = len(points)
    huge = good.replace(b"WIDTH %d" % size, b"WIDTH 200000000").replace(b"POINTS %d" % size, b"POINTS 200000000")
    many = good.replace(b"WIDTH %d" % size, b"WIDTH 50000000").replace(b"POINTS %d" % size, b"POINTS 50000000")
    compressed = make.pcd(points, intensity, encoding="binary_compressed")
    at = compressed.index(b"DATA binary_compressed\n") + len(b"DATA binary_compressed\n")
    huge_body = many.split(b"DATA ")[0] + b"DATA binary_compressed\n"
    huge_body += np.array([60, 50_000_000 * 19], "<u4").tobytes() + bytes(60)
    swollen = huge_body.replace(b" 50000000\n", b" 50000\n").replace(
        np.array([50_000_000 * 19], "<u4").tobytes(), np.array([50_000 * 19], "<u4").tobytes()
    )
    return {
        "at most 100,000,000": huge,
        "50,000,000 points of 19 bytes": many,
        "50,000,000 points of 7 numbers": many.replace(b"DATA binary", b"DATA ascii"),
        "would need 18.9 GB of memory": huge_body,
        "which is impossible": swollen,
        "compressed bytes": compressed[:at] + b"\xff\xff\xff\x7f" + compressed[at + 4 :],
        "but the header claims": compressed[: at + 4] + b"\xff\xff\xff\x7f" + compressed[at + 8 :],
        "x, y, z": good.replace(b"FIELDS x y z", b"FIELDS q y z"),
        "POINTS": good.replace(b"POINTS %d" % size, b"POINTS 7"),
        "WIDTH is '-4'": good.replace(b"WIDTH %d" % size, b"WIDTH -4"),
        "must be positive": good.replace(b"WIDTH %d" % size, b"WIDTH 0").replace(b"POINTS %d" % size, b"POINTS 0"),
        "no such type": good.replace(b"SIZE 4 4", b"SIZE 3 4"),
        "must agree": good.replace(b"TYPE F F", b"TYPE F"),
        "'gzip'": good.replace(b"DATA binary", b"DATA gzip"),
        "ends before its DATA": good.split(b"DATA")[0],
        "has the line": good.replace(b"VERSION", b"VOLUMES"),
        "12": make.pcd(points[:5], intensity[:5]),
        "0 returns": make.pcd(points * 0, intensity),
        "COUNT": good.replace(b"COUNT 1 1 1 3", b"COUNT 1 1 1 0"),
    }


@pytest.mark.parametrize(("encoding", "padding_bytes"), [("binary", 0), ("binary", 1), ("ascii", 0)])
def test_padding_of_count_zero_is_nothing_or_one(
    tmp_path: Path, make: Any, wall: Scan, encoding: str, padding_bytes: int
) -> None:
    points, intensity = cloud_of(wall)
    size = len(points)
    head = (
        "VERSION .7\nFIELDS x y z _ intensity\nSIZE 4 4 4 1 4\nTYPE F F F U F\n"
        f"COUNT 1 1 1 0 1\nWIDTH {size}\nHEIGHT 1\nPOINTS {size}\nDATA {encoding}\n"
    ).encode()
    if encoding == "ascii":
        body = "\n".join(f"{x} {y} {z} {i}" for (x, y, z), i in zip(points, intensity, strict=True)).encode() + b"\n"
    else:
        record = np.zeros(size, [("p", "<f4", (3,)), ("pad", f"V{padding_bytes}"), ("i", "<f4")])
        record["p"], record["i"] = points, intensity
        body = record.tobytes()
    scan = read_pcd(write(tmp_path / "a.pcd", head + body))
    expected = read_pcd(write(tmp_path / "b.pcd", make.pcd(points, intensity)))
    np.testing.assert_allclose(np.sort(scan.ranges[scan.valid]), np.sort(expected.ranges[expected.valid]), atol=1e-6)


def test_every_bad_header_is_one_clear_error(tmp_path: Path, make: Any, wall: Scan) -> None:
    for word, data in bad_headers(make, wall).items():
        with pytest.raises(LadarregError) as caught:
            read_pcd(write(tmp_path / "a.pcd", data))
        assert isinstance(caught.value, FormatError | ShapeError)
        assert word in str(caught.value), str(caught.value)


def test_ascii_rows_that_are_short_or_words_are_errors(tmp_path: Path, make: Any, wall: Scan) -> None:
    text = make.pcd(*cloud_of(wall), encoding="ascii")
    rows = text.splitlines(keepends=True)
    for broken in (b"".join(rows[:-2]), text.replace(rows[-1], b"1 2 3\n"), text.replace(rows[-1], b"a b c d e f g\n")):
        with pytest.raises(FormatError):
            read_pcd(write(tmp_path / "a.pcd", broken))
