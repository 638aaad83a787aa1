"""PTX scans, written with plain text: the grid, the registration, cells without return, several scans in a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.formats import describe, listed_kind, read_scan, recognise
from ladarreg_core.formats.scans.ptx import ptx_blocks, read_ptx
from ladarreg_core.scan import Scan
from testing.files.small_scans import make_scan

STATION = np.array([[0.0, -1.0, 0.0, 500_000.25], [1.0, 0.0, 0.0, 5_400_000.5], [0.0, 0.0, 1.0, 12.75], [0, 0, 0, 1]])
"""The scanner's pose in the world: turned by 90 degrees to the left."""


def block(
    scan: Scan, pose: np.ndarray = STATION, *, color: bool = True, empty: str = "0 0 0 0.500000", points: str = "own",
    end: str = "\n", lines: np.ndarray | None = None,
) -> str:  # fmt: skip
    """One block as scanners' programs write it: bottom row first, column by column from the right."""
    xyz = scan.points[::-1, ::-1].astype(np.float64)
    light = scan.intensity[::-1, ::-1] / scan.intensity.max()
    if points == "world":
        xyz = xyz @ pose[:3, :3].T + pose[:3, 3]
        matrix = np.eye(4)
    else:
        matrix = pose.T
    rows, columns = scan.shape
    text = [str(columns), str(rows)]
    for line in [pose[:3, 3], *pose[:3, :3].T] if lines is None else lines:  # the position, then each axis
        text.append(" ".join(f"{value:.6f}" for value in line))
    text += [" ".join(f"{value:.6f}" for value in row) for row in matrix]
    for column in range(columns):
        for row in range(rows):
            p, i = xyz[row, column], light[row, column]
            seen = np.isfinite(p).all()
            rgb = f" {10 + row} {20 + column} 30" if color and seen else ""
            text.append(f"{p[0]:.6f} {p[1]:.6f} {p[2]:.6f} {i:.6f}{rgb}" if seen else empty)
    return end.join(text) + end


def seed_files(folder: Path) -> list[Path]:
    """Write valid files; `tests/abuse` reads damaged copies of them."""
    wall = make_scan(10, 14)
    files = {"one.ptx": block(wall), "two.ptx": block(wall, color=False) + block(make_scan(8, 9), np.eye(4))}
    for name, text in files.items():
        (folder / name).write_text(text)
    return [folder / name for name in files]


def write(path: Path, text: str) -> Path:
    path.write_bytes(text.encode())
    return path


def same_scan(scan: Scan, wall: Scan) -> None:
    assert scan.shape == wall.shape
    np.testing.assert_array_equal(scan.valid, wall.valid)
    np.testing.assert_allclose(scan.points[wall.valid], wall.points[wall.valid], atol=3e-6)
    expected = wall.intensity / wall.intensity.max()
    np.testing.assert_allclose(scan.intensity[wall.valid], expected[wall.valid], atol=1e-6)


def test_a_scan_is_put_upright_and_keeps_its_pose(tmp_path: Path, wall: Scan) -> None:
    path = write(tmp_path / "a.ptx", block(wall))
    assert recognise(path).name == "PTX"
    assert listed_kind(path) == "scan"
    scan = read_scan(path)
    same_scan(scan, wall)
    assert scan.world_from_scanner is not None
    np.testing.assert_allclose(scan.world_from_scanner.matrix, STATION, atol=1e-9)
    # By hand: what lies 2 m ahead of the scanner lies 2 m to the north, since it is turned to the left.
    np.testing.assert_allclose(scan.world_from_scanner @ np.array([2.0, 0, 0]), [500_000.25, 5_400_002.5, 12.75])
    assert np.abs(scan.world_from_scanner.matrix - STATION.T).max() > 1  # the printed matrix is the transpose
    row, column = np.argwhere(scan.valid)[5]
    assert scan.color is not None
    assert scan.color[row, column].tolist() == [10 + wall.shape[0] - 1 - row, 20 + wall.shape[1] - 1 - column, 30]


@pytest.mark.parametrize("empty", ["0 0 0 0.500000", "0.0 0.0 0.0 0.0", "0 0 0 0.500000 0 0 0", "0 0 0 1 255 255 255"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "  \r\n"])
def test_any_writing_of_no_return_and_of_line_ends(tmp_path: Path, wall: Scan, empty: str, end: str) -> None:
    same_scan(read_ptx(write(tmp_path / "a.ptx", block(wall, empty=empty, end=end).replace(" ", "  "))), wall)


