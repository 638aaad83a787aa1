"""The table of a rig: what is read, and what is refused with a sentence that says why."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import ladarreg_core as lr
from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.formats.documents.rig_file import read_rig_table
from testing.files.small_scans import make_scan, pcd_bytes


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


def test_cameras_are_told_apart_by_their_names_and_found_in_one_file(folder: Path) -> None:
    """Two cameras take a photograph each beside two clouds; their intrinsics stand in one camchain."""
    for number, name in enumerate("ab"):
        points = make_scan().points.reshape(-1, 3) * (1 + number)
        (folder / f"{name}.pcd").write_bytes(pcd_bytes(points[np.isfinite(points).all(axis=1)], None))
        (folder / f"{name}.png").write_bytes(cv2.imencode(".png", np.full((48, 64, 3), 9 * number, np.uint8))[1])
    cameras = [
        f"cam{k}:\n  camera_model: pinhole\n  distortion_model: {model}\n  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]\n"
        f"  intrinsics: [{60 + k}, 60.0, 31.5, 23.5]\n  resolution: [64, 48]\n"
        for k, model in enumerate(("radtan", "equidistant"))
    ]
    (folder / "chain.yaml").write_text("".join(cameras))
    rows = "a.pcd,a.png,cam0\nb.pcd,b.png,cam0\na.pcd,b.png,cam1\nb.pcd,a.png,cam1\n"
    pairs = lr.read_rig(
        table(folder, f"scan,photo,camera_name\n{rows}"), photo_options={"camera": folder / "chain.yaml"}
    )
    assert [pair.camera_name for pair in pairs] == ["cam0", "cam0", "cam1", "cam1"]
    assert [pair.photo.camera.model for pair in pairs] == ["pinhole", "pinhole", "fisheye", "fisheye"]
    assert pairs[0].scan is pairs[2].scan, "read once"
    alone = table(folder, "scan,photo,camera_name\na.pcd,a.png,cam1\nb.pcd,b.png,cam1\n")
    pairs = lr.read_rig(alone, photo_options={"camera": folder / "chain.yaml"})
    assert {(pair.camera_name, pair.photo.camera.model) for pair in pairs} == {("", "fisheye")}


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
        ("scan,photo,camera_name\na.pcd,a.png,left\nb.pcd,b.png,\n", "of some pairs and not of b"),
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
