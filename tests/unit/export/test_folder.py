import json
import os
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.errors import Cancelled, ExportError
from ladarreg_core.export.json import registration_document, write_document
from ladarreg_core.export.targets.folder import FILE_NAMES, export_registration, write_folder
from ladarreg_core.foundations.palette import UNKNOWN
from ladarreg_core.quality.smoothing import SmoothedScan
from ladarreg_core.storage import staging
from ladarreg_core.storage.manifest import MANIFEST_FILE, visible_files
from ladarreg_core.storage.replacement import remove_results, require_replaceable
from testing.scenes.small_registration import sample_registration


def names(path):
    return visible_files(path)


def earlier(out, *, accepted=True, **more):
    """Write the results of an earlier run, with content that no later run writes."""
    out.mkdir(parents=True)
    write_document(out / "registration.json", registration_document(sample_registration(accepted=accepted)))
    for name in FILE_NAMES[1:] if accepted else FILE_NAMES[1:2]:
        (out / name).write_text("old", encoding="utf-8")
    return {path.name: path.read_bytes() for path in out.iterdir()}


def held(out):
    return {path.name: path.read_bytes() for path in out.iterdir()}


def test_an_accepted_registration_writes_everything(tmp_path, registration, scan, photo):
    seen = []
    export_registration(tmp_path / "a" / "b" / "out", registration, scan, photo, report=seen.append)
    assert names(tmp_path / "a" / "b") == ["out"]
    assert names(tmp_path / "a" / "b" / "out") == sorted(FILE_NAMES)
    assert [p.done for p in seen] == list(range(len(FILE_NAMES) + 1))
    assert seen[-1].total == len(FILE_NAMES)


def test_what_is_not_accepted_is_never_written_as_registered(tmp_path, scan, photo):
    export_registration(tmp_path / "out", sample_registration(accepted=False), scan, photo)
    assert names(tmp_path / "out") == ["registration.json", "rejected_overlay.png", "report.html"]
    assert json.loads((tmp_path / "out" / "registration.json").read_text(encoding="utf-8"))["accepted"] is False


def test_the_uncertainty_is_on_the_scan_grid_like_the_labels(tmp_path, registration, scan, photo):
    export_registration(tmp_path / "out", registration, scan, photo)
    picture = np.asarray(Image.open(tmp_path / "out" / "uncertainty.png"))[: scan.shape[0], : scan.shape[1]]
    points = registration.camera_from_scanner @ np.nan_to_num(scan.points, nan=-1.0)
    within = scan.valid & registration.camera.contains(registration.camera.project(points))
    assert within.any()
    np.testing.assert_array_equal((picture == UNKNOWN).all(axis=-1), ~within)


def test_a_smoothed_scan_is_what_the_models_show_and_nothing_else(tmp_path, registration, scan, photo):
    ranges = np.array(scan.ranges)
    ranges[14, 20] *= 0.97
    smoothed = SmoothedScan(replace(scan, ranges=ranges), 1, "One.")
    unchanged = SmoothedScan(scan, 0, "None.")
    for name, shown in (("plain", None), ("smooth", smoothed), ("same", unchanged)):
        export_registration(tmp_path / name, registration, scan, photo, smoothed=shown)
    for name in FILE_NAMES:
        plain, smooth, same = ((tmp_path / folder / name).read_bytes() for folder in ("plain", "smooth", "same"))
        changes = name in ("model.glb", "cloud.ply", "registration.json", "report.html")
        assert (smooth != plain) == changes, name
        assert (same != plain) == (name in ("registration.json", "report.html")), name
    document = json.loads((tmp_path / "smooth" / "registration.json").read_text(encoding="utf-8"))
    assert document["smoothing"] == {"cells_replaced": 1, "sentence": "One."}


def test_every_picture_is_of_the_camera_that_was_estimated(tmp_path, registration, scan, photo):
    longer = replace(registration.camera, fx=130.0, fy=131.0)
    for name, camera in (("given", registration.camera), ("estimated", longer)):
        export_registration(tmp_path / name, replace(registration, camera=camera), scan, photo)
    for name in FILE_NAMES:
        assert (tmp_path / "given" / name).read_bytes() != (tmp_path / "estimated" / name).read_bytes(), name


