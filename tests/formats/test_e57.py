"""E57 scans and images."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.errors import Cancelled, ExportError, FormatError, LadarregError, OptionError, ShapeError
from ladarreg_core.formats import describe, read_scan
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.formats.e57.reader import read_e57
from ladarreg_core.formats.e57_images import extract_images
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import NO_INTENSITY_NOTE, Scan
from testing.files.small_scans import picture_e57

pytest.importorskip("pye57")
PAGE = 1024


def castagnoli(data: bytes) -> int:
    """CRC-32C, the checksum of E57 pages."""
    value = 0xFFFFFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)
    return value ^ 0xFFFFFFFF


def forged(path: Path, old: bytes, new: bytes) -> Path:
    """The file with a text replaced by one of equal length, its checksums recomputed."""
    assert len(old) == len(new)
    data = path.read_bytes()
    pages = [data[k : k + PAGE - 4] for k in range(0, len(data), PAGE)]
    plain = b"".join(pages)
    assert plain.count(old) >= 1
    changed = plain.replace(old, new, 1)
    out = bytearray()
    for k, page in enumerate(pages):
        part = changed[k * (PAGE - 4) : (k + 1) * (PAGE - 4)]
        same = part == page
        out += part + (data[(k + 1) * PAGE - 4 : (k + 1) * PAGE] if same else castagnoli(part).to_bytes(4, "big"))
    path.write_bytes(out)
    return path


def test_a_grid_stored_from_the_bottom_is_read_upright(tmp_path: Path, make: Any, wall: Scan) -> None:
    path = make.e57(tmp_path / "a.e57", make.e57_fields(wall, color=True))
    scan = read_e57(path)
    np.testing.assert_allclose(scan.points, wall.points, atol=1e-5)
    np.testing.assert_array_equal(scan.intensity[scan.valid], wall.intensity[wall.valid])
    row, column = np.mgrid[: wall.shape[0], : wall.shape[1]]
    assert scan.color is not None
    np.testing.assert_array_equal(scan.color[scan.valid][:, 1], ((row * 3 + column * 5 + 40) % 256)[wall.valid])
    assert np.abs(scan.rays - wall.rays).max() < 0.25 * 0.01


@pytest.mark.parametrize("mirrored", [False, True])
def test_columns_from_the_right_are_reversed(tmp_path: Path, make: Any, wall: Scan, mirrored: bool) -> None:
    fields = make.e57_fields(wall)
    if mirrored:
        fields["columnIndex"] = (wall.shape[1] - 1 - fields["columnIndex"]).astype("u2")
    fields["columnIndex"], fields["rowIndex"] = fields["rowIndex"], fields["columnIndex"]
    scan = read_e57(make.e57(tmp_path / "a.e57", fields))
    np.testing.assert_allclose(scan.points, wall.points, atol=1e-5)


def test_invalid_states_give_no_return_and_directions_give_rays(tmp_path: Path, make: Any, wall: Scan) -> None:
    fields = make.e57_fields(wall)
    state = (np.arange(len(fields["intensity"])) % 7 == 0).astype("i1") * 2
    scan = read_e57(make.e57(tmp_path / "a.e57", fields | {"cartesianInvalidState": state}))
    expected = np.array(wall.valid)
    expected[wall.valid] = state == 0
    np.testing.assert_array_equal(scan.valid, expected)
    directed = read_e57(make.e57(tmp_path / "b.e57", fields | {"cartesianInvalidState": state // 2}))
    np.testing.assert_array_equal(directed.valid, expected)
    np.testing.assert_allclose(directed.rays[wall.valid], wall.rays[wall.valid], atol=1e-5)


def test_pose_and_several_scans(tmp_path: Path, make: Any, wall: Scan) -> None:
    other = make.scan(20, 30, seed=9)
    half = np.sqrt(0.5)
    path = make.e57(
        tmp_path / "a.e57", [make.e57_fields(wall), make.e57_fields(other)],
        rotation=[half, 0, 0, half], translation=[100.0, -20.0, 3.0],
    )  # fmt: skip
    first, second = read_scan(path), read_scan(path, scan_index=1)
    assert (first.shape, second.shape) == (wall.shape, other.shape)
    assert first.world_from_scanner is not None
    expected = Rigid.from_rotvec([0, 0, np.pi / 2], (100.0, -20.0, 3.0))
    np.testing.assert_allclose(first.world_from_scanner.matrix, expected.matrix, atol=1e-12)
    np.testing.assert_allclose(second.points, other.points, atol=1e-5)
    for index in (2, -1):
        with pytest.raises(OptionError, match="contains 2"):
            read_scan(path, scan_index=index)


def test_files_without_indices_are_gridded(tmp_path: Path, make: Any) -> None:
    points, intensity, _ = make.spinning(np.arange(-10, 10, 1.0), 300)
    fields = {f"cartesian{axis}": points[:, k] for k, axis in enumerate("XYZ")} | {"intensity": intensity.astype("f4")}
    scan = read_e57(make.e57(tmp_path / "a.e57", fields))
    assert scan.shape == (20, 300)
    assert scan.valid.sum() == len(points)
    useless = fields | {name: np.zeros(len(points), "u2") for name in ("rowIndex", "columnIndex")}
    np.testing.assert_array_equal(read_e57(make.e57(tmp_path / "b.e57", useless)).ranges, scan.ranges)


def test_the_nearest_of_several_returns_counts_across_chunks(
    tmp_path: Path, make: Any, wall: Scan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ladarreg_core.formats.e57.reader._CHUNK", 100)
    fields = make.e57_fields(wall, color=True)
    far = {k: (v * 3 if k.startswith("cartesian") else v)[::2] for k, v in fields.items()}
    far["intensity"] = 0 * far["intensity"] + 9
    both = {k: np.concatenate([fields[k], far[k]]) for k in fields}
    order = np.random.default_rng(1).permutation(len(both["intensity"]))
    both = {k: v[order] for k, v in both.items()}
    plain, mixed = (read_e57(make.e57(tmp_path / f"{k}.e57", f)) for k, f in enumerate((fields, both)))
    np.testing.assert_array_equal(mixed.ranges, plain.ranges)
    np.testing.assert_array_equal(mixed.intensity[wall.valid], plain.intensity[wall.valid])
    np.testing.assert_array_equal(mixed.color[wall.valid], plain.color[wall.valid])  # type: ignore[index]
    np.testing.assert_allclose(mixed.points, wall.points, atol=1e-5)
    nearest_missing = read_e57(make.e57(tmp_path / "far.e57", far))
    assert not np.allclose(nearest_missing.ranges, plain.ranges, equal_nan=True)


@pytest.mark.parametrize("claimed", [b"3", b"1", b"7"])
def test_index_bounds_of_the_header_need_not_be_right(tmp_path: Path, make: Any, wall: Scan, claimed: bytes) -> None:
    path = make.e57(tmp_path / "a.e57", make.e57_fields(wall))
    rows = str(wall.shape[0] - 1).encode()
    old = b'<rowMaximum type="Integer">' + rows + b"<"
    assert len(rows) == 2
    read = read_e57(forged(path, old, old.replace(rows + b"<", claimed + b"0<")))
    np.testing.assert_allclose(read.points, wall.points, atol=1e-5)


def test_large_tables_are_filled_as_small_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    from ladarreg_core.scanner import ray_table
    from ladarreg_core.scanner.grids import SphericalGrid, TabulatedGrid

    true = SphericalGrid(120, 300, 0.01, 0.01, 0.3, 0.9).rays
    table = true.astype(np.float32)
    holes = np.random.default_rng(0).random(table.shape[:2]) < 0.2
    holes[:, 250:] = holes[100:] = True
    table[holes] = 0
    grids = []
    for most in (10**6, 4000):
        monkeypatch.setattr(ray_table, "MAX_FITTED_CELLS", most)
        grids.append(TabulatedGrid.taking_over(table.copy()))
    np.testing.assert_array_equal(grids[0].rays[~holes], table[~holes])
    for grid in grids:
        assert np.abs(grid.rays - true).max() < 1e-3
    assert np.abs(TabulatedGrid(np.where(holes[..., None], np.nan, table)).rays - grids[0].rays).max() < 1e-6


def test_missing_intensity_or_returns_are_reported(tmp_path: Path, make: Any, wall: Scan) -> None:
    fields = make.e57_fields(wall, color=True)
    del fields["intensity"]
    with pytest.raises(FormatError, match=r"colours but no intensity.*`intensity='luma'`"):
        read_e57(make.e57(tmp_path / "a.e57", fields))
    blind = make.e57_fields(wall)
    blind["cartesianInvalidState"] = np.full(len(blind["intensity"]), 2, "i1")
    blind["cartesianInvalidState"][0] = 0
    for axis in "XYZ":
        blind[f"cartesian{axis}"][0] = 0
    with pytest.raises(ShapeError, match="no returns"):
        read_e57(make.e57(tmp_path / "b.e57", blind))


def test_reading_reports_and_can_be_cancelled(tmp_path: Path, make: Any, wall: Scan) -> None:
    path = make.e57(tmp_path / "a.e57", make.e57_fields(wall))
    steps: list[Progress] = []
    read_e57(path, report=steps.append)
    assert steps[-1].done == steps[-1].total == wall.valid.sum()

    def stop(progress: Progress) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        read_e57(path, report=stop)
    assert read_e57(path).shape == wall.shape


def test_a_flipped_bit_anywhere_is_noticed(tmp_path: Path, make: Any, wall: Scan) -> None:
    path = make.e57(tmp_path / "a.e57", make.e57_fields(wall))
    data = path.read_bytes()
    generator = np.random.default_rng(0)
    for at in generator.integers(0, len(data), 40):
        broken = bytearray(data)
        broken[at] ^= 1 << int(generator.integers(0, 8))
        path.write_bytes(broken)
        with pytest.raises(FormatError) as caught:
            read_e57(path)
        assert "\n" not in str(caught.value)


def test_claims_with_valid_checksums_are_refused(tmp_path: Path, make: Any, wall: Scan) -> None:
    count = b'recordCount="%d"' % wall.valid.sum()
    for old, new, word in (
        (count, b'recordCount="%s"' % (b"9" * (len(count) - 14)), None),
        (b'<?xml version="1.0" encoding="UTF-8"?>', b"<!DOCTYPE e57Root>".ljust(38), "document type"),
        (b"</points>", b"</pointz>", "XML is damaged"),
    ):
        path = make.e57(tmp_path / "a.e57", make.e57_fields(wall))
        with pytest.raises(FormatError, match=word):
            read_e57(forged(path, old, new))
    path = make.e57(tmp_path / "b.e57", make.e57_fields(wall))
    data = path.read_bytes()
    plain = b"".join(data[k : k + PAGE - 4] for k in range(0, len(data), PAGE))
    text = plain[plain.index(b"<temperature") : plain.index(count) + len(count)]
    # The longer number takes its space from an element that is not read.
    claim = text.replace(b'<temperature type="Float"/>', b"", 1).replace(count, b'recordCount="200000000"')
    padded = claim.replace(b"<relativeHumidity", b" " * (len(text) - len(claim)) + b"<relativeHumidity", 1)
    with pytest.raises(FormatError, match="claims 200,000,000 points"):
        read_e57(forged(path, text, padded))


def test_images_are_listed_and_extracted_with_camera_and_pose(tmp_path: Path, make: Any, wall: Scan) -> None:
    path, world_from_image = picture_e57(tmp_path / "a.e57", wall)
    assert describe(path).images == ("../front door: pinhole JPEG 64 x 48, focal length 70.7 px, with a pose",)
    (written,) = extract_images(path, tmp_path / "out")
    assert written.picture.parent == tmp_path / "out"
    assert written.picture.read_bytes()[:2] == b"\xff\xd8"
    assert written.camera is not None
    assert written.pose is not None
    camera, pose = read_camera(written.camera), read_pose(written.pose)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((100, 50, 29.5, 24.5))
    point_world = world_from_image @ np.array([0.2, 0.1, -2.0])  # right, above and in front of an E57 camera
    point_scanner = point_world - [5.0, 6.0, 7.0]
    np.testing.assert_allclose(camera.project(pose @ point_scanner), [29.5 + 10, 24.5 - 2.5], atol=1e-6)
    with pytest.raises(ExportError, match="exists already"):
        extract_images(path, tmp_path / "out")


def test_a_file_with_images_only_is_not_a_scan(real_data: Path, tmp_path: Path) -> None:
    path = real_data / "e57_fixtures" / "PinholeImageWithDistortionParameters.e57"
    with pytest.raises(FormatError, match="no scan"):
        read_scan(path)
    written = extract_images(path, tmp_path)
    assert len(written) == 3
    assert written[0].camera is not None
    assert json.loads(written[0].camera.read_text())["distortion"][2:4] == pytest.approx([11.11, 12.12], abs=1e-4)


def test_foreign_fixtures_are_read_or_refused_with_a_reason(real_data: Path) -> None:
    for path in sorted((real_data / "e57_fixtures").glob("*.e57")):
        describe(path)
        with suppress(LadarregError):
            scan = read_scan(path)
            assert scan.has_intensity or NO_INTENSITY_NOTE in scan.notes
            continue
        with pytest.raises(LadarregError, match=r"no scan|needs at least 12|where the scanner stood"):
            read_scan(path)
