"""Version 2 of matches files: points with lengths, frames and names, and CSV that tells rays from points."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.errors import ExportError, LadarregError
from ladarreg_core.formats import describe, recognise
from ladarreg_core.formats.documents.matches_file import read_matches, write_matches, write_matches_csv
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Pick
from ladarreg_core.scan import Scan

TURNED = Rigid.from_rotvec([0, 0, np.pi / 2], (1e6, 2e6, 50.0))
"""A scanner whose X axis points along the world's Y."""


def save(path: Path, **fields: Any) -> Path:
    path.write_text(json.dumps({"version": 2, "scan_coordinates": "point"} | fields), encoding="utf-8")
    return path


def test_points_become_rays_and_lengths_in_either_frame(tmp_path: Path, wall: Scan) -> None:
    entries = [
        {"id": "a", "name": "T 1", "scan": [3.0, 0, 4], "photo": [1, 2]},
        {"id": "b", "kind": "line", "scan": [[2, 0, 0], [0, 0, 7]], "photo": [[1, 2], [3, 4]], "weight": 2},
        {"id": "c", "scan_coordinates": "ray", "scan": [0, 0, 2], "photo": [1, 2]},
        {"id": "d", "scan_coordinates": "cell", "scan": [5, 6], "photo": [1, 2]},
    ]
    path = save(tmp_path / "m.json", frame="scanner", matches=entries)
    point, line, ray, cell = read_matches(path, wall)
    np.testing.assert_allclose(point.scan, [[0.6, 0, 0.8]], atol=1e-15)
    assert point.lengths_m is not None
    assert line.lengths_m is not None
    np.testing.assert_allclose(point.lengths_m, [5])
    np.testing.assert_allclose(line.lengths_m, [2, 7])
    assert (point.name, line.name, ray.lengths_m, cell.lengths_m) == ("T 1", "", None, None)
    np.testing.assert_array_equal(ray.scan, [[0, 0, 1]])
    np.testing.assert_allclose(cell.scan[0], wall.rays[5, 6])
    assert describe(path).matches == "3 points, 1 lines in scanner point coordinates"

    # by hand: 3 m ahead of the scanner is 3 m along the world's Y, 4 m above it
    there = [{"name": "T 1", "scan": [1e6, 2e6 + 3, 54.0], "photo": [1, 2]}]
    (pick,) = read_matches(
        save(tmp_path / "w.json", frame="world", matches=there), replace(wall, world_from_scanner=TURNED)
    )
    np.testing.assert_allclose(pick.scan, [[0.6, 0, 0.8]], atol=1e-12)
    assert pick.lengths_m is not None
    np.testing.assert_allclose(pick.lengths_m, [5], atol=1e-12)


GOOD = {"id": "a", "scan": [[1, 0, 0]], "photo": [[3, 4]]}


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"version": 1}, "scan_coordinates"),
        ({"version": True}, "versions 1 and 2"),
        ({"frame": "camera"}, "frame"),
        ({"frame": "world"}, "E57, PTX, NPZ"),
        ({"matches": [GOOD | {"scan": [0, 0, 0]}]}, "at the scanner itself"),
        ({"matches": [GOOD | {"scan": [5e5, 5e6, 0], "name": "T9"}]}, "'T9' is 5,024,938 m from the scanner"),
        ({"matches": [GOOD | {"name": ["a"]}]}, "name"),
        ({"matches": [GOOD | {"scan_coordinates": "pixel"}]}, "scan_coordinates"),
    ],
)
def test_what_is_wrong_is_one_clear_error(tmp_path: Path, wall: Scan, change: dict[str, Any], word: str) -> None:
    path = save(tmp_path / "m.json", **({"matches": [GOOD]} | change))
    with pytest.raises(LadarregError, match=word):
        read_matches(path, wall)


def test_a_csv_is_of_rays_only_if_all_lengths_are_1(tmp_path: Path, wall: Scan) -> None:
    path = tmp_path / "m.csv"

    def lengths(text: str) -> list[Any]:
        path.write_text(text, encoding="utf-8")
        assert recognise(path).kind == "matches"
        return [None if p.lengths_m is None else float(p.lengths_m[0]) for p in read_matches(path, wall)]

    assert lengths("x,y,z,u,v\n1,0,0,1,2\n0.6,0,0.8,1,2\n") == [None, None]
    assert lengths("x,y,z,u,v\n1,0,0,1,2\n0.6,0,0.80001,1,2\n") == pytest.approx([1.0, 1.000008], abs=1e-9)
    assert lengths("x,y,z,u,v\n3,0,4,1,2\n") == [5.0]
    assert lengths("frame,x,y,z,u,v\nscanner,1,0,0,1,2\n") == [1.0]  # a point at 1 m, which only the frame can say
    assert lengths('u,v,Name,x,y,z\n1,2,"T 1, left",3,0,4\n') == [5.0]
    assert read_matches(path, wall)[0].name == "T 1, left"
    assert lengths("name,row,column,u,v\nT1,5,6,1,2\n") == [None]
    for bad in ("frame,x,y,z,u,v\nmoon,1,0,0,1,2\n", "x,x,z,u,v\n1,0,0,1,2\n", "name,x,y,z,u,v\nT,1,0,0,1\n"):
        path.write_text(bad, encoding="utf-8")
        with pytest.raises(LadarregError):
            read_matches(path, wall)


def test_mixtures_are_kept_in_json_and_refused_in_csv(tmp_path: Path, wall: Scan) -> None:
    uv = np.array([[1.0, 2.0]])
    ray = Pick("a", "point", np.array([[0.6, 0, 0.8]]), uv)
    point = Pick("b", "point", np.array([[0.6, 0, 0.8]]), uv, lengths_m=np.array([1.0]), name="T1")
    write_matches(tmp_path / "m.json", [ray, point])
    a, b = read_matches(tmp_path / "m.json", wall)
    assert a.lengths_m is None
    assert b.lengths_m is not None
    assert (b.lengths_m[0], b.name) == (pytest.approx(1.0), "T1")
    with pytest.raises(ExportError, match="cannot mix"):
        write_matches_csv(tmp_path / "m.csv", [ray, point])
    write_matches_csv(tmp_path / "p.csv", [point])
    (again,) = read_matches(tmp_path / "p.csv", wall)
    assert again.lengths_m is not None  # although its length is 1
    assert again.name == "T1"
    write_matches(tmp_path / "old.json", [ray])
    assert json.loads((tmp_path / "old.json").read_text(encoding="utf-8"))["version"] == 1
