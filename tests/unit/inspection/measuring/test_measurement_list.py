"""Lists of measurements as files, read back by other means."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.formats.documents.places_file import read_places
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.measuring.measurement_list import NamedMeasurement, measure_places
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation

WORLD = Rigid.from_rotvec((0.0, 0.0, 1.2), (500_000.0, 5_400_000.0, 300.0))
PLACES = """\ufeffMeasurement,kind,row,column,x,y,z
side,distance,20,30,,,
side,,20,90,,,
=roof,area,20,30,,,
=roof,,20,90,,,
=roof,,60,90,,,
=roof,,60,30,,,
hole,distance,0,0,,,
hole,,20,90,,,
mark,point,,,3,-1,.5
mark,,,,3,1,.5
"""


def wall() -> Scan:
    geometry = AzimuthElevation(80, 120, 0.01, 0.01)
    ranges = 3.0 / geometry.rays[..., 0]
    ranges[:4, :4] = np.nan
    return Scan(geometry, ranges, np.ones(ranges.shape))


def entries(tmp_path: Path, *, world: bool = False) -> list[NamedMeasurement]:
    file = tmp_path / "points.csv"
    file.write_text(PLACES, encoding="utf-8")
    return measure_places(wall(), {}, read_places(file), world_from_scanner=WORLD if world else None)


def test_measurements_of_a_list_are_made_or_refused_one_by_one(tmp_path: Path) -> None:
    found = {one.name: one for one in entries(tmp_path)}
    assert list(found) == ["side", "=roof", "hole", "mark 1", "mark 2"]
    rays = wall().geometry.ray_at(np.array([[20.0, 30], [20, 90]]))
    points = rays * (3.0 / rays[:, :1])
    side = found["side"].measurement
    assert side is not None
    assert side.value == pytest.approx(np.linalg.norm(points[0] - points[1]), abs=1e-4)
    assert found["hole"].measurement is None
    assert "no return" in found["hole"].refusal
    mark = found["mark 2"].measurement
    assert mark is not None
    np.testing.assert_allclose(mark.value, [3, 1, 0.5])


def test_a_table_is_read_back(tmp_path: Path) -> None:
    found = entries(tmp_path)
    lr.write_measurements(tmp_path / "out.csv", found)
    with open(tmp_path / "out.csv", encoding="utf-8", newline="") as stream:
        rows = {row["name"]: row for row in csv.DictReader(stream)}
    side = found[0].measurement
    assert side is not None
    assert float(rows["side"]["value"]) == pytest.approx(side.value, abs=1e-6)
    assert float(rows["side"]["sigma"]) == pytest.approx(side.sigma, abs=1e-6)
    assert "'=roof" in rows, "a spreadsheet would take the name for a formula"
    assert rows["hole"]["value"] == ""
    assert rows["hole"]["flags"].startswith("refused")
    assert [float(word) for word in rows["mark 1"]["value"].split()] == [3, -1, 0.5]


def test_geojson_has_a_reference_system_only_if_one_is_stated(tmp_path: Path) -> None:
    found = entries(tmp_path, world=True)
    lr.write_measurements(tmp_path / "a.geojson", found, frame="world")
    lr.write_measurements(tmp_path / "b.geojson", found, frame="world", crs="EPSG:25832")
    a, b = (json.loads((tmp_path / name).read_text()) for name in ("a.geojson", "b.geojson"))
    assert "crs" not in a
    assert b["crs"]["properties"]["name"] == "urn:ogc:def:crs:EPSG::25832"
    kinds = {one["properties"]["name"]: one["geometry"] for one in b["features"]}
    assert kinds["hole"] is None
    ring = np.array(kinds["=roof"]["coordinates"][0])
    assert kinds["=roof"]["type"] == "Polygon"
    assert (ring[0] == ring[-1]).all()
    x, y = ring[:, 0] - ring[0, 0], ring[:, 1] - ring[0, 1]  # the wall stands: its outline from above has no area
    assert abs(np.dot(x[:-1], y[1:]) - np.dot(y[:-1], x[1:])) < 1e-3
    assert kinds["side"]["coordinates"][0][1] > 5e6
    with pytest.raises(lr.LadarregError, match="world"):
        lr.write_measurements(tmp_path / "c.geojson", found, crs="EPSG:25832")
    with pytest.raises(lr.LadarregError, match="EPSG:25832"):
        lr.write_measurements(tmp_path / "c.geojson", found, frame="world", crs="somewhere")
    assert not (tmp_path / "c.geojson").exists()


def tags_of(path: Path) -> list[tuple[int, str]]:
    """Read a DXF as its specification says: pairs of lines, a number and a value."""
    lines = path.read_text(encoding="ascii").split("\n")[:-1]
    assert len(lines) % 2 == 0
    return [(int(code), value) for code, value in zip(lines[::2], lines[1::2], strict=True)]


def test_a_drawing_has_the_points_on_layers_by_kind(tmp_path: Path) -> None:
    found = entries(tmp_path, world=True)
    lr.write_measurements(tmp_path / "out.dxf", found, frame="world")
    tags = tags_of(tmp_path / "out.dxf")
    assert (1, "AC1009") in tags
    assert tags[-1] == (0, "EOF")
    starts = [k for k, (code, _) in enumerate(tags) if code == 0]
    entities = [dict(tags[a:b]) | {0: tags[a][1]} for a, b in zip(starts, [*starts[1:], len(tags)], strict=True)]
    drawn = [one for one in entities if 8 in one]
    side = found[0].measurement
    assert side is not None
    vertices = [one for one in drawn if one[0] == "VERTEX" and one[8] == "DISTANCE"]
    at = np.array([[float(one[code]) for code in (10, 20, 30)] for one in vertices])
    np.testing.assert_allclose(at, side.points.xyz, atol=1e-6)
    (roof,) = (one for one in drawn if one[0] == "POLYLINE" and one[8] == "AREA")
    assert int(roof[70]) == 9  # three-dimensional and closed
    assert sum(one[0] == "POINT" for one in drawn) == 2
    layers = {one[2] for one in entities if one[0] == "LAYER"}
    assert {one[8] for one in drawn} <= layers


def test_an_existing_file_is_never_replaced_and_other_formats_are_refused(tmp_path: Path) -> None:
    found = entries(tmp_path)
    (tmp_path / "mine.csv").write_text("mine")
    with pytest.raises(lr.LadarregError, match="exists"):
        lr.write_measurements(tmp_path / "mine.csv", found)
    assert (tmp_path / "mine.csv").read_text() == "mine"
    with pytest.raises(lr.LadarregError, match=r"\.csv, \.json, \.geojson, \.dxf"):
        lr.write_measurements(tmp_path / "out.xlsx", found)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("u,v\n1,x\n", "line 2 has the v 'x'"),
        ("u,v\n1,nan\n", "finite"),
        ("u,v\n", "no points"),
        ("u\n1\n", "must name u,v"),
        ("u,v,w\n1,2,3\n", "must name u,v"),
        ("u,v,row,column\n1,2,3,4\n", "gives 2 places"),
        ("u,v,row,column\n,,,\n1,,,4\n", "gives 2 places"),
        ("u,v\n1,2,3\n", "has 3 cells"),
        ("", "empty"),
    ],
)
def test_damaged_lists_of_points_are_refused_in_a_sentence(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "points.csv"
    file.write_text(text)
    with pytest.raises(lr.LadarregError, match=words):
        read_places(file)


def test_what_is_measured_has_to_be_stated_once(tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text("row,column\n20,30\n20,90\n")
    places = read_places(file)
    (found,) = measure_places(wall(), {}, places, kind="distance")
    assert found.measurement is not None
    with pytest.raises(lr.LadarregError, match="not stated"):
        measure_places(wall(), {}, places)
    file.write_text("measurement,kind,row,column\na,distance,20,30\na,angle,20,90\n")
    with pytest.raises(lr.LadarregError, match="both angle and distance"):
        measure_places(wall(), {}, read_places(file))
    file.write_text("u,v,photo\n20,30,x.jpg\n")
    with pytest.raises(lr.LadarregError, match=r"no photograph 'x.jpg'"):
        measure_places(wall(), {}, read_places(file), kind="point")
