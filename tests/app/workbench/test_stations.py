"""Stations in the workbench: added, registered, shown, checked with a photograph, exported, and kept."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from testing.workbench.workbench_driver import WorkbenchDriver, open_bench

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
from ladarreg.gateway.protocol import Visitor

from ladarreg_core.errors import FormatError
from ladarreg_core.formats import read_scan
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.inspection.picks import probe
from ladarreg_core.project import edits
from ladarreg_core.project.history import NOBODY
from ladarreg_core.project.results import pose_of
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
    returned = bench.workbench.session.document.photos[0]
    assert msgspec.structs.replace(returned, elsewhere=()) == here.photos[0]
    bench.do("undo")
    assert bench.workbench.session.document.photos[0].pose is not None
    bench.do("undo")
    bench.do("undo")
    assert bench.workbench.session.document.stations == here.stations


def add_photo(bench: WorkbenchDriver, name: str, files: tuple[list[Path], Path, Path]) -> str:
    photo = bench.workbench.files.open(files[1], name, "photo", None, bench.client)
    bench.workbench.files.open(files[2], "camera.json", "camera", photo, bench.client)
    return photo


def test_two_people_match_photographs_with_stations_of_their_own(
    bench: WorkbenchDriver, files: tuple[list[Path], Path, Path]
) -> None:
    other = WorkbenchDriver(bench.workbench, bench.workbench.join(Visitor("test")))
    second = add_photo(other, "second.png", files)
    bench.do("show_photo", photo="p1")
    window = station(bench)["id"]
    other.do("set_station", photo=second, station=window)
    assert bench.slice("beside") is None
    assert other.slice("beside")["name"] == "window.npz"
    assert [person.slice("scan")["name"] for person in (bench, other)] == ["hall.npz", "hall.npz"]
    assert [one["station"] for one in other.slice("partner")["choices"]] == ["", window]

    # Each probes the scan that it sees, and a match is of the scan that it was drawn in.
    scans = [read_scan(path) for path in files[0]]
    rays = [[1.0, y / 10, -0.05] for y in range(-5, 6)]
    expected = {k: [probe(scan, ray).range_m for scan in scans] for k, ray in enumerate(rays)}
    k, ranges = next((k, both) for k, both in expected.items() if None not in both and abs(both[0] - both[1]) > 0.1)
    ray = rays[k]
    assert [person.do("probe", scan=ray)["range_m"] for person in (bench, other)] == pytest.approx(ranges)
    drawn = {"photo": second, "kind": "point", "scan": [ray], "photo_uv": [[300, 200]]}
    assert "beside another scan" in bench.refused("add_pick", station="", **drawn)
    other.do("add_pick", station=window, **drawn)
    made = [bench.do("add_measurement", kind="point", places=[{"ray": ray}], station=name) for name in ("", window)]
    assert [one["station"] for one in bench.slice("measurements")] == ["", window]
    bench.do("remove_measurements", measurements=[made[1]["measurement"]])

    # Registered there, the photograph stands where the first one does, which is the same picture.
    assert other.job("auto", photo=second).state == "done"
    document, loader = bench.workbench.session.document, bench.workbench.loader
    poses = [photo.pose for photo in document.photos if photo.pose is not None and photo.pose.accepted]
    here, there = map(pose_of, poses)
    within_m = 2 * float(np.hypot(*(loader.registration(pose).sigma_position_m for pose in poses)))
    assert (here @ BETWEEN).distance_to(there) < within_m
    seen = loader.seen_from_scan(document)
    assert seen is loader.seen_from_scan(document), "made once"
    carried = seen.photos[1].pose
    assert carried is not None
    assert (pose_of(carried) @ BETWEEN).distance_to(there) < 0.005
    assert other.slice("model")["accepted"]

    # Scans of stations that nobody sees are not read for the outlines of their photographs.
    assert other.slice(f"outline:{second}")["registered"]
    other.do("show_photo", photo="p1")
    assert bench.slice(f"outline:{second}") is None
    other.do("show_photo", photo=second)

    # Exported by itself it has its own scan, with others the project's.
    for photos, name in (([second], "window.npz"), (["p1", second], "hall.npz")):
        job(bench, "export", targets=["results"], photos=photos)
        found = bench.workbench.export_file(photos[0] if len(photos) == 1 else "all")
        assert found is not None
        with zipfile.ZipFile(found[0]) as packed:
            results = [json.loads(packed.read(one)) for one in packed.namelist() if one.endswith("registration.json")]
        assert [one["inputs"][0]["name"] for one in results] == [name] * len(photos)

    # One's own steps are undone, whatever others do beside other scans.
    bench.do("undo")
    for _ in range(3):
        other.do("undo")
    assert other.slice("beside") is None
    assert [bench.slice("poses:p1")["shown"], other.slice(f"poses:{second}")["shown"]] == ["auto", None]


def test_a_place_is_the_same_measured_at_either_station(
    bench: WorkbenchDriver, files: tuple[list[Path], Path, Path], tmp_path: Path
) -> None:
    """Picked in the scans of two stations, it has the same coordinates, in the frame of the project's scan."""
    document, window = bench.workbench.session.document, station(bench)["id"]
    here, there = (read_scan(path) for path in files[0])
    targets = here.points[np.isfinite(here.points).all(axis=-1)][::991]
    seen = [BETWEEN.inverse @ at for at in targets]
    rays = [one / np.linalg.norm(one) for one in seen]
    known = [(probe(here, at / np.linalg.norm(at)), probe(there, ray)) for at, ray in zip(targets, rays, strict=True)]
    same = [
        k for k, (at, both) in enumerate(zip(seen, known, strict=True))
        if both[1].range_m is not None and abs(both[1].range_m - np.linalg.norm(at)) < 0.01
        and both[0].edge is None and both[1].edge is None
    ]  # fmt: skip
    assert len(same) >= 2
    chosen = [same[0], same[-1]]

    def xyz(value: str) -> list[float]:
        return [float(number) for number in re.findall(r"-?\d+\.\d+(?= ±)", value)]

    places = {"": [{"ray": targets[k].tolist()} for k in chosen], window: [{"ray": rays[k].tolist()} for k in chosen]}
    points, lengths = (
        [bench.do("measure", kind=kind, places=ends[:count], station=name) for name, ends in places.items()]
        for kind, count in (("point", 1), ("distance", 2))
    )
    assert [one["refusal"] for one in (*points, *lengths)] == [""] * 4
    np.testing.assert_allclose(xyz(points[1]["value"]), xyz(points[0]["value"]), atol=0.02)
    assert float(lengths[1]["value"].split()[0]) == pytest.approx(float(lengths[0]["value"].split()[0]), abs=0.03)
    made = bench.do("add_measurement", kind="distance", places=places[window], station=window)["measurement"]
    measured = bench.eventually(lambda: next((one for one in bench.slice("measured") if one["id"] == made), None))
    np.testing.assert_allclose(measured["drawn"]["ends"], [rays[k] for k in chosen], atol=1e-3)

    # In space and in the list it is where the project's scanner sees it.
    shown = bench.workbench.measured.shown()
    assert shown is not None
    np.testing.assert_allclose(shown.points, [targets[k] for k in chosen], atol=0.02)
    bench.do("export", targets=["measurements"], photos=[])
    bench.workbench.runner.wait(60)
    path, _ = bench.workbench.export_file("all") or (tmp_path, "")
    with zipfile.ZipFile(path) as packed:
        (row,) = csv.DictReader(io.StringIO(packed.read("measurements.csv").decode()))
    assert (row["scan"], row["frame"]) == ("window.npz", "scanner")
    ends = np.array([[float(number) for number in end.split()] for end in row["points"].split("; ")])
    np.testing.assert_allclose(ends, [targets[k] for k in chosen], atol=0.02)

    # A pixel of a photograph beside one scan is measured on the other by the pose that is carried over.
    entry = document.photos[0]
    assert entry.pose is not None
    result = bench.workbench.loader.registration(entry.pose)
    uv = result.camera.project(result.camera_from_scanner @ targets)
    pixel = next(uv[k].tolist() for k in same if result.camera.contains(uv[k], border=5))
    of_photo = [
        bench.do("measure", kind="point", places=[{"photo": "p1", "uv": pixel}], station=name) for name in ("", window)
    ]
    assert [one["refusal"] for one in of_photo] == ["", ""]
    np.testing.assert_allclose(xyz(of_photo[1]["value"]), xyz(of_photo[0]["value"]), atol=0.04)

    # It goes with its scan: shown, that is the project's.
    bench.do("show_station", station=window)
    assert [one["station"] for one in bench.slice("measurements")] == [""]
    after = bench.eventually(lambda: next((one for one in bench.slice("measured") if one["id"] == made), None))
    assert after["value"] == measured["value"]
    bench.do("undo")

    # Where its station stands is not known any more: the length stays, nothing is drawn in another's frame.
    bench.workbench.session.commit("Forget", lambda d: msgspec.structs.replace(d, survey=None), author=NOBODY)
    lost = bench.do("measure", kind="point", places=places[window][:1], station=window)
    assert "in the frame of window.npz" in lost["notes"][-1]
    assert bench.workbench.measured.shown() is None
    bench.do("remove_station", station=window)
    assert bench.slice("measurements") == []


