"""Which photographs one camera took, by their headers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.batches.photos.folder_info import describe_folder
from ladarreg_core.batches.photos.photo_list import camera_groups, folder_contents, photo_entries
from ladarreg_core.camera import Camera
from ladarreg_core.errors import FormatError
from ladarreg_core.formats.scans.npz import write_npz_xyz
from testing.scenes.photo_set import write_phone_photo
from testing.scenes.small_registration import sample_scan

PHONE = Camera.from_focal(64, 48, 60.0)
PIXELS = np.zeros((48, 64, 3), np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number in range(3):
        write_phone_photo(tmp_path / f"{number}.jpg", PIXELS, PHONE)
    write_phone_photo(tmp_path / "other phone.jpg", PIXELS, PHONE, model="P2")
    write_phone_photo(tmp_path / "zoomed.jpg", PIXELS, Camera.from_focal(64, 48, 120.0))
    Image.fromarray(PIXELS).save(tmp_path / "plain.png")
    (tmp_path / "damaged.jpg").write_bytes(b"\xff\xd8\xff nothing")
    (tmp_path / "notes.txt").write_text("bring the tripod")
    (tmp_path / ".hidden.jpg").write_bytes((tmp_path / "0.jpg").read_bytes())
    write_npz_xyz(tmp_path / "scan.npz", sample_scan())
    return tmp_path


def test_photographs_of_one_body_lens_focal_length_and_size_have_one_camera(folder: Path) -> None:
    contents = folder_contents(folder)
    assert [path.name for path in contents.scans] == ["scan.npz"]
    entries = photo_entries(contents.photos)
    groups = camera_groups(entries)
    assert [[entry.path.name for entry in group.photos] for group in groups] == [
        ["0.jpg", "1.jpg", "2.jpg"], ["other phone.jpg"], ["plain.png"], ["zoomed.jpg"],
    ]  # fmt: skip
    assert [group.may_pool for group in groups] == [True, False, False, False]
    assert "Simulated P1, main" in groups[0].words
    (damaged,) = (entry for entry in entries if entry.facts is None)
    assert damaged.path.name == "damaged.jpg"
    assert damaged.fault


def test_a_given_camera_is_that_of_all_photographs_of_a_size_and_a_calibrated_one_is_not_pooled(folder: Path) -> None:
    entries = photo_entries([folder / "plain.png", folder / "plain.png", folder / "0.jpg"])
    assert len(entries) == 2, "each file once"
    twice = [entries[0], photo_entries([folder / "plain.png"])[0]]
    assert [group.may_pool for group in camera_groups(twice)] == [False]
    assert [group.may_pool for group in camera_groups(twice, {"focal_px": 60.0})] == [True]
    assert [group.may_pool for group in camera_groups(twice, {"camera": "camera.json"})] == [False]


def test_ids_are_unique_names_of_folders(tmp_path: Path) -> None:
    paths = [tmp_path / "a" / "IMG 1.jpg", tmp_path / "b" / "IMG 1.jpg", tmp_path / "b" / "img-1.png"]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        write_phone_photo(path.with_suffix(".jpg"), PIXELS, PHONE)
        if path.suffix == ".png":
            Image.fromarray(PIXELS).save(path)
    assert [entry.id for entry in photo_entries(paths)] == ["IMG-1", "IMG-1-2", "img-1-3"]


def test_info_says_what_a_folder_contains_and_what_would_be_done(folder: Path) -> None:
    info = describe_folder(folder)
    assert info["scans"] == ["scan.npz"]
    assert len(info["photos"]) == 6
    assert [one["photos"] for one in info["cameras"]] == [3, 1, 1, 1]
    assert "pooled" in info["cameras"][0]["register"]
    assert "`focal_px`" in info["cameras"][2]["register"]
    assert len(info["unreadable"]) == 1
    assert info["register"].startswith("7 photos on scan.npz")
    (folder / "empty").mkdir()
    with pytest.raises(FormatError, match="neither a scan nor a photo"):
        describe_folder(folder / "empty")
