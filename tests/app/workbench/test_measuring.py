"""Measurements at the workbench: kept as they were picked, valued by scan and pose as they are."""

from __future__ import annotations

import csv
import io
import json
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ladarreg.cli import main

import ladarreg_core as lr
from ladarreg_core.project.measurement_edits import MAX_MEASUREMENTS
from testing.workbench.workbench_driver import WorkbenchDriver, sample_bench


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    """A workbench with a registered photograph."""
    found = sample_bench(tmp_path_factory.mktemp("measured") / "project")
    assert found.job("auto").state == "done"
    yield found
    found.workbench.close()


@pytest.fixture
def bench(shared: WorkbenchDriver) -> Iterator[WorkbenchDriver]:
    """The same without measurements."""
    yield shared
    if left := [one["id"] for one in shared.slice("measurements")]:
        shared.do("remove_measurements", measurements=left)


def measured_of(bench: WorkbenchDriver, measurement: str) -> dict[str, Any]:
    """Return an item of the slice `measured` once it is there."""
    return bench.eventually(lambda: next((one for one in bench.slice("measured") if one["id"] == measurement), None))


def surface_rays(bench: WorkbenchDriver, *cells: tuple[int, int]) -> list[dict[str, Any]]:
    scan = bench.workbench.loader.scan(bench.workbench.session.document)
    assert scan is not None
    return [{"ray": scan.geometry.ray_at(np.array([cell], float))[0].tolist()} for cell in cells]