def test_any_order_of_rows_and_columns(tmp_path: Path, wall: Scan) -> None:
    upside_down = Scan(wall.geometry, wall.ranges, wall.intensity)
    text = block(upside_down, color=False).splitlines()
    points = np.array(text[10:]).reshape(wall.shape[1], wall.shape[0])
    for flipped in (points[::-1], points[:, ::-1], points[::-1, ::-1]):
        same_scan(read_ptx(write(tmp_path / "a.ptx", "\n".join([*text[:10], *flipped.ravel()]))), wall)
    swapped = [text[1], text[0], *text[2:10], *points.T.ravel()]  # row by row
    same_scan(read_ptx(write(tmp_path / "a.ptx", "\n".join(swapped))), wall)


def test_several_scans_are_listed_from_their_headers_and_chosen_by_number(tmp_path: Path, wall: Scan) -> None:
    other = make_scan(9, 17, seed=5)
    path = write(tmp_path / "a.ptx", block(wall) + "\n" + block(other, np.eye(4), color=False))
    first, second = describe(path).scans
    assert (
        "scan 0 (`scan_index=0`): 864 points, grid 24 x 36, intensity and colour, stands at 500000.250, 5400000.5"
        in first
    )
    assert "scan 1 (`scan_index=1`): 153 points, grid 9 x 17, intensity, stands at 0.000, 0.000, 0.000 m" in second
    same_scan(read_scan(path, scan_index=0), wall)
    scan = read_scan(path, scan_index=1)
    same_scan(scan, other)
    assert any("2 scans; this is scan 1" in note for note in scan.notes)
    assert describe(path, scan_index=1).size == "9 rows x 17 columns"
    with pytest.raises(OptionError, match="no scan 2; the file contains 2 scans, 0 to 1"):
        read_scan(path, scan_index=2)


def test_points_in_world_coordinates_are_taken_back_to_the_scanner(tmp_path: Path, wall: Scan) -> None:
    scan = read_ptx(write(tmp_path / "a.ptx", block(wall, points="world")))
    same_scan(scan, wall)
    assert scan.world_from_scanner is not None
    np.testing.assert_allclose(scan.world_from_scanner.matrix, STATION, atol=1e-9)
    assert any("world coordinates; the scanner stood at 500000.250" in note for note in scan.notes)


def test_registration_lines_left_at_zero_do_not_matter(tmp_path: Path, wall: Scan) -> None:
    scan = read_ptx(write(tmp_path / "a.ptx", block(wall, lines=np.array([[0, 0, 0], *np.eye(3)]))))
    same_scan(scan, wall)
    assert scan.world_from_scanner is not None
    np.testing.assert_allclose(scan.world_from_scanner.matrix, STATION, atol=1e-9)


def test_colors_alone_are_refused_or_taken_by_their_luminance(tmp_path: Path, wall: Scan) -> None:
    head, rows = block(wall).splitlines()[:10], block(wall).splitlines()[10:]
    cells = [row.split() for row in rows]
    rgb = [" ".join(c[:3] + (c[4:] or ["0", "0", "0"])) for c in cells]
    path = write(tmp_path / "a.ptx", "\n".join([*head, *rgb]))
    with pytest.raises(FormatError, match=r"colours but no intensity.*`intensity='luma'`"):
        read_scan(path)
    scan = read_scan(path, intensity="luma")
    row, column = np.argwhere(scan.valid)[7]
    assert scan.color is not None
    red, green, blue = scan.color[row, column].astype(float)
    assert scan.intensity[row, column] == pytest.approx(0.2126 * red + 0.7152 * green + 0.0722 * blue, abs=1e-3)
    assert any("luminance of the colours (Rec. 709)" in note for note in scan.notes)


def test_damage_is_said_in_a_sentence(tmp_path: Path, wall: Scan) -> None:
    lines = block(wall).splitlines()
    broken = {
        "truncated": lines[:400],
        "only .* bytes follow": ["36000", *lines[1:]],
        "not a row of numbers": [*lines[:50], "1 2 three 4 5 6 7", *lines[51:]],
        "numbers instead of 7": [*lines[:50], "1 2 3 4 5", *lines[51:]],
        "must be 4 numbers": [*lines, *lines[:9], "1 2"],
        "ends after 3 of 10 lines": [*lines, *lines[:3]],
        "100,000,000": ["99999", "99999", *lines[2:]],
        "no returns": [*lines[:10], *["0 0 0 0.5"] * 864],
    }
    for words, text in broken.items():
        with pytest.raises(LadarregError, match=words):
            read_scan(write(tmp_path / "a.ptx", "\n".join(text)))
    with pytest.raises(FormatError, match=r"PTG scan .export PTX or E57"):
        read_scan(write(tmp_path / "a.ptg", "PTG\0" + "\x01" * 60))


def test_the_blocks_are_found_without_their_points(tmp_path: Path, wall: Scan) -> None:
    path = write(tmp_path / "a.ptx", (block(wall) + block(wall, color=False)).rstrip("\n"))
    first, second = ptx_blocks(path)
    assert (first.width, second.width, second.lines) == (7, 4, wall.ranges.size)
    same_scan(read_ptx(path, scan_index=1), wall)
