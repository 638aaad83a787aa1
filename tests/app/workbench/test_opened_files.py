"""Files that the workbench opens, refuses, offers or keeps."""

from __future__ import annotations

import io
import json
import math
import os
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from ladarreg.gateway.protocol import Visitor
from PIL import Image

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.project.history import NOBODY
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench, sample_bench

LINE = {"kind": "line", "scan": [[1, 0, 0], [1, 0.1, 0.02]], "photo_uv": [[300.25, 200.5], [410.125, 220]]}


def labels(bench: WorkbenchDriver) -> list[str]:
    return [entry["label"] for entry in bench.slice("history")["entries"]]


@pytest.mark.slow
def test_invalid_uploads_are_refused_and_deleted(bench: WorkbenchDriver, tmp_path: Path) -> None:
    room = bench.workbench.upload_folder()
    before = bench.workbench.session.document

    def upload(data: bytes, name: str, what: str) -> str:
        path = room / f"upload-{name}"
        path.write_bytes(data)
        return bench.workbench.take_upload(path, name, what, "p1", bench.client)

    whole = (sample_folder() / "scan.npz").read_bytes()
    picture = next(sample_folder().glob("photo.*")).read_bytes()
    for data, name, what in (
        (b"hello", "a.png", "photo"),
        (picture[: len(picture) // 2], "cut.png", "photo"),
        (whole[:5000], "cut.npz", "scan"),
        (picture, "picture.npz", "scan"),
        (b"{}", "camera.json", "camera"),
        (b"a,b\n1,2\n", "matches.csv", "matches"),
        (picture, "x.png", "virus"),
    ):
        with pytest.raises(LadarregError) as caught:
            upload(data, name, what)
        assert str(bench.workbench.session.folder.path) not in str(caught.value)
    assert bench.workbench.session.document is before
    assert not [path for path in room.iterdir() if path.name.startswith("upload-")], "refused files are deleted"

    second = upload(picture, "second.png", "photo")
    assert second == "p2"
    assert bench.slice("shown") == "p2"


def unviewable_scan(path: Path) -> Path:
    """Write a valid scan of 24 x 36 cells whose rows span a hundredth of a degree."""
    counts = np.random.default_rng(0).integers(100, 200, (24, 36)).astype(np.uint16)
    steps = {"d_azimuth_rad": 0.01, "d_elevation_rad": 1e-5}
    np.savez(path, intensity=np.ones((24, 36), np.float32), counts=counts, r0_m=0.5, dr_m=0.01, **steps)
    return path


def test_a_scan_without_views_is_refused_and_clients_can_still_join(bench: WorkbenchDriver) -> None:
    before = bench.workbench.session.document
    path = unviewable_scan(bench.workbench.upload_folder() / "sliver.npz")
    with pytest.raises(LadarregError, match="no single image resolves") as caught:
        bench.workbench.take_upload(path, "sliver.npz", "scan", None, bench.client)
    assert "\n" not in str(caught.value)
    assert not path.exists()
    assert bench.workbench.session.document is before
    bench.workbench.leave(bench.workbench.join(Visitor("somebody else")))
    assert bench.slice("scan")["views"]


@pytest.mark.slow
def test_a_project_whose_scan_has_no_views_opens_with_a_message(tmp_path: Path) -> None:
    import msgspec

    bench = sample_bench(tmp_path / "p")
    truth = json.loads((sample_folder() / "truth.json").read_bytes())
    draw_matches(bench, np.array(truth["camera_from_scanner"]))
    job = bench.job("linear")
    assert job.state == "done", job.message
    path = unviewable_scan(bench.workbench.upload_folder() / "sliver.npz")
    source = msgspec.structs.replace(bench.workbench.session.document.scan, path="inputs/sliver.npz", name="sliver")
    bench.workbench.session.commit("Open it", lambda d: msgspec.structs.replace(d, scan=source), author=NOBODY)
    assert path.exists()
    before = bench.workbench.session.history
    bench.workbench.close()

    bench = open_bench(tmp_path / "p")
    try:
        assert bench.workbench.session.document == before.document
        assert labels(bench) == [entry.label for entry in before.entries]
        assert "The scan cannot be shown: the scan's 24 rows span" in bench.slice("project")["opened"]
        assert "which no single image resolves" in bench.slice("scan")["error"]
        assert bench.slice("scan")["views"] == []
        with pytest.raises(LadarregError, match="no single image resolves"):
            bench.workbench.picture("scan", {})
        bench.workbench.leave(bench.workbench.join(Visitor("somebody else")))
        matches = len(bench.slice("picks:p1"))
        bench.do("add_pick", photo="p1", **LINE)
        bench.do("run", photo="p1", job="export", last_solved=True)
        bench.workbench.runner.wait(240)
        job = bench.workbench.runner.job
        assert job is not None
        assert job.state == "done", job.message
        zipped, _ = bench.workbench.export_file("p1") or (None, None)
        assert zipped is not None
        with zipfile.ZipFile(zipped) as file:
            assert len(json.loads(file.read("matches.json"))["matches"]) == matches, "those it was solved on"
        bench.do("undo")
        bench.do("undo")
        assert bench.slice("scan")["views"], "the previous scan is back"
        assert "cannot be shown" not in bench.slice("project")["opened"]
    finally:
        bench.workbench.close()


def draw_matches(bench: WorkbenchDriver, pose: np.ndarray) -> None:
    """Add two dozen exact points."""
    scan = bench.workbench.loader.scan(bench.workbench.session.document)
    camera = bench.workbench.loader.photo(bench.workbench.session.document.photos[0]).camera
    assert scan is not None
    points = scan.points[20::60, 20::60].reshape(-1, 3).astype(float)
    points = points[np.isfinite(points).all(axis=1)]
    uv = camera.project(points @ pose[:3, :3].T + pose[:3, 3])
    seen = np.flatnonzero(camera.contains(uv))
    for k in seen[:: max(1, len(seen) // 24)].tolist():
        bench.do("add_pick", photo="p1", kind="point", scan=[points[k].tolist()], photo_uv=[uv[k].tolist()])


@pytest.mark.slow
def test_a_file_of_the_project_is_never_deleted(bench: WorkbenchDriver) -> None:
    path = bench.workbench.upload_folder() / "second.png"
    path.write_bytes(next(sample_folder().glob("photo.*")).read_bytes())
    bench.workbench.take_upload(path, "second.png", "photo", None, bench.client)
    bench.do("undo")
    with pytest.raises(LadarregError):
        bench.workbench.take_upload(path, "second.png", "scan", None, bench.client)
    assert path.exists(), "the history refers to it"
    bench.do("redo")
    assert bench.slice("photos")[-1]["width"] > 0


@pytest.mark.skipif(sys.platform != "linux", reason="file names are text here")
def test_a_file_name_that_is_not_unicode_is_not_listed(tmp_path: Path) -> None:
    served = tmp_path / "served"
    served.mkdir()
    name = os.fsdecode(b"b\xfcro.npz")
    (served / name).write_bytes((sample_folder() / "scan.npz").read_bytes())
    bench = open_bench(tmp_path / "project", folder=served)
    try:
        assert bench.slice("served")["files"] == []
        with pytest.raises(OptionError, match="not valid Unicode"):
            bench.workbench.files.open(served / name, name, "scan", None, "")
        assert bench.workbench.session.document.scan is None
        bench.do("rename", name="still works")
    finally:
        bench.workbench.close()


@pytest.mark.slow
def test_a_photo_without_focal_length_is_shown_and_a_camera_requested(bench: WorkbenchDriver, tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (90, 120, 3), np.uint8)).save(buffer, "PNG")
    path = bench.workbench.upload_folder() / "plain.png"
    path.write_bytes(buffer.getvalue())
    photo = bench.workbench.take_upload(path, "plain.png", "photo", None, bench.client)
    told = bench.slice("photos")[-1]
    assert told["camera"] is None
    assert "focal length" in told["camera_error"]
    assert (told["width"], told["height"]) == (120, 90)
    assert bench.workbench.picture(f"photo/{photo}", {}).data
    assert "focal length" in bench.refused("run", photo=photo, job="robust")
    bench.do("set_camera", photo=photo, focal_mm=35, sensor_mm=36)
    assert bench.slice("photos")[-1]["camera"]["fx"] == pytest.approx(120 * 35 / 36)
    bench.do("set_camera", photo=photo, focal_35mm=26)
    assert bench.slice("photos")[-1]["camera"]["fx"] == pytest.approx(26 * math.hypot(120, 90) / math.hypot(36, 24))


def test_a_served_folder_offers_only_files_below_it(tmp_path: Path) -> None:
    served = tmp_path / "served"
    (served / "deep").mkdir(parents=True)
    for path in sample_folder().iterdir():
        (served / "deep" / path.name).write_bytes(path.read_bytes())
    (served / "notes.txt").write_text("nothing")
    (tmp_path / "secret.png").write_bytes(b"secret")
    bench = open_bench(tmp_path / "project", folder=served)
    try:
        listed = bench.slice("served")
        assert "deep/scan.npz" in [entry["path"] for entry in listed["files"]]
        assert not [entry for entry in listed["files"] if "notes" in entry["path"]]
        bench.do("open_served", path="deep/scan.npz", what="scan")
        assert bench.slice("scan")["rows"] > 10
        for path in ("../secret.png", str(tmp_path / "secret.png"), "deep/../../secret.png", "nothing.png", ""):
            assert "no such file" in bench.refused("open_served", path=path, what="photo")
    finally:
        bench.workbench.close()


def test_hidden_files_of_a_served_folder_are_neither_listed_nor_opened(tmp_path: Path) -> None:
    served = tmp_path / "served"
    scan = (sample_folder() / "scan.npz").read_bytes()
    camera = (sample_folder() / "camera.json").read_bytes()
    secret = "password: correct horse battery staple\n"
    for folder in ("", ".ssh", "deep/.config"):
        (served / folder).mkdir(parents=True, exist_ok=True)
        (served / folder / ".hidden.npz").write_bytes(scan)
        (served / folder / "secret.yaml").write_text(secret)
    (served / ".ssh" / "scan.npz").write_bytes(scan)
    (served / "deep" / ".config" / "camera.json").write_bytes(camera)
    (served / "accounts.json").write_text(json.dumps({"client_secret": "staple"}))
    (served / "notes.csv").write_text("name,password\nme,staple\n")
    (served / "camera.json").write_bytes(camera)
    if sys.platform != "win32":
        (served / "looks-plain.npz").symlink_to(served / ".ssh" / "scan.npz")
        (served / "plain").symlink_to(served / ".ssh")
    bench = open_bench(tmp_path / "project", folder=served)
    try:
        bench.do("list_served")
        assert [entry["path"] for entry in bench.slice("served")["files"]] == ["camera.json"]
        for path in (
            ".hidden.npz", ".ssh/.hidden.npz", ".ssh/scan.npz", "deep/.config/camera.json", "deep/../.ssh/scan.npz",
            "./.ssh/scan.npz", ".ssh/secret.yaml", "secret.yaml", "accounts.json", "notes.csv", "looks-plain.npz",
            "plain/scan.npz", "a\0b.npz", ".", "..", "",
        ):  # fmt: skip
            for what in ("scan", "photo", "camera", "matches"):
                said = bench.refused("open_served", path=path, what=what)
                assert said == "There is no such file in the served folder; refresh the list."
    finally:
        bench.workbench.close()
