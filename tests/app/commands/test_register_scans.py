"""`ladarreg register-scans`: scans in, scans with poses out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main

import ladarreg_core as lr
from ladarreg_core.formats.npz import write_npz_xyz
from ladarreg_core.simulate.stations import scan_stations, station_room, upright_pose

pytest.importorskip("embreex")
POSES = (upright_pose([-1.0, 0.2, 0.0], 0.4), upright_pose([0.9, -0.6, 0.1], 2.0))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("scans")
    scans = scan_stations(station_room("desk", 2), POSES, seed=5, step_deg=1.0)
    other = scan_stations(station_room("boxes", 8), POSES[:1], seed=6, step_deg=1.0)
    paths = [folder / name for name in ("hall.npz", "office.npz", "elsewhere.npz")]
    for path, scan in zip(paths, [*scans, *other], strict=True):
        write_npz_xyz(path, scan)
    return [str(path) for path in paths]


def test_the_scans_are_written_with_their_poses(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "stations"
    assert main(["register-scans", *files, "-o", str(out), "--quiet"]) == 3
    shown = capsys.readouterr().out
    assert "elsewhere: left out" in shown
    assert sorted(path.name for path in out.iterdir()) == ["hall.npz", "office.npz", "stations.json"]
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
    # An earlier result is replaced by --force only, and nothing else is.
    assert main(["register-scans", *files[:2], "-o", str(out), "--quiet"]) == 2
    assert main(["register-scans", *files[:2], "-o", str(out), "--force", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["accepted"] is True


def test_one_scan_is_not_enough(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["register-scans", files[0], "-o", str(tmp_path / "out"), "--quiet"]) == 2
    assert "give 2 to" in capsys.readouterr().err
