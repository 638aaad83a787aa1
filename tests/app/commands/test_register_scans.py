"""`ladarreg register-scans`: scans in, scans with poses out."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ladarreg.cli import main

import ladarreg_core as lr
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.simulate.stations import scan_stations, station_room, upright_pose
from ladarreg_core.storage.manifest import visible_files

pytest.importorskip("embreex")
POSES = (upright_pose([-1.0, 0.2, 0.0], 0.4), upright_pose([0.9, -0.6, 0.1], 2.0))


def at_office(document: dict[str, Any], value: Any) -> dict[str, Any]:
    """Return the contents of a `stations.json` with another pose for its second station."""
    document["stations"][1]["world_from_scanner"] = value(document["stations"][1]["world_from_scanner"])
    return document


DAMAGE: tuple[tuple[str, Callable[[dict[str, Any]], Any], str], ...] = (
    ("cut", lambda d: json.dumps(d)[:900], "JSON"),
    ("nan", lambda d: at_office(d, lambda m: [[float("nan"), *m[0][1:]], *m[1:]]), "NaN"),
    ("millimetres", lambda d: at_office(d, lambda m: [[*row[:3], 1000 * row[3]] for row in m[:3]] + m[3:]), "another"),
    ("sheared", lambda d: at_office(d, lambda m: [[2 * value for value in m[0]], *m[1:]]), "pose of office.npz"),
    ("words", lambda d: at_office(d, lambda m: "here"), "pose of office.npz"),
    ("ragged", lambda d: at_office(d, lambda m: m[:3]), "pose of office.npz"),
    ("later", lambda d: {**d, "version": 2}, "version 2"),
    ("true", lambda d: {**d, "version": True}, "version True"),
    ("bare", lambda d: {**d, "stations": [1, 2]}, "no object"),
    ("outside", lambda d: {**d, "stations": [{**d["stations"][0], "scan": "../hall.npz"}]}, "outside its folder"),
    ("twice", lambda d: {**d, "stations": [d["stations"][0]] * 2}, "of its own"),
    ("nobody", lambda d: {**d, "stations": []}, "no scans"),
    ("missing", lambda d: d, "hall.npz is missing"),
)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("scans")
    scans = scan_stations(station_room("desk", 2), POSES, seed=5, step_deg=1.0)
    other = scan_stations(station_room("boxes", 8), POSES[:1], seed=6, step_deg=1.0)
    paths = [folder / name for name in ("hall.npz", "office.npz", "elsewhere.npz")]
    for path, scan in zip(paths, [*scans, *other], strict=True):
        write_npz_xyz(path, scan)
    return [str(path) for path in paths]


@pytest.mark.long
def test_the_scans_are_written_with_their_poses(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "stations"
    assert main(["register-scans", *files, "-o", str(out), "--quiet"]) == 3
    shown = capsys.readouterr().out
    assert "elsewhere: left out" in shown
    assert visible_files(out) == ["hall.npz", "office.npz", "stations.json"]
    first, second = lr.read_scan(out / "hall.npz"), lr.read_scan(out / "office.npz")
    assert first.world_from_scanner is not None
    assert second.world_from_scanner is not None
    between = first.world_from_scanner.inverse @ second.world_from_scanner
    assert between.distance_to(POSES[0].inverse @ POSES[1]) < 0.002
    stated = json.loads((out / "stations.json").read_text())
    assert np.allclose(stated["stations"][1]["world_from_scanner"], second.world_from_scanner.matrix, atol=1e-9)
    assert [one["state"] for one in stated["stations"]] == ["fixed", "registered", "out"]
    assert main(["info", str(out)]) == 0
    assert "office to hall: verified" in capsys.readouterr().out
    # All of them with their poses in one E57.
    pytest.importorskip("pye57")
    assert main(["export", str(out), "--to", "e57", "-o", str(tmp_path / "handed"), "--quiet"]) == 0
    handed = tmp_path / "handed" / "e57" / "stations.e57"
    for index, scan in enumerate((first, second)):
        again = lr.read_scan(handed, scan_index=index)
        assert again.world_from_scanner is not None
        assert scan.world_from_scanner is not None
        assert again.world_from_scanner.distance_to(scan.world_from_scanner) < 1e-6
        assert int(again.valid.sum()) == int(scan.valid.sum())
    assert main(["export", str(out), "--to", "ply", "-o", str(tmp_path / "ply"), "--quiet"]) == 2
    capsys.readouterr()
    earlier = json.loads((out / "stations.json").read_text())
    del earlier["sha256"], earlier["options"]["poses"]
    earlier["options"]["use_poses"] = True
    for one in earlier["stations"]:
        del one["component"], one["component_from_scanner"]
    for pair in earlier["pairs"]:
        del pair["stated"]
    for name in ("hall.npz", "office.npz"):
        shutil.copy(out / name, tmp_path / name)
    (tmp_path / "stations.json").write_text(json.dumps(earlier))
    assert main(["info", str(tmp_path)]) == 0, "results of earlier versions are read"
    assert "office to hall: verified" in capsys.readouterr().out
    # An earlier result is replaced by --force only, and nothing else is.
    assert main(["register-scans", *files[:2], "-o", str(out), "--quiet"]) == 2
    assert main(["register-scans", *files[:2], "-o", str(out), "--force", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["accepted"] is True


@pytest.mark.slow
def test_exact_poses_are_kept_and_damaged_results_are_refused(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stated = []
    for name, pose in zip(files[:2], POSES, strict=True):
        scan = replace(lr.read_scan(name), world_from_scanner=pose)
        stated.append(str(tmp_path / Path(name).name))
        write_npz_xyz(Path(stated[-1]), scan)
    out = tmp_path / "out"
    assert main(["register-scans", *stated, "-o", str(out), "--poses", "keep", "--quiet"]) == 0
    shown = capsys.readouterr().out
    assert "as its file states" in shown
    assert "At the poses in the files" in shown
    for name, pose in zip(("hall.npz", "office.npz"), POSES, strict=True):
        kept = lr.read_scan(out / name).world_from_scanner
        assert kept is not None
        assert np.array_equal(kept.matrix, pose.matrix)
    assert main(["register-scans", *files[:2], "-o", str(tmp_path / "no"), "--poses", "keep", "--quiet"]) == 2
    assert "states no pose that could be kept; leave it out, or use --poses refine" in capsys.readouterr().err
    for name, damage, said in DAMAGE:
        written = json.loads((out / "stations.json").read_text())
        del written["sha256"]  # as of earlier versions: what follows is said without a checksum, too
        document = damage(written)
        bad = tmp_path / name
        bad.mkdir()
        for scan_file in () if name == "missing" else ("hall.npz", "office.npz"):
            shutil.copy(out / scan_file, bad)
        (bad / "stations.json").write_text(document if isinstance(document, str) else json.dumps(document))
        assert main(["export", str(bad), "--to", "e57", "-o", str(tmp_path / "none"), "--quiet"]) == 2, name
        shown = capsys.readouterr().err
        assert said in shown, (name, shown)
        assert len(shown.strip().splitlines()) == 1, shown
        assert "internal" not in shown.lower()
        if name in ("cut", "nan", "sheared", "later", "bare", "twice", "nobody"):
            assert main(["info", str(bad)]) == 2, name
            assert said in capsys.readouterr().err
        assert not (tmp_path / "none" / "e57").exists()


@pytest.mark.slow
def test_one_scan_is_not_enough(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["register-scans", files[0], "-o", str(tmp_path / "out"), "--quiet"]) == 2
    assert "give 2 to" in capsys.readouterr().err
