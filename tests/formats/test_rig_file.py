"""The table of a rig: what is read, and what is refused with a sentence that says why."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.formats.documents.rig_file import read_rig_table


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.pcd", "b.pcd", "c.pcd", "a.png", "b.png", "camera.json", "Größe 2.png"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "below").mkdir()
    return tmp_path


def table(folder: Path, text: str | bytes) -> Path:
    path = folder / "pairs.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_rows_are_read_with_all_columns_in_any_order(folder: Path) -> None:
    text = "\ufeffPhoto, more ,scan,camera,name\r\n# a remark\r\na.png,b.pcd|c.pcd,a.pcd,camera.json,yard\r\n"
    first, second = read_rig_table(table(folder, text + '\r\n"Größe 2.png",,../' + folder.name + "/b.pcd,,\r\n"))
    assert (first.name, first.scan, first.photo) == ("yard", folder / "a.pcd", folder / "a.png")
    assert first.camera == folder / "camera.json"
    assert first.more == (folder / "b.pcd", folder / "c.pcd")
    assert len(first.files) == 5
    assert (second.name, second.camera, second.more) == ("Größe 2", None, ())
    assert second.scan.samefile(folder / "b.pcd")


def test_semicolons_and_equal_names_are_taken(folder: Path) -> None:
    rows = read_rig_table(table(folder, "scan;photo;name\na.pcd;a.png;x\nb.pcd;a.png;x\n"))
    assert [row.name for row in rows] == ["x", "x (2)"]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "it is empty"),
        ("\n# remark\n", "its header does not name its columns"),
        ("scan\na.pcd\n", "must name scan and photo"),
        ("scan,photo,wieght\na.pcd,a.png,1\n", "wieght"),
        ("scan,photo,scan\na.pcd,a.png,b.pcd\n", "once each"),
        ("scan,photo\n", "0 pairs"),
        ("scan,photo\na.pcd,\n", "pair 1 has no photo"),
        ("scan,photo\na.pcd,a.png,b.png\n", "more cells"),
        ("scan,photo\na.pcd,z.png\n", "'z.png', and there is no such file"),
        ("scan,photo\na.pcd,below\n", "no such file"),
        ("scan,photo\na.pcd,a.png\na.pcd,a.png\n", "pair 2 repeats a"),
        ("scan,photo\n" + "a.pcd,a.png\n" * 201, "201 pairs"),
        (b"scan,photo\n\xff\xfe,a.png\n", "UTF-8"),
        (b"scan,photo\na\0.pcd,a.png\n", "no text"),
        ("scan,photo\n" + "x" * 1_100_000, "larger than 1 MB"),
    ],
)
def test_what_is_wrong_is_said(folder: Path, text: str | bytes, why: str) -> None:
    with pytest.raises(FormatError, match=r"pairs\.csv: ") as error:
        read_rig_table(table(folder, text))
    assert why in str(error.value)
    assert "\n" not in str(error.value)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    st.lists(st.sampled_from(["scan", "photo", ",", ";", "\n", '"', "a.pcd", "a.png", "|", "\r", "\x85", "../", " "]))
)
def test_any_text_is_a_table_or_a_plain_error(folder: Path, parts: list[str]) -> None:
    try:
        rows = read_rig_table(table(folder, "".join(parts)))
    except LadarregError as error:
        rows = []
        said = str(error)
    else:
        said = ""
    assert "\n" not in said
    assert all(file.is_file() for row in rows for file in row.files)