def smooth_cells(bench: WorkbenchDriver, count: int) -> list[tuple[int, int]]:
    """Return cells far from depth edges."""
    scan = bench.workbench.loader.scan(bench.workbench.session.document)
    assert scan is not None
    found = []
    rows, columns = scan.shape
    for row in range(rows // 5, rows, rows // 5):
        for column in range(columns // 7, columns, columns // 7):
            points = lr.MeasuredPoints.of_scan(scan, cells=[[row, column]])
            if not points.refusals[0] and not points.flags[0]:
                found.append((row, column))
    assert len(found) >= count
    return found[:: len(found) // count][:count]


def no_return(bench: WorkbenchDriver) -> list[dict[str, Any]]:
    scan = bench.workbench.loader.scan(bench.workbench.session.document)
    assert scan is not None
    rows, columns = np.nonzero(~scan.valid)
    points = lr.MeasuredPoints.of_scan(scan, cells=np.stack([rows, columns], axis=1)[::97])
    chosen = next(k for k, why in enumerate(points.refusals) if "no return" in why)
    return surface_rays(bench, (int(rows[::97][chosen]), int(columns[::97][chosen])))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "count"), [("point", 1), ("distance", 2), ("polyline", 4), ("angle", 3), ("area", 3), ("height", 4)]
)
def test_every_kind_is_measured_as_by_the_library(bench: WorkbenchDriver, kind: Any, count: int) -> None:
    cells = smooth_cells(bench, count)
    places = surface_rays(bench, *cells)
    reply = bench.do("measure", kind=kind, places=places)
    made = bench.do("add_measurement", kind=kind, places=places)["measurement"]
    scan = bench.workbench.loader.scan(bench.workbench.session.document)
    assert scan is not None
    wanted = lr.measure(kind, lr.MeasuredPoints.of_scan(scan, cells=cells))
    value = wanted.described.replace("+-", "±").replace("m2", "m²").replace(" deg", "°")
    assert reply["value"] == value
    item = measured_of(bench, made)
    assert (item["value"], item["interval"], item["refusal"]) == (value, reply["interval"], "")
    assert len(item["drawn"]["ends"]) == count
    assert bench.slice("measurements")[-1]["name"].startswith(kind.capitalize())


@pytest.mark.slow
def test_points_in_both_pictures_are_drawn_in_both(bench: WorkbenchDriver) -> None:
    cell = smooth_cells(bench, 9)
    entry = bench.workbench.session.document.photos[0]
    assert entry.pose is not None
    registration = bench.workbench.loader.registration(entry.pose)
    scan = bench.workbench.loader.scan(bench.workbench.session.document)
    assert scan is not None
    xyz = lr.MeasuredPoints.of_scan(scan, cells=cell).xyz
    uv = registration.camera.project(registration.camera_from_scanner @ xyz)
    seen = [k for k, at in enumerate(uv) if bool(registration.camera.contains(at))]
    points = lr.MeasuredPoints.of_photo(scan, registration, uv[seen])
    same = [k for k, at in zip(seen, points.xyz, strict=True) if np.linalg.norm(at - xyz[k]) < 0.05]
    first, second = same[0], same[-1]
    assert first != second
    places = [{"photo": "p1", "uv": uv[first].tolist()}, *surface_rays(bench, cell[second])]
    made = bench.do("add_measurement", kind="distance", places=places)["measurement"]
    item = measured_of(bench, made)
    assert float(item["value"].split()[0]) == pytest.approx(np.linalg.norm(xyz[first] - xyz[second]), abs=0.05)
    drawn = bench.eventually(lambda: measured_of(bench, made)["in_photo"].get("p1"))
    np.testing.assert_allclose(drawn["ends"][0], uv[first], atol=0.1)
    np.testing.assert_allclose(drawn["ends"][1], uv[second], atol=0.1)
    (line,) = drawn["lines"]
    np.testing.assert_allclose(line[0], uv[first], atol=0.1)
    rays = np.array(item["drawn"]["ends"])
    np.testing.assert_allclose(rays[1], xyz[second] / np.linalg.norm(xyz[second]), atol=1e-5)


@pytest.mark.slow
def test_what_lies_on_no_surface_is_refused_in_one_sentence(bench: WorkbenchDriver) -> None:
    hole = no_return(bench)
    reply = bench.do("measure", kind="point", places=hole)
    assert reply["refusal"] == "The point has no return: pick on a surface that the scan measured."
    good = surface_rays(bench, *smooth_cells(bench, 1))
    said = bench.refused("add_measurement", kind="distance", places=[*good, *hole])
    assert said == "Point 2 has no return: pick on a surface that the scan measured."
    said = bench.refused("add_measurement", kind="distance", places=[{"photo": "p1", "uv": [-50, 20]}, *good])
    assert "outside the photograph" in said
    assert "give two" in bench.refused("add_measurement", kind="distance", places=good)
    assert bench.slice("measurements") == []


@pytest.mark.parametrize(
    ("places", "said"),
    [
        ([], "the points are a list"),
        ([{}], "a ray [x, y, z]"),
        ([{"ray": [0, 0, 0]}], "zero length"),
        ([{"ray": [1, 0]}], "3 finite numbers"),
        ([{"photo": "p1", "uv": [1, 2, 3]}], "2 finite numbers"),
        ([{"photo": "p1"}], "a photo and its pixel"),
        ([{"photo": "p9", "uv": [1, 2]}], "no longer in the project"),
        ([{"photo": 3, "uv": [1, 2]}], "a photo and its pixel"),
        ([{"ray": [1e308, 1e308, 0]}], "no return"),
        ([{"ray": [1, 0, 0], "sigma_rad": -1}], "the standard deviation of a pick is -1; it is 0 to 0.2 rad"),
        ([{"ray": [1, 0, 0], "sigma_rad": "wide"}], "the standard deviation of a pick is 'wide'"),
        ([{"photo": "p1", "uv": [1, 2], "sigma_px": 1e9}], "it is 0 to 1000 px"),
    ],
)
def test_bad_points_are_refused(bench: WorkbenchDriver, places: Any, said: str) -> None:
    reply = bench.ask("add_measurement", kind="point", places=places)
    if reply["ok"]:  # a ray of any length is a direction
        assert said == "no return"
        return
    assert said in reply["error"].lower() or "outside" in reply["error"] or "depth edge" in reply["error"]


def test_what_was_picked_in_a_small_picture_is_less_certain(bench: WorkbenchDriver) -> None:
    cells = smooth_cells(bench, 2)
    fine = surface_rays(bench, *cells)
    coarse = [place | {"sigma_rad": 0.004} for place in fine]
    sigmas = [
        float(bench.do("measure", kind="distance", places=places)["value"].split(" ± ")[1].split()[0])
        for places in (fine, [fine[0], coarse[1]], coarse, [place | {"sigma_rad": 1e-9} for place in fine])
    ]
    assert sigmas[0] < sigmas[1] < sigmas[2]
    assert sigmas[3] == sigmas[0], "half a cell is the least"
    made = bench.do("add_measurement", kind="distance", places=coarse)["measurement"]
    kept = next(one for one in bench.slice("measurements") if one["id"] == made)
    assert [place["sigma_rad"] for place in kept["places"]] == [0.004, 0.004]
    scan = bench.workbench.loader.scan(bench.workbench.session.document)
    assert scan is not None
    wanted = lr.measure("distance", lr.MeasuredPoints.of_scan(scan, cells=cells, sigma_rad=0.004))
    assert measured_of(bench, made)["value"] == wanted.described.replace("+-", "±")


def test_each_is_a_step_that_is_undone_and_redone(bench: WorkbenchDriver) -> None:
    places = surface_rays(bench, *smooth_cells(bench, 2))
    made = bench.do("add_measurement", kind="distance", places=places)["measurement"]
    assert bench.slice("project")["undo"] == "Measure a distance"
    bench.do("rename_measurement", measurement=made, name="  Beam\n over the door ")
    assert [one["name"] for one in bench.slice("measurements")] == ["Beam over the door"]
    bench.do("undo")
    assert [one["name"] for one in bench.slice("measurements")] != ["Beam over the door"]
    bench.do("undo")
    assert bench.slice("measurements") == []
    bench.do("redo")
    assert [one["id"] for one in bench.slice("measurements")] == [made]
    bench.do("remove_measurements", measurements=[made])
    assert bench.slice("measurements") == []
    assert "removed" in bench.refused("rename_measurement", measurement=made, name="x")
    bench.do("undo")
    assert measured_of(bench, made)["value"]


@pytest.mark.slow
def test_measurements_follow_the_pose(bench: WorkbenchDriver) -> None:
    entry = bench.workbench.session.document.photos[0]
    width, height = bench.slice("photos")[0]["width"], bench.slice("photos")[0]["height"]
    candidates = ({"photo": "p1", "uv": [width * x, height * y]} for x in (0.3, 0.5, 0.7) for y in (0.5, 0.7))
    sound = (one for one in candidates if not bench.do("measure", kind="point", places=[one])["refusal"])
    places = [next(sound), next(sound)]
    made = bench.do("add_measurement", kind="distance", places=places)["measurement"]
    before = measured_of(bench, made)["value"]
    bench.do("set_camera", photo="p1", focal_px=700)
    refused = bench.eventually(lambda: measured_of(bench, made)["refusal"])
    assert "no accepted pose" in refused
    bench.do("undo")
    assert bench.eventually(lambda: measured_of(bench, made)["value"]) == before
    assert bench.workbench.session.document.photos[0].pose == entry.pose
    pick = {"kind": "point", "scan": [[1, 0, 0]], "photo_uv": [[300, 200]]}
    bench.do("add_pick", photo="p1", **pick)
    bench.do("undo")


def test_they_are_saved_with_the_project(bench: WorkbenchDriver) -> None:
    places = surface_rays(bench, *smooth_cells(bench, 2))
    made = bench.do("add_measurement", kind="distance", places=places)["measurement"]
    folder = bench.workbench.session.folder.path

    def kept() -> list[dict[str, Any]]:
        found = json.loads((folder / "project.json").read_bytes())["measurements"]
        return found if [one["id"] for one in found] == [made] else []

    (entry,) = bench.eventually(kept)
    assert [one["at"] for one in entry["places"]] == [pytest.approx(one["ray"], abs=1e-12) for one in places]


def test_two_people_undo_their_own(bench: WorkbenchDriver) -> None:
    from ladarreg.gateway.protocol import Visitor

    other = WorkbenchDriver(
        bench.workbench, bench.workbench.join(Visitor("127.0.0.1", tab="b" * 32, page="2", name="Ann"))
    )
    try:
        cells = smooth_cells(bench, 3)
        mine = bench.do("add_measurement", kind="distance", places=surface_rays(bench, *cells[:2]))["measurement"]
        theirs = other.do("add_measurement", kind="distance", places=surface_rays(bench, *cells[1:]))["measurement"]
        bench.do("undo")
        assert [one["id"] for one in bench.slice("measurements")] == [theirs]
        bench.do("redo")
        assert [one["id"] for one in bench.slice("measurements")] == [mine, theirs]
        other.do("rename_measurement", measurement=mine, name="Beam")
        assert "Ann changed the measurement" in bench.refused("undo")
    finally:
        bench.workbench.leave(other.client)


def test_the_list_is_exported_from_page_and_command(
    bench: WorkbenchDriver, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "Nothing was measured" in bench.refused("export", targets=["measurements"], photos=[])
    places = surface_rays(bench, *smooth_cells(bench, 2))
    made = bench.do("add_measurement", kind="distance", places=places)["measurement"]
    bench.do("rename_measurement", measurement=made, name="Beam")
    value = measured_of(bench, made)["value"]
    bench.do("export", targets=["measurements"], photos=[])
    bench.workbench.runner.wait(60)
    path, _ = bench.workbench.export_file("all") or (tmp_path, "")
    with zipfile.ZipFile(path) as packed:
        names = {name for name in packed.namelist() if name.startswith("measurements")}
        rows = list(csv.DictReader(io.StringIO(packed.read("measurements.csv").decode())))
    assert names == {f"measurements{suffix}" for suffix in (".csv", ".json", ".geojson", ".dxf")}
    assert [row["name"] for row in rows] == ["Beam"]
    assert f"{float(rows[0]['value']):.4f}"[:5] == value[:5]
    table = bench.do("export_targets", photos=[])
    assert {one["name"]: one["refusal"] for one in table["targets"]}["measurements"] is None
    copy = tmp_path / "copy"
    shutil.copytree(bench.workbench.session.folder.path, copy, ignore=shutil.ignore_patterns("lock"))
    assert main(["export", str(copy), "--to", "measurements", "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "measurements.csv").read_text().splitlines()[1].startswith("Beam,distance,")
    assert "Wrote    measurements" in capsys.readouterr().out


def test_there_is_a_limit(bench: WorkbenchDriver) -> None:
    from ladarreg_core.project.measurement_edits import place, with_measurement

    document = bench.workbench.session.document
    for _ in range(MAX_MEASUREMENTS):
        document, _ = with_measurement(document, "point", [place([1, 0, 0])])
    with pytest.raises(lr.LadarregError, match="maximum"):
        with_measurement(document, "point", [place([1, 0, 0])])