def test_results_are_refused_or_replaced(tmp_path, registration, scan, photo):
    out = tmp_path / "out"
    old = earlier(out)
    with pytest.raises(ExportError, match=r"earlier results .*force=True"):
        export_registration(out, registration, scan, photo)
    assert held(out) == old
    export_registration(out, registration, scan, photo, force=True)
    assert names(out) == sorted(FILE_NAMES)
    assert b"old" not in held(out).values()
    assert names(tmp_path) == ["out"]


def test_refused_results_are_replaced_without_force(tmp_path, registration, scan, photo):
    earlier(tmp_path / "alone", accepted=False)
    export_registration(tmp_path / "alone", registration, scan, photo)
    assert names(tmp_path / "alone") == sorted(FILE_NAMES)
    old = earlier(tmp_path / "beside", accepted=False)
    (tmp_path / "beside" / "labels.png").write_bytes(b"mine")
    with pytest.raises(ExportError, match="earlier results"):
        export_registration(tmp_path / "beside", registration, scan, photo)
    assert held(tmp_path / "beside") == {**old, "labels.png": b"mine"}


def test_additional_files_belong_to_the_results(tmp_path, registration, scan, photo):
    more = [(name, lambda path: path.write_text("new")) for name in ("matches.json", "my matches.csv")]
    export_registration(tmp_path / "out", registration, scan, photo, more=more)
    assert names(tmp_path / "out") == sorted([*FILE_NAMES, "matches.json", "my matches.csv"])
    export_registration(tmp_path / "out", registration, scan, photo, force=True)
    assert names(tmp_path / "out") == sorted(FILE_NAMES)


def test_what_somebody_changed_or_added_is_never_replaced(tmp_path, registration, scan, photo):
    out = tmp_path / "out"
    export_registration(out, registration, scan, photo)
    cloud = (out / "cloud.ply").read_bytes()
    for name, content, said in (
        ("cloud.ply", cloud[:-1] + b"x", "contains cloud.ply, changed since"),
        ("cloud.ply", b"cleaned", "contains cloud.ply, changed since"),
        ("matches.json", b"{}", r"contains matches\.json next to registration\.json, which ladarreg did not write"),
        (MANIFEST_FILE, b"{}", rf"contains {MANIFEST_FILE}, changed since"),
    ):
        before = held(out)
        (out / name).write_bytes(content)
        changed = held(out)
        with pytest.raises(ExportError, match=said):
            export_registration(out, registration, scan, photo, force=True)
        assert held(out) == changed
        (out / name).unlink()
        for path, data in before.items():
            (out / path).write_bytes(data)
    (out / "labels.png").unlink()
    export_registration(out, registration, scan, photo, force=True)
    assert names(out) == sorted(FILE_NAMES)
    assert names(tmp_path) == ["out"]


def test_a_forged_document_of_an_earlier_version_names_no_file_of_others(tmp_path):
    (tmp_path / "out").mkdir()
    forged = {"kind": "export", "software": {"name": "ladarreg"}, "files": ["thesis.docx"]}
    (tmp_path / "out" / "export.json").write_text(json.dumps(forged))
    (tmp_path / "out" / "thesis.docx").write_bytes(b"work")
    with pytest.raises(ExportError, match="did not write"):
        require_replaceable(tmp_path / "out", force=True)
    remove_results(tmp_path / "out")
    assert (tmp_path / "out" / "thesis.docx").read_bytes() == b"work"


@pytest.fixture(params=["exchanged", "set aside"])
def way(request, monkeypatch):
    """Both ways of replacing a folder, on every system that supports both."""
    if request.param == "set aside":
        monkeypatch.setattr(staging, "_exchange", lambda first, second: False)
    return request.param


