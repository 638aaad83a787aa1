"""Clouds in text files: PTS, and columns named by a header line or by the caller."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.formats import describe, listed_kind, read_scan, recognise
from ladarreg_core.scan import Scan
from testing.files.small_scans import make_scan
from tests.formats.test_ply import ORIGIN, cloud, same_points

HERE = (0.0, 0.0, 0.0)
NAMES = ("x", "y", "z", "intensity", "red", "green", "blue")


def rows(scan: Scan, separator: str = " ", *, offset: tuple[float, float, float] = (0, 0, 0), end: str = "\n") -> str:
    """x y z intensity r g b, a row each."""
    columns = cloud(scan)
    table = np.stack([columns[name].astype("f8") for name in NAMES], axis=1)
    table[:, :3] += offset
    text = io.StringIO()
    np.savetxt(text, table, fmt=["%.6f"] * 3 + ["%.3f"] + ["%d"] * 3, delimiter=separator, newline=end)
    return text.getvalue()


def seed_files(folder: Path) -> list[Path]:
    """Write valid files; `tests/abuse` reads damaged copies of them."""
    wall = make_scan(9, 12)
    count = int(wall.valid.sum())
    files = {
        "a.pts": f"{count}\n{rows(wall)}",
        "a.csv": "x,y,z,intensity,r,g,b\n" + rows(wall, ","),
        "a.txt": f"//X Y Z Scalar_Intensity R G B\n{count}\n" + rows(wall),
        "b.xyz": "# exported\nX;Y;Z;reflectance\n"
        + "\n".join(";".join(r.split()[:4]) for r in rows(wall).splitlines()),
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    return [folder / name for name in files]


def write(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_pts(tmp_path: Path, wall: Scan) -> None:
    count = int(wall.valid.sum())
    for end in ("\n", "\r\n"):
        path = write(tmp_path / "a.pts", f"{count}{end}" + rows(wall, end=end))
        assert recognise(path).name == "PTS"
        assert listed_kind(path) == "scan"
        scan = read_scan(path, origin=HERE)
        same_points(scan, wall)
        assert scan.color is not None
    without = "\n".join(" ".join(line.split()[:4]) for line in rows(wall).splitlines())
    same_points(read_scan(write(tmp_path / "b.pts", f"{count}\n{without}"), origin=HERE), wall)
    halves = rows(wall).splitlines()
    both = [str(100), *halves[:100], str(count - 100), *halves[100:]]  # two clouds in one file
    same_points(read_scan(write(tmp_path / "c.pts", "\n".join(both)), origin=HERE), wall)
    with pytest.raises(FormatError, match="claims 999 points"):
        read_scan(write(tmp_path / "d.pts", f"999\n{rows(wall)}"))


@pytest.mark.parametrize("separator", [" ", ",", ";", "\t", ", "])
@pytest.mark.parametrize("head", ["x{0}y{0}z{0}intensity{0}r{0}g{0}b", "//X{0}Y{0}Z{0}Intensity{0}R{0}G{0}B",
                                  '"X"{0}"Y"{0}"Z"{0}"scalar_Intensity"{0}"Red"{0}"Green"{0}"Blue"',
                                  "X[m]{0}Y[m]{0}Z[m]{0}Reflectance(dB){0}R{0}G{0}B"])  # fmt: skip
def test_columns_named_by_a_header_line(tmp_path: Path, wall: Scan, separator: str, head: str) -> None:
    body = rows(wall, separator.strip() or separator).replace(separator.strip() or separator, separator)
    path = write(tmp_path / "a.csv", head.format(separator) + "\n" + body)
    assert recognise(path).kind == "scan"
    assert listed_kind(path) == "scan"
    scan = read_scan(path, origin=HERE)
    same_points(scan, wall)
    color, first = scan.color, cloud(wall)
    assert color is not None
    assert sorted(map(tuple, color[scan.valid].tolist())) == sorted(
        zip(*(first[name].tolist() for name in ("red", "green", "blue")), strict=True)
    )


def test_cloudcompare_writes_titles_and_then_the_count(tmp_path: Path, wall: Scan) -> None:
    text = f"//X Y Z Intensity R G B\n{int(wall.valid.sum())}\n{rows(wall)}"
    same_points(read_scan(write(tmp_path / "a.txt", text)), wall)


def test_columns_without_names_are_asked_for(tmp_path: Path, wall: Scan) -> None:
    path = write(tmp_path / "a.xyz", rows(wall))
    first = rows(wall).splitlines()[0]
    with pytest.raises(FormatError, match="columns have no names") as caught:
        read_scan(path)
    assert first[:20] in str(caught.value)
    assert "`columns=x,y,z,intensity,r,g,b`" in str(caught.value)
    with pytest.raises(FormatError, match="`columns"):
        describe(path)
    same_points(read_scan(path, columns=("x", "y", "z", "intensity", "r", "g", "b")), wall)
    skipped = read_scan(path, columns=("x", "y", "z", "intensity", "-", "-", "-"))
    same_points(skipped, wall)
    assert skipped.color is None
    for columns, words in {
        ("x", "y", "z", "intensity"): "names 4 columns, and the first row has 7",
        ("x", "y", "z", "brightness", "-", "-", "-"): "'brightness'",
        ("x", "y", "y", "intensity", "-", "-", "-"): "must name x, y and z",
    }.items():
        with pytest.raises(OptionError, match=words):
            read_scan(path, columns=columns)


def test_a_swapped_column_is_another_scan(tmp_path: Path, wall: Scan) -> None:
    path = write(tmp_path / "a.xyz", rows(wall))
    with pytest.raises(AssertionError):
        same_points(read_scan(path, origin=(0, 0, 0), columns=("y", "x", "z", "intensity", "-", "-", "-")), wall)


def test_large_coordinates_keep_their_digits(tmp_path: Path, wall: Scan) -> None:
    path = write(tmp_path / "a.csv", "easting,northing,height,intensity,r,g,b\n" + rows(wall, ",", offset=ORIGIN))
    scan = read_scan(path, origin=ORIGIN)
    same_points(scan, wall)
    assert scan.world_from_scanner is not None


def test_colors_alone_need_to_be_asked_for(tmp_path: Path, wall: Scan) -> None:
    text = "\n".join(" ".join([*r.split()[:3], *r.split()[4:]]) for r in rows(wall).splitlines())
    path = write(tmp_path / "a.pts", f"{int(wall.valid.sum())}\n{text}")
    with pytest.raises(FormatError, match="`intensity='luma'`"):
        read_scan(path)
    scan = read_scan(path, intensity="luma")
    assert any("Rec. 709" in note for note in scan.notes)


def test_decimal_commas_are_refused(tmp_path: Path, wall: Scan) -> None:
    for separator in (";", "\t", " "):
        body = rows(wall, separator).replace(".", ",")
        with pytest.raises(FormatError, match="decimal commas"):
            read_scan(write(tmp_path / "a.csv", separator.join("xyzirgb") + "\n" + body))


def test_matches_stay_matches(tmp_path: Path) -> None:
    for head in ("x,y,z,u,v", "row,column,u,v"):
        path = write(tmp_path / "a.csv", head + "\n" + ",".join(["1"] * len(head.split(","))) + "\n")
        assert recognise(path).kind == "matches"
        with pytest.raises(FormatError, match="it is a matches"):
            read_scan(path)


def test_other_texts_are_no_clouds(tmp_path: Path) -> None:
    for text in (
        "name,age\nAnn,5\n",
        "1 word and 3 numbers 4 5\n",
        "a paragraph of text\n",
        "one two three\n",
    ):
        assert listed_kind(write(tmp_path / "a.txt", text)) is None


def test_damage_is_said_in_a_sentence(tmp_path: Path, wall: Scan) -> None:
    text = "x,y,z,intensity,r,g,b\n" + rows(wall, ",")
    lines = text.splitlines()
    broken = {
        "not a row of numbers": "\n".join([*lines[:90], "1,2,what,4,5,6,7", *lines[90:]]),
        "has 3 columns instead of 7": "\n".join([*lines, "1,2,3"]),
        "none of which is called an intensity": "x,y,z,time\n1,2,3,4\n",
        "more than 64 kB": text + "1" * 9_000_000,
    }
    for words, damaged in broken.items():
        with pytest.raises(LadarregError, match=words):
            read_scan(write(tmp_path / "a.csv", damaged))
