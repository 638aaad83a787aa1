import json
import os
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.errors import Cancelled, ExportError
from ladarreg_core.export import folder as folder_module
from ladarreg_core.export.folder import FILE_NAMES, export_registration
from ladarreg_core.smoothed_scan import SmoothedScan
from tests.unit.export.samples import sample_registration


def names(path):
    return sorted(entry.name for entry in path.iterdir())


def test_an_accepted_registration_writes_everything(tmp_path, registration, scan, photo):
    seen = []
    export_registration(tmp_path / "a" / "b" / "out", registration, scan, photo, report=seen.append)
    assert names(tmp_path / "a" / "b") == ["out"]
    assert names(tmp_path / "a" / "b" / "out") == sorted(FILE_NAMES)
    assert [p.done for p in seen] == list(range(len(FILE_NAMES) + 1))
    assert seen[-1].total == len(FILE_NAMES)


def test_what_is_not_accepted_is_never_written_as_registered(tmp_path, scan, photo):
    export_registration(tmp_path / "out", sample_registration(accepted=False), scan, photo)
    assert names(tmp_path / "out") == ["registration.json"]
    assert json.loads((tmp_path / "out" / "registration.json").read_text(encoding="utf-8"))["accepted"] is False


def test_the_uncertainty_stands_on_the_scan_beside_the_labels(tmp_path, registration, scan, photo):
    export_registration(tmp_path / "out", registration, scan, photo)
    picture = np.asarray(Image.open(tmp_path / "out" / "uncertainty.png"))[: scan.shape[0], : scan.shape[1]]
    points = registration.camera_from_scanner @ np.nan_to_num(scan.points, nan=-1.0)
    within = scan.valid & registration.camera.contains(registration.camera.project(points))
    assert within.any()
    np.testing.assert_array_equal((picture == 48).all(axis=-1), ~within)


def test_a_smoothed_scan_is_what_the_models_show_and_nothing_else(tmp_path, registration, scan, photo):
    ranges = np.array(scan.ranges)
    ranges[14, 20] *= 0.97
    smoothed = SmoothedScan(replace(scan, ranges=ranges), 1, "One.")
    unchanged = SmoothedScan(scan, 0, "None.")
    for name, shown in (("plain", None), ("smooth", smoothed), ("same", unchanged)):
        export_registration(tmp_path / name, registration, scan, photo, smoothed=shown)
    for name in FILE_NAMES:
        plain, smooth, same = ((tmp_path / folder / name).read_bytes() for folder in ("plain", "smooth", "same"))
        changes = name in ("model.glb", "cloud.ply", "registration.json")
        assert (smooth != plain) == changes, name
        assert (same != plain) == (name == "registration.json"), name
    document = json.loads((tmp_path / "smooth" / "registration.json").read_text(encoding="utf-8"))
    assert document["smoothing"] == {"cells_replaced": 1, "sentence": "One."}


def test_every_picture_is_of_the_camera_that_was_estimated(tmp_path, registration, scan, photo):
    longer = replace(registration.camera, fx=130.0, fy=131.0)
    for name, camera in (("given", registration.camera), ("estimated", longer)):
        export_registration(tmp_path / name, replace(registration, camera=camera), scan, photo)
    for name in FILE_NAMES:
        assert (tmp_path / "given" / name).read_bytes() != (tmp_path / "estimated" / name).read_bytes(), name


def test_an_existing_folder_is_refused_or_replaced(tmp_path, registration, scan, photo):
    out = tmp_path / "out"
    out.mkdir()
    (out / "old.txt").write_text("old", encoding="utf-8")
    with pytest.raises(ExportError, match="--force"):
        export_registration(out, registration, scan, photo)
    assert names(out) == ["old.txt"]
    export_registration(out, registration, scan, photo, force=True)
    assert names(out) == sorted(FILE_NAMES)
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("stop", [Cancelled, KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize("at", range(len(FILE_NAMES) + 1))
@pytest.mark.parametrize("existing", [False, True])
def test_stopped_anywhere_it_leaves_what_was_there(tmp_path, registration, assessment, scan, photo, stop, at, existing):
    out = tmp_path / "new" / "out"
    if existing:
        out.mkdir(parents=True)
        (out / "old.txt").write_text("old", encoding="utf-8")

    def report(progress):
        if progress.done == at:
            raise stop

    with pytest.raises(stop):
        export_registration(out, registration, scan, photo, assessment=assessment, force=True, report=report)
    assert names(tmp_path) == (["new"] if existing else [])
    if existing:
        assert names(tmp_path / "new") == ["out"]
        assert names(out) == ["old.txt"]


@pytest.mark.parametrize("failing", [1, 2])
def test_a_rename_that_fails_or_is_interrupted_restores_the_old_folder(
    tmp_path, registration, scan, photo, failing, monkeypatch
):
    out = tmp_path / "out"
    out.mkdir()
    (out / "old.txt").write_text("old", encoding="utf-8")
    real, calls = os.rename, []

    def rename(source, target):
        calls.append(source)
        if len(calls) == failing:
            raise OSError(28, "No space left on device")
        real(source, target)

    monkeypatch.setattr(folder_module.os, "rename", rename)
    with pytest.raises(ExportError, match="no space left"):
        export_registration(out, registration, scan, photo, force=True)
    assert names(tmp_path) == ["out"]
    assert names(out) == ["old.txt"]


def test_an_interruption_just_after_the_last_rename_keeps_the_new_folder(
    tmp_path, registration, scan, photo, monkeypatch
):
    out = tmp_path / "out"
    out.mkdir()
    real = os.rename

    def rename(source, target):
        real(source, target)
        if target == out:
            raise KeyboardInterrupt

    monkeypatch.setattr(folder_module.os, "rename", rename)
    with pytest.raises(KeyboardInterrupt):
        export_registration(out, registration, scan, photo, force=True)
    assert names(tmp_path) == ["out"]
    assert names(out) == sorted(FILE_NAMES)


def test_places_that_cannot_be_are_refused_in_one_line(tmp_path, registration, scan, photo, monkeypatch):
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    (tmp_path / "link").symlink_to(tmp_path)
    for place in ("file", "link", "file/below"):
        with pytest.raises(ExportError) as caught:
            export_registration(tmp_path / place, registration, scan, photo, force=True)
        assert "\n" not in str(caught.value)
    data = tmp_path / "data"
    data.mkdir()
    (data / "scan.npz").write_bytes(b"precious")
    with pytest.raises(ExportError, match=r"holds the input scan\.npz"):
        export_registration(data, registration, scan, photo, inputs=[data / "scan.npz"], force=True)
    monkeypatch.chdir(data)
    with pytest.raises(ExportError, match="work in"):
        export_registration(".", registration, scan, photo, force=True)
    assert names(data) == ["scan.npz"]
    assert names(tmp_path) == ["data", "file", "link"]
