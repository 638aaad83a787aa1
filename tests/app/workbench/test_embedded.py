"""Pictures embedded in an E57 offer themselves as photographs."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.camera import Camera
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.simulate.sample import sample_folder
from testing.files.small_scans import make_scan, picture_e57
from testing.workbench.workbench_driver import open_bench
from tests.formats.test_e57_images import STATIONS, write_e57


@pytest.mark.slow
def test_a_picture_of_the_scan_becomes_a_photograph_with_its_camera_and_pose(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    scan, _ = picture_e57(tmp_path / "a.e57", make_scan(60, 90))
    bench = open_bench(tmp_path / "project", scan)
    (offer,) = bench.slice("embedded")
    assert (offer["usable"], offer["taken"]) == (True, False)
    assert offer["said"].startswith("64 x 48, f 71 px as stated, pose stated, ")
    assert bench.slice("photos") == [], "nothing is added by itself"

    assert bench.do("add_embedded", images=[0])["photos"] == ["p1"]
    (photo,) = bench.slice("photos")
    assert (photo["name"], photo["width"], photo["camera"]["fx"]) == ("front_door.jpg", 64, pytest.approx(100.0))
    pose = np.array(photo["stated_pose"])
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert f"{np.linalg.norm(pose[:3, 3]):.2f} m from the scanner" in offer["said"]
    assert bench.slice("embedded")[0]["taken"]
    assert "no such picture" in bench.refused("add_embedded", images=[1])
    for wrong in ([], [True], ["0"], 0, None):
        assert "choose" in bench.refused("add_embedded", images=wrong)
    bench.workbench.close()

    again = open_bench(tmp_path / "project")
    assert again.slice("photos")[0]["stated_pose"] == photo["stated_pose"]
    again.do("undo")
    assert again.slice("photos") == []
    again.workbench.close()
    document = json.loads((tmp_path / "project/project.json").read_text())
    assert document["photos"] == []


def test_other_scans_have_no_pictures(tmp_path: Path) -> None:
    from testing.workbench.workbench_driver import sample_bench

    bench = sample_bench(tmp_path / "project")
    assert bench.slice("embedded") == []
    bench.workbench.close()


@pytest.mark.long
def test_registration_and_solving_start_from_the_pose_that_the_scans_file_states(tmp_path: Path) -> None:
    sample = sample_folder()
    truth, camera = read_pose(sample / "truth.json"), read_camera(sample / "camera.json")
    assert isinstance(camera, Camera)
    stream = io.BytesIO()
    Image.open(sample / "photo.png").convert("RGB").save(stream, "JPEG", quality=95)
    turned = rotation_from_rotvec(np.radians([1.0, -1.5, 0.5])) @ truth.rotation
    rough = Rigid.from_centre(turned, truth.centre + np.array([0.05, -0.05, 0.02]))
    e57_from_opencv = Rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    numbers = {"focalLength": 1.0, "pixelWidth": 1 / camera.fx, "pixelHeight": 1 / camera.fy,
               "principalPointX": camera.cx + 0.5, "principalPointY": camera.cy + 0.5}  # fmt: skip
    assert not any(camera.distortion)
    image = {"name": "photo", "kind": "pinhole", "width": camera.width, "height": camera.height, "numbers": numbers,
             "pose": STATIONS[0] @ (e57_from_opencv @ rough).inverse,
             "data": np.frombuffer(stream.getvalue(), np.uint8).copy()}  # fmt: skip
    path = write_e57(tmp_path / "a.e57", [image], scans=[read_scan(sample / "scan.npz")])
    bench = open_bench(tmp_path / "project", path)
    bench.do("add_embedded", images=[0])
    np.testing.assert_allclose(bench.slice("photos")[0]["stated_pose"], rough.matrix, atol=1e-9)

    job = bench.job("auto")
    assert "began at the pose that the scan's file states" in job.message
    (stage,) = bench.slice("poses:p1")["stages"]
    assert stage["accepted"]
    assert "the scan's file states" in stage["note"]
    entry = bench.workbench.session.document.photos[0].pose
    assert entry is not None
    found = Rigid.from_matrix(np.array(entry.camera_from_scanner))
    assert np.degrees(found.angle_to(truth)) < 0.15
    assert found.distance_to(truth) < 0.02

    assert "the scan's file states" not in bench.job("solve").message, "it starts from the pose that was found"
    bench.do("undo")
    bench.do("undo")
    assert bench.slice("poses:p1")["stages"] == []
    scan = read_scan(sample / "scan.npz")
    uv = camera.project(truth @ scan.points.astype(float))
    seen = np.argwhere(camera.contains(uv) & scan.valid)
    cells = seen[np.random.default_rng(4).permutation(len(seen))[:12]]
    rows = [",".join(f"{value:.3f}" for value in (*cell, *uv[tuple(cell)])) for cell in cells]
    matches = tmp_path / "matches.csv"
    matches.write_text("\n".join(["row,column,u,v", *rows]))
    bench.workbench.files.open(matches, matches.name, "matches", "p1", bench.client)
    assert "the scan's file states" in bench.job("solve").message
    bench.workbench.close()