@pytest.mark.slow
@pytest.mark.parametrize("stop", [Cancelled, KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize("at", range(len(FILE_NAMES) + 1))
@pytest.mark.parametrize("existing", [False, True])
def test_stopped_anywhere_it_leaves_what_was_there(tmp_path, registration, assessment, scan, photo, stop, at, existing):
    out = tmp_path / "new" / "out"
    old = earlier(out) if existing else {}

    def report(progress):
        if progress.done == at:
            raise stop

    with pytest.raises(stop):
        export_registration(out, registration, scan, photo, assessment=assessment, force=True, report=report)
    assert names(tmp_path) == (["new"] if existing else [])
    if existing:
        assert names(tmp_path / "new") == ["out"]
        assert held(out) == old


@pytest.mark.parametrize("failing", [1, 2])
def test_a_rename_that_fails_restores_the_old_folder(tmp_path, registration, scan, photo, failing, monkeypatch):
    out = tmp_path / "out"
    old = earlier(out)
    real, calls = os.rename, []

    def rename(source, target):
        calls.append(source)
        if len(calls) == failing:
            raise OSError(28, "No space left on device")
        real(source, target)

    monkeypatch.setattr(staging, "_exchange", lambda first, second: False)
    monkeypatch.setattr(staging.os, "rename", rename)
    with pytest.raises(ExportError, match="no space left"):
        export_registration(out, registration, scan, photo, force=True)
    assert names(tmp_path) == ["out"]
    assert held(out) == old


def test_an_interruption_just_after_the_last_rename_keeps_the_new_folder(
    tmp_path, registration, scan, photo, monkeypatch
):
    out = tmp_path / "out"
    earlier(out)
    real = os.rename

    def rename(source, target):
        real(source, target)
        if target == out:
            raise KeyboardInterrupt

    monkeypatch.setattr(staging, "_exchange", lambda first, second: False)
    monkeypatch.setattr(staging.os, "rename", rename)
    with pytest.raises(KeyboardInterrupt):
        export_registration(out, registration, scan, photo, force=True)
    assert names(tmp_path) == ["out"]
    assert names(out) == sorted(FILE_NAMES)


def test_a_file_that_appears_at_the_last_moment_is_kept(tmp_path, registration, scan, photo, monkeypatch, way):
    out = tmp_path / "out"
    old = earlier(out)
    real = staging.put_in_place

    def put_in_place(new, target, verify):
        (out / "IMG_0001.jpg").write_bytes(b"just saved")
        real(new, target, verify)

    monkeypatch.setattr("ladarreg_core.export.targets.folder.put_in_place", put_in_place)
    with pytest.raises(ExportError, match=r"contains IMG_0001\.jpg next to registration\.json"):
        export_registration(out, registration, scan, photo, force=True)
    assert names(tmp_path) == ["out"]
    assert held(out) == {**old, "IMG_0001.jpg": b"just saved"}


def test_two_at_once_replace_one_after_the_other_or_are_refused(tmp_path, way):
    out = tmp_path / "out"
    earlier(out)

    def inner(path):
        path.write_bytes(b"inner")
        write_folder(out, lambda: [("registration.json", document)], force=True)

    def document(path):
        write_document(path, registration_document(sample_registration(accepted=False)))

    write_folder(out, lambda: [("registration.json", document), ("labels.png", inner)], force=True)
    assert names(tmp_path) == ["out"]
    assert held(out)["labels.png"] == b"inner"


def test_impossible_folders_are_refused_in_one_line(tmp_path, registration, scan, photo, monkeypatch):
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    (tmp_path / "link").symlink_to(tmp_path)
    for place in ("file", "link", "file/below"):
        with pytest.raises(ExportError) as caught:
            export_registration(tmp_path / place, registration, scan, photo, force=True)
        assert "\n" not in str(caught.value)
    data = tmp_path / "data"
    data.mkdir()
    (data / "scan.npz").write_bytes(b"precious")
    with pytest.raises(ExportError, match=r"contains the input scan\.npz"):
        export_registration(data, registration, scan, photo, inputs=[data / "scan.npz"], force=True)
    monkeypatch.chdir(data)
    with pytest.raises(ExportError, match="current working folder"):
        export_registration(".", registration, scan, photo, force=True)
    assert names(data) == ["scan.npz"]
    assert names(tmp_path) == ["data", "file", "link"]
