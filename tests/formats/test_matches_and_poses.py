"""Matches and poses: files are read back as written; invalid fields are named in errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.formats import describe
from ladarreg_core.formats.documents.matches_file import read_matches, write_matches, write_matches_csv
from ladarreg_core.formats.documents.pose_file import read_pose, write_pose
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Pick
from ladarreg_core.scan import Scan

coordinate = st.floats(-5000, 5000)
ray = st.tuples(st.floats(0.1, 1), st.floats(-1, 1), st.floats(-1, 1))


@st.composite
def picks(draw: st.DrawFn) -> list[Pick]:
    result = []
    for index in range(draw(st.integers(1, 6))):
        ends = draw(st.integers(1, 2))
        result.append(
            Pick(
                f"{draw(st.text(max_size=3))}{index}",
                "point" if ends == 1 else "line",
                np.array([draw(ray) for _ in range(ends)]),
                np.array([draw(st.tuples(coordinate, coordinate)) for _ in range(ends)]),
                on=draw(st.booleans()),
                weight=draw(st.floats(1e-3, 1e3)),
            )
        )
    return result


@pytest.mark.slow
@given(picks())
def test_matches_are_read_back(tmp_path_factory: pytest.TempPathFactory, wall: Scan, written: list[Pick]) -> None:
    path = tmp_path_factory.mktemp("matches") / "m.json"
    write_matches(path, written)
    for before, after in zip(written, read_matches(path, wall), strict=True):
        assert (before.id, before.kind, before.on, before.weight) == (after.id, after.kind, after.on, after.weight)
        np.testing.assert_allclose(after.scan, before.scan, atol=1e-15)
        np.testing.assert_array_equal(after.photo, before.photo)


@given(st.lists(st.tuples(ray, coordinate, coordinate), min_size=1, max_size=5))
def test_csv_of_rays_is_read_back(tmp_path_factory: pytest.TempPathFactory, wall: Scan, rows: list[Any]) -> None:
    path = tmp_path_factory.mktemp("matches") / "m.csv"
    written = [Pick(str(k), "point", np.array([r]), np.array([[u, v]])) for k, (r, u, v) in enumerate(rows)]
    write_matches_csv(path, written)
    read = read_matches(path, wall)
    np.testing.assert_array_equal([p.photo[0] for p in read], [p.photo[0] for p in written])
    np.testing.assert_allclose([p.scan[0] for p in read], [p.scan[0] for p in written], atol=1e-12)


def test_cells_become_the_scans_rays(tmp_path: Path, wall: Scan) -> None:
    (tmp_path / "m.csv").write_text("\ufeffRow, column ,u,v\r\n0,0,1.5,2\n\n3.25,7.5,-4,1e3\n")
    read = read_matches(tmp_path / "m.csv", wall)
    np.testing.assert_allclose(read[1].scan[0], wall.geometry.ray_at(np.array([3.25, 7.5])))
    entries = [{"id": 7, "kind": "line", "scan": [[0, 0], [5, 6]], "photo": [[1, 2], [3, 4]]},
               {"scan": [3.25, 7.5], "photo": [-4, 1000]}]  # fmt: skip
    (tmp_path / "m.json").write_text(json.dumps({"version": 1, "scan_coordinates": "cell", "matches": entries}))
    line, point = read_matches(tmp_path / "m.json", wall)
    np.testing.assert_allclose(line.scan[1], wall.rays[5, 6])
    np.testing.assert_array_equal(point.scan, read[1].scan)
    assert (line.id, point.id, point.kind, point.on, point.weight) == ("7", "2", "point", True, 1.0)
    assert describe(tmp_path / "m.json").matches == "1 points, 1 lines in cell coordinates"
    assert describe(tmp_path / "m.csv").kind == "matches"


GOOD = {"id": "a", "kind": "point", "scan": [[1, 0, 0]], "photo": [[3, 4]]}


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"version": 3}, "version 3"),
        ({"scan_coordinates": "pixel"}, "scan_coordinates"),
        ({"scan_coordinates": None}, "scan_coordinates"),
        ({"matches": None}, "'matches'"),
        ({"matches": []}, "no matches"),
        ({"matches": [GOOD, GOOD]}, "two matches"),
        ({"matches": ["a"]}, "match 1"),
        ({"matches": [GOOD | {"kind": "circle"}]}, "kind"),
        ({"matches": [GOOD | {"kind": "line"}]}, "2 x 3"),
        ({"matches": [GOOD | {"scan": [[1, 0]]}]}, "1 x 3"),
        ({"matches": [GOOD | {"scan": [[0, 0, 0]]}]}, "length zero"),
        ({"matches": [GOOD | {"photo": [[3]]}]}, "photo side"),
        ({"matches": [GOOD | {"photo": [[3, "4"]]}]}, "finite"),
        ({"matches": [GOOD | {"photo": None}]}, "photo side"),
        ({"matches": [GOOD | {"on": 1}]}, "'on'"),
        ({"matches": [GOOD | {"weight": 0}]}, "weight"),
        ({"matches": [GOOD | {"id": [1]}]}, "id"),
        ({"scan_coordinates": "cell", "matches": [GOOD | {"scan": [[500, 2]]}]}, "24 x 36"),
        ({"scan_coordinates": "cell", "matches": [GOOD | {"scan": [[-1, 2]]}]}, "24 x 36"),
    ],
)
def test_bad_matches_are_one_clear_error(tmp_path: Path, wall: Scan, change: dict[str, Any], word: str) -> None:
    fields = {"version": 1, "scan_coordinates": "ray", "matches": [GOOD]} | change
    (tmp_path / "m.json").write_text(json.dumps({k: v for k, v in fields.items() if v is not None}))
    with pytest.raises(LadarregError) as caught:
        read_matches(tmp_path / "m.json", wall)
    assert word in str(caught.value), str(caught.value)


BAD_CSV = (
    "a,b\n1,2\n",
    "x,y,z,u,v\n1,0,0,1\n",
    "x,y,z,u,v\n1,0,0,1,nan\n",
    "row,column,u,v\n",
    "row,column,u,v\n99,0,1,1\n",
    "x,y,z,u,v\n1,0,0,a,2\n",
    "\x00\x01",
    "x,y,z,u,v\n\0",
)


@pytest.mark.parametrize("text", BAD_CSV)
def test_bad_csv_is_one_clear_error(tmp_path: Path, wall: Scan, text: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(FormatError):
        read_matches(tmp_path / "m.csv", wall)


@given(st.tuples(*[st.floats(-2, 2)] * 3), st.tuples(*[st.floats(-1e3, 1e3)] * 3))
def test_poses_are_read_back(tmp_path_factory: pytest.TempPathFactory, w: Any, t: Any) -> None:
    path = tmp_path_factory.mktemp("pose") / "p.json"
    write_pose(path, Rigid.from_rotvec(w, t))
    np.testing.assert_allclose(read_pose(path).matrix, Rigid.from_rotvec(w, t).matrix, atol=1e-13)
    assert describe(path).kind == "pose"


@pytest.mark.parametrize(
    ("value", "word"),
    [
        (None, "missing"),
        ([[1, 0, 0, 0]] * 3, "4 rows"),
        (np.eye(4).ravel().tolist(), "4 rows"),
        ((np.eye(4) * 2).tolist(), "rigid"),
        (np.diag([1, 1, -1, 1]).tolist(), "reflection"),
        ([*np.eye(4)[:3].tolist(), [0, 0, 1, 1]], "last row"),
        ([[1e400, 0, 0, 0], *np.eye(4)[1:].tolist()], "Infinity"),
        ([["1", 0, 0, 0], *np.eye(4)[1:].tolist()], "finite"),
    ],
)
def test_bad_poses_are_one_clear_error(tmp_path: Path, value: Any, word: str) -> None:
    (tmp_path / "p.json").write_text(json.dumps({} if value is None else {"camera_from_scanner": value}))
    with pytest.raises(FormatError) as caught:
        read_pose(tmp_path / "p.json")
    assert word in str(caught.value), str(caught.value)
