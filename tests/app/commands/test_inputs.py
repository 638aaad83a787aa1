"""The scan and the photo of a command, read side by side."""

from __future__ import annotations

import io
import threading
from pathlib import Path

import numpy as np
import pytest
from ladarreg.arguments import parse
from ladarreg.commands import register
from ladarreg.inputs import read_inputs
from ladarreg.progress_bar import progress_bar

from ladarreg_core.errors import FormatError
from ladarreg_core.formats import read_photo, read_scan
from ladarreg_core.simulate.sample import sample_folder

SAMPLE = sample_folder()


def arguments(scan: Path, photo: Path) -> register.Arguments:
    words = [str(scan), str(photo), "--camera", str(SAMPLE / "camera.json"), "-o", "x"]
    return parse(register.Arguments, words, prog="ladarreg register", description="")


def damaged(folder: Path, name: str) -> Path:
    (folder / name).write_bytes(b"nothing that can be read")
    return folder / name


def test_both_are_read_as_alone_and_reported_in_order() -> None:
    before, shown, loaded = threading.active_count(), io.StringIO(), list[int]()
    with progress_bar(quiet=False, stream=shown) as bar:
        given = arguments(SAMPLE / "scan.npz", SAMPLE / "photo.png")
        scan, photo = read_inputs(given, bar, soon=lambda: loaded.append(1))
    assert np.array_equal(scan.ranges, read_scan(SAMPLE / "scan.npz").ranges, equal_nan=True)
    alone = read_photo(SAMPLE / "photo.png", camera=SAMPLE / "camera.json")
    assert (photo.pixels == alone.pixels).all()
    assert photo.camera.as_fields() == alone.camera.as_fields()
    assert shown.getvalue().index("Read scan") < shown.getvalue().index("Read photo")
    assert loaded in ([], [1])  # nothing waits for it
    assert threading.active_count() == before


@pytest.mark.parametrize("wrong", [("scan",), ("photo",), ("scan", "photo")])
def test_of_two_damaged_files_the_scan_is_named(tmp_path: Path, wrong: tuple[str, ...]) -> None:
    scan = damaged(tmp_path, "scan.npz") if "scan" in wrong else SAMPLE / "scan.npz"
    photo = damaged(tmp_path, "photo.png") if "photo" in wrong else SAMPLE / "photo.png"
    with progress_bar(quiet=True) as bar, pytest.raises(FormatError, match=rf"{wrong[0]}\."):
        read_inputs(arguments(scan, photo), bar, soon=lambda: 1 / 0)
