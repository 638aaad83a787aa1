"""Stations in the workbench: added, registered, shown, checked with a photograph, exported, and kept."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from testing.workbench.workbench_driver import WorkbenchDriver, open_bench

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
from ladarreg_core.errors import FormatError
from ladarreg_core.formats import read_scan
from ladarreg_core.frames import Rigid
from ladarreg_core.project.storage.codec import decode_document, encode
from testing.scenes.kept import kept_folder
from testing.scenes.station_scans import POSES, write_station_scans

pytestmark = pytest.mark.slow
BETWEEN = POSES[0].inverse @ POSES[1]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Path, Path]:
    return write_station_scans(tmp_path_factory.mktemp("stations"))


@pytest.fixture(scope="module")
def registered(files: tuple[list[Path], Path, Path]) -> Path:
    """Return a project with two stations and a photograph, all registered; tests work on copies."""

    def fill(home: Path) -> None:
        scans, photo, camera = files
        bench = open_bench(home, scans[0], photo, camera=camera)
        assert bench.slice("stations") is None
        add(bench, scans[1])
        assert [station["state"] for station in bench.slice("stations")["stations"]] == ["waiting", "waiting"]
        job(bench, "register_stations")
        assert bench.job("auto").state == "done"
        bench.workbench.close()

    return kept_folder("registered-stations", fill)


@pytest.fixture
def bench(registered: Path, tmp_path: Path) -> Iterator[WorkbenchDriver]:
    shutil.copytree(registered, tmp_path / "home")
    bench = open_bench(tmp_path / "home")
    yield bench
    bench.workbench.close()


def add(bench: WorkbenchDriver, path: Path) -> None:
    bench.workbench.files.open(path, path.name, "station", None, bench.client)


def job(bench: WorkbenchDriver, name: str, **fields: Any) -> Any:
    bench.do(name, **fields)
    bench.workbench.runner.wait(240)
    done = bench.workbench.runner.job
    assert done is not None
    assert done.state == "done", done.message
    return done


def station(bench: WorkbenchDriver) -> dict[str, Any]:
    found: dict[str, Any] = bench.slice("stations")["stations"][1]
    return found


def test_the_result_survives_a_restart(bench: WorkbenchDriver) -> None:
    found = bench.slice("stations")
    assert [each["state"] for each in found["stations"]] == ["fixed", "registered"]
    assert [pair["verdict"] for pair in found["pairs"]] == ["verified"]
    assert found["stations"][0]["id"] is None
    place = station(bench)["place"]
    np.testing.assert_allclose([place["x"], place["y"], place["z"]], BETWEEN.translation, atol=0.002)
    assert 0 < station(bench)["sigma_mm"] < 5


def test_shown_points_are_bounded_and_placed(bench: WorkbenchDriver) -> None:
    (shown,) = bench.workbench.stations.shown()
    assert 1000 < len(shown.points) <= 200_000
    assert shown.shown_from_station.distance_to(BETWEEN) < 0.002


def test_a_photograph_is_verified_at_the_other_station(bench: WorkbenchDriver) -> None:
    job(bench, "check_at_stations")
    (check,) = bench.slice("stations")["checks"]
    assert check["outcome"] == "verified"
    assert not check["stale"]
    bench.do("undo")
    assert bench.slice("stations")["checks"] == []


@pytest.mark.long
def test_work_at_each_station_is_kept_and_carried(bench: WorkbenchDriver) -> None:
    here = bench.workbench.session.document
    bench.do("show_station", station=station(bench)["id"])
    there = bench.workbench.session.document
    assert bench.slice("scan")["name"] == "window.npz"
    assert there.photos[0].poses == ()
    assert there.photos[0].stated_by == "hall.npz"
    stated, pose = there.photos[0].stated_pose, here.photos[0].pose
    assert stated is not None
    assert pose is not None
    carried = Rigid.from_matrix(pose.camera_from_scanner) @ BETWEEN
    assert Rigid.from_matrix(stated).distance_to(carried) < 0.002
    assert bench.job("auto").state == "done"
    bench.do("show_station", station=station(bench)["id"])
    assert bench.workbench.session.document.photos == here.photos
    bench.do("undo")
    assert bench.workbench.session.document.photos[0].pose is not None
    bench.do("undo")
    bench.do("undo")
    assert bench.workbench.session.document.stations == here.stations


def test_all_stations_are_exported(bench: WorkbenchDriver, tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    job(bench, "export", targets=["stations", "e57"], photos=[])
    found = bench.workbench.export_file("all")
    assert found is not None
    with zipfile.ZipFile(found[0]) as packed:
        packed.extractall(tmp_path / "out")
    described = json.loads((tmp_path / "out/stations/stations.json").read_text())
    assert [one["scan"] for one in described["stations"]] == ["hall.npz", "window.npz"]
    poses = [read_scan(tmp_path / "out/e57/stations.e57", scan_index=k).world_from_scanner for k in range(2)]
    assert poses[0] is not None
    assert poses[1] is not None
    assert (poses[0].inverse @ poses[1]).distance_to(BETWEEN) < 0.002


@pytest.mark.long
def test_rough_places_and_refusals(bench: WorkbenchDriver, files: tuple[list[Path], Path, Path]) -> None:
    name = station(bench)["id"]
    assert "enter all of them" in bench.refused("place_station", station=name, place={"x": 1})
    assert "no longer in the project" in bench.refused("show_station", station="s99")
    with pytest.raises(Exception, match="in the project already"):
        add(bench, files[0][1])
    bench.do("remove_station", station=name)
    assert bench.slice("stations") is None
    assert "add scans of other stations" in bench.refused("register_stations")
    bench.do("undo")
    assert station(bench)["state"] == "registered"
    # A wrong rough place misleads nobody: nothing is accepted near it, and a search need not begin there.
    bench.do("place_station", station=name, place={"x": 6, "y": -6, "z": 0, "yaw_deg": 170})
    job(bench, "register_stations")
    assert station(bench)["state"] == "out"
    assert "'Poses in the files': search looks everywhere" in bench.slice("stations")["pairs"][0]["reasons"][-1]
    assert "must be 'keep', 'refine' or 'search'" in bench.refused("register_stations", poses="exact")
    job(bench, "register_stations", poses="search")
    assert abs(station(bench)["place"]["x"] - BETWEEN.translation[0]) < 0.002


def test_a_damaged_result_is_refused(bench: WorkbenchDriver) -> None:
    document = bench.workbench.session.document
    fields = json.loads(encode(document))
    arrays = _arrays(document)
    for damaged in ({}, {**fields["survey"]["fields"], "stations": []}, {**fields["survey"]["fields"], "pairs": [{}]}):
        text = json.dumps({**fields, "survey": {**fields["survey"], "fields": damaged}}).encode()
        with pytest.raises(FormatError, match="register them again"):
            decode_document(text, arrays.__getitem__)


def _arrays(document: Any) -> dict[str, Any]:
    from ladarreg_core.project.storage.codec import arrays_of

    return arrays_of(document)
