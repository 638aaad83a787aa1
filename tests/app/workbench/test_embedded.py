"""Pictures embedded in an E57 offer themselves as photographs."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.app.workbench_driver import open_bench
from tests.formats.conftest import e57_fields, e57_file, make_scan
from tests.formats.test_e57 import picture_e57


def test_a_picture_of_the_scan_becomes_a_photograph_with_its_camera_and_pose(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    builders = SimpleNamespace(e57=e57_file, e57_fields=e57_fields)
    scan, _ = picture_e57(tmp_path / "a.e57", builders, make_scan(60, 90))
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
    from tests.app.workbench_driver import sample_bench

    bench = sample_bench(tmp_path / "project")
    assert bench.slice("embedded") == []
    bench.workbench.close()