def test_the_station_that_sees_most_of_a_photograph_is_beside_it(
    bench: WorkbenchDriver, files: tuple[list[Path], Path, Path]
) -> None:
    def sees() -> list[float | None]:
        return [one["sees"] for one in bench.slice("partner")["choices"]]

    bench.do("show_photo", photo="p1")
    bench.eventually(lambda: None not in sees())
    assert bench.slice("partner")["station"] == "", "what was registered stays with its scan"
    bench.do("show_station", station=station(bench)["id"])
    # The scanner at the window does not look so far to the left.
    second = add_photo(bench, "left.png", files)
    bench.eventually(lambda: sees() == [None, None])
    camera = Rigid.from_centre(look_along([0.0, 1.0, 0.0]), np.array([0.5, 0.5, 0.0])) @ POSES[1]
    rows = tuple(map(tuple, camera.matrix.tolist()))
    session = bench.workbench.session
    session.commit(
        "State a pose",
        lambda d: edits.edited_photo(d, second, lambda p: msgspec.structs.replace(p, stated_pose=rows)),
        author=NOBODY,
    )
    bench.eventually(lambda: bench.slice("partner")["station"])
    bench.eventually(lambda: None not in sees())
    here, there = sees()
    assert here is not None
    assert there is not None
    assert here < 0.3 < 0.7 < there
    stated = Rigid.from_matrix(np.array(session.document.photos[1].stated_pose))
    assert stated.distance_to(camera @ BETWEEN.inverse) < 0.01
    assert bench.slice("project")["undo"] == "State a pose", "nobody has to undo what nobody did"
    # What the operator chooses stays chosen.
    bench.do("set_station", photo=second, station="")
    bench.do("show_photo", photo="p1")
    bench.do("show_photo", photo=second)
    bench.eventually(lambda: None not in sees())
    assert bench.slice("partner")["station"] == ""
    restarted = bench.workbench.session.folder.path
    bench.workbench.close()
    again = open_bench(restarted)
    assert [photo.station_given for photo in again.workbench.session.document.photos] == [False, True]
    bench.workbench = again.workbench


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
